"""The collector's console: pages rendered on the server, without scripts."""
