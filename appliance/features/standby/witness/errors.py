"""The errors of the witness."""


class WitnessError(Exception):
    """A request, a setting or the system that prevents an operation; the message has the remedy."""


class UncertainError(WitnessError):
    """The change may have been made, or a part of it."""


class PostponedError(WitnessError):
    """A check was ended for something more urgent, so its earlier result stays."""
