"""The base class of errors for users; it imports nothing."""


class UserError(Exception):
    """`rosrv` prints the text and exits with status 1."""
