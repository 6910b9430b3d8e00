"""The Debian package: how it is built (`deb`), what of the documentation goes into it as man pages (`man`)."""
