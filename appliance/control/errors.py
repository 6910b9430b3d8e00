"""What cannot be answered."""


class UnknownThingError(Exception):
    """There is nothing of the name or number that was asked for."""


class SenselessError(Exception):
    """What was asked makes no sense."""
