"""Build and sign (`release`) the released files: Debian packages (`deb`), the image (`image`) and an archive
(`site`).
"""
