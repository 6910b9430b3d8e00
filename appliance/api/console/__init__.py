"""Serve the console: the page's files, and the modules that join and serve them."""
