"""The base class of the errors whose text is for users. It imports nothing, so the command starts fast."""


class UserError(Exception):
    """Report an obstacle that a user can remove; `rosrv` prints the text and exits with status 1."""
