"""The state directory in one file, and back."""
