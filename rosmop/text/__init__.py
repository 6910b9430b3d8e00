"""The text of ``.rv`` files: grammar, parser and syntax tree, without knowledge of message types."""
