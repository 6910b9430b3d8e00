"""The collector's console: pages that are rendered on the server. No script runs in them."""
