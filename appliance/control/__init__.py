"""The control process: made of its parts, told by the supervisor, asked by operators."""
