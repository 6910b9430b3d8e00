"""The base class of errors for users. It imports nothing, so the command starts fast."""


class UserError(Exception):
    """`rosrv` prints the text and exits with status 1."""
