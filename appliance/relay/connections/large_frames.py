"""Pass a large frame on in pieces, while it arrives.

A frame that is received whole has left the processor's cache when its first byte is sent; a piece has not. A
`FrameReceiver` returns pieces instead of whole frames while its topic takes them (`RelayedTopic.takes_pieces`). Each
piece is in the scratch area, and goes to the subscribers before the next one is read.

Invariants:
- A frame is decided before its first byte is passed on, by monitors with its first piece. If anything needs the whole
  frame (a tap, a latching topic, the recorder, a rate limit, a monitor that reads on, a subscriber that is behind),
  the frame is received whole before it is passed on. A frame that monitors drop is discarded while it arrives.
- Anything that comes into force during a frame applies from the next frame on.
- A frame goes to the subscribers that were ready at its beginning. A later subscriber gets the next frame first.
- Each of them gets the frame whole, or its connection is closed: if its grant ends, if the publisher's connection ends
  within the frame, or if the subscriber's host has no memory left for its unsent bytes.
- While a frame is passed on in pieces, its topic passes on no other frame.
- While all subscribers have unsent bytes, the publisher is not read, for at most `queue_grace`.
"""

from collections.abc import Container, Sequence
from typing import Protocol

from appliance.relay.transport.frames import Batch

PUBLISHER_GONE = "the connection to the publisher ended within a message that was sent in part"


class PieceSubscriber(Protocol):
    """A subscriber, as large frames use it."""

    behind_since: float | None
    """When its unsent bytes first became too many, so that it is behind; None once it has caught up completely."""

    def ready_for(self, size: int) -> bool:
        """Whether a frame of `size` bytes may begin before it has arrived whole."""

    def extend(self, piece: Batch) -> None:
        """Send or queue the next piece of a frame."""

    def tear(self, reason: str) -> None:
        """Reset the connection, because a frame that was sent in part has no end."""


class FrameInPieces:
    """One frame; `members` get its pieces as long as they are served."""

    __slots__ = ("members", "size")

    def __init__(self, members: Sequence[PieceSubscriber]) -> None:
        self.members = members
        self.size = 0

    def pass_on(self, piece: memoryview, served: Container[PieceSubscriber]) -> bool:
        """Send the next piece; return whether a subscriber is behind."""
        batch, behind = Batch(piece, 0, None), False
        self.size += len(piece)
        for member in self.members:
            if member in served:
                member.extend(batch)
                behind = behind or member.behind_since is not None
        return behind

    def tear(self, served: Container[PieceSubscriber]) -> None:
        """End the frame, because its rest will not come."""
        for member in self.members:
            if member in served:
                member.tear(PUBLISHER_GONE)
