"""Errors in ROS traffic, by the side that is at fault."""


class RosError(Exception):
    """The base of all errors of `roswire`."""


class EncodingError(RosError):
    """A value that ROS cannot encode, such as a control character or a 64-bit integer."""


class PeerError(RosError):
    """An error of the sender, to whom the text may be sent back."""


class InvalidNameError(PeerError):
    """A name outside the ROS grammar."""


class InvalidUriError(PeerError):
    """A node or service URI that cannot be used."""


class ProtocolError(PeerError):
    """Bytes that violate their protocol."""


class LimitExceededError(ProtocolError):
    """A limit is exceeded. The part that was read is well-formed."""


class DefinitionError(PeerError):
    """An invalid definition. `source` names the file or type; `line` counts from 1, and 0 means unknown."""

    def __init__(self, text: str, source: str, line: int = 0) -> None:
        super().__init__(f"{source}:{line}: {text}" if line else f"{source}: {text}")
        self.text = text
        self.source = source
        self.line = line


def quote(text: str) -> str:
    return ascii(text if len(text) <= 80 else text[:80] + "...")
