"""What can be wrong with ROS traffic, named by who is at fault.

A `PeerError` is the sender's fault: its text says what was wrong, where, and what to do, and may be sent back
to the sender as it stands. An `EncodingError` is ours: we tried to write what ROS has no notation for.
"""


class RosError(Exception):
    """Base of every error of `roswire`."""


class EncodingError(RosError):
    """What we were about to send has no notation on the wire (a control character, an integer of 64 bits)."""


class PeerError(RosError):
    """The sender's fault."""


class InvalidNameError(PeerError):
    """A name outside the ROS grammar."""


class InvalidUriError(PeerError):
    """A node or service URI that cannot be used."""


class ProtocolError(PeerError):
    """Bytes that are not the protocol they should be."""


class LimitExceededError(ProtocolError):
    """Well-formed as far as it was read, but larger, deeper or longer than the limits allow."""


class DefinitionError(PeerError):
    """A message or service definition that cannot be used.

    `source` names the file or the type it stands in, `line` counts from 1 (0: no line of its own).
    """

    def __init__(self, text: str, source: str, line: int = 0) -> None:
        super().__init__(f"{source}:{line}: {text}" if line else f"{source}: {text}")
        self.text = text
        self.source = source
        self.line = line


def quoted(text: str) -> str:
    """As much of a refused name or URI as its error repeats."""
    return ascii(text if len(text) <= 80 else text[:80] + "...")
