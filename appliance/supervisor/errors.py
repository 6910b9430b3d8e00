"""Why the appliance does not start or must stop, in words for the person who started it."""


class StartError(Exception):
    """The appliance cannot start or go on; the message says what, where and what to do."""
