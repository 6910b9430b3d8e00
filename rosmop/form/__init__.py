"""The intermediate form: typed expressions, statements and functions; a compiled set of specifications as data."""
