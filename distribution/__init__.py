"""What is given to others: Debian packages (`deb`), the image (`image`), an archive (`site`), signed (`release`)."""
