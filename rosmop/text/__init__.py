"""Parse ``.rv`` files to a syntax tree, without knowledge of message types."""
