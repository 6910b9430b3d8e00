"""Define the errors of requests that cannot be answered."""


class UnknownThingError(Exception):
    """The requested name or number does not exist."""


class SenselessError(Exception):
    """The request makes no sense."""


class UnavailableError(Exception):
    """The appliance cannot do it now; the message gives the reason."""
