"""Restore a state directory from a file, and erase it. `appliance/backup` writes the file."""
