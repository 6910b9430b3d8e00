"""The base class of errors for users; it imports nothing."""


class UserError(Exception):
    """An error for users: `rosrv` prints the text and exits with status 1."""
