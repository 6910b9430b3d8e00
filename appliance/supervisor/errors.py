"""The error that stops the appliance."""


class StartError(Exception):
    """Report that the appliance cannot start or go on; the message has the cause, the place and the remedy."""
