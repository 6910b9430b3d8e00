"""Serve the console."""
