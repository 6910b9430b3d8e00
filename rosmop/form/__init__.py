"""The intermediate form: typed expressions, statements and functions."""
