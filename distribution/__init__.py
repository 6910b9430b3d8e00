"""Build the released files (`deb`, `image`, and `site` for an archive), and sign them (`release`)."""
