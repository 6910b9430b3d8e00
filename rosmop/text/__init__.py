"""The text of ``.rv`` files: grammar, parser, and the tree that comes out. Nothing here knows a message type."""
