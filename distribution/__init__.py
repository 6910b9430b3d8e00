"""Build what is released: Debian packages (`deb`), the image (`image`), an archive (`site`), signed (`release`)."""
