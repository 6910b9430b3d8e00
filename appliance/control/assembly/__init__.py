"""Make the parts of control, in order."""
