"""The interface of consumers that get a copy of publishers' messages, such as memory that the supervisor holds."""

from collections.abc import Callable, Mapping
from typing import Protocol


class MessageStream(Protocol):
    """The messages of one connection to a publisher. If it `keeps` them, it needs the frames as they were sent."""

    @property
    def keeps(self) -> bool: ...

    def write(
        self, frames: memoryview, messages: int, first: int, judged: int = 0, *, carried: bool = True
    ) -> None:
        """Take frames; `first` is the number of the first one.

        `judged` is the time for which monitors judged them; 0 means now. Those that are not `carried` were dropped
        before monitors and subscribers.
        """

    def close(self) -> None:
        """Note that the connection has ended."""


class MessageSink(Protocol):
    """Gets the messages of all publishers."""

    def open(self, topic: str, host: str, header: Mapping[str, str]) -> MessageStream | None:
        """Return a stream for a publisher's connection, or None if the sink does not take its messages."""


OpenSink = Callable[[Mapping[str, object], int, Callable[[], int]], MessageSink]
"""Makes a sink from its terms, a descriptor of its memory and the monitors' clock."""
