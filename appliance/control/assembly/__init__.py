"""Make the parts of control, in order, and keep what they have in common."""
