"""The error that stops the appliance."""


class StartError(Exception):
    """Report that the appliance cannot start or go on; the message says what, where and what to do."""
