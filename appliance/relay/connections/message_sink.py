"""Define what gets a copy of the messages that publishers send, such as memory that the supervisor holds."""

from collections.abc import Callable, Mapping
from typing import Any, Protocol


class MessageStream(Protocol):
    """The messages of one connection to a publisher. `keeps`: it needs the frames as the publisher sent them."""

    @property
    def keeps(self) -> bool: ...

    def write(self, frames: memoryview, messages: int, first: int, judged: int = 0) -> None:
        """Take frames, of which `first` is the first one's number.

        `judged` is the time by which monitors judged them; 0: now.
        """

    def close(self) -> None:
        """Take the end of the connection."""


class MessageSink(Protocol):
    """Gets the messages of all publishers."""

    def open(self, topic: str, host: str, header: Mapping[str, str]) -> MessageStream | None:
        """Return None if the sink does not take the publisher's messages."""


OpenSink = Callable[[Mapping[str, Any], int, Callable[[], int]], MessageSink]
"""A function that makes a sink of its terms and a memory's descriptor, with the monitors' clock."""
