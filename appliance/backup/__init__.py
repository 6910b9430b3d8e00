"""Back up and restore the state directory as one file."""
