"""The upstream of what monitors publish: it needs no connection, only the header that subscribers are given.

The appliance is the publisher (`/rosrv`, or as configured); its header comes from the specifications' definitions.
"""

from collections.abc import Callable

from appliance.relay.connections.frames import Batch
from appliance.relay.connections.relayed_topic import RelayedTopic
from roswire.tcpros import encode_frame


class OwnPublisher:
    """The `Upstream` of one topic that monitors publish; `header()` is None while no specification does."""

    def __init__(self, topic: RelayedTopic, header: Callable[[], dict[str, str] | None]) -> None:
        self._topic = topic
        self._header = header
        self._current: dict[str, str] | None = None
        self._wanted = False

    def want(self) -> None:
        """Somebody is to be served: the header is known at once."""
        self._wanted = True
        if self._current is None:
            self.judge_again()

    def spare(self) -> None:
        """Nobody is left."""
        self._wanted = False
        if self._current is not None:
            self._current = None
            self._topic.upstream_closed()

    def judge_again(self) -> None:
        """Other specifications are in force: subscribers get the header of their definitions."""
        header = self._header() if self._wanted else None
        if header == self._current:
            return
        self._current = header
        if header is None:
            self._topic.upstream_closed()
        else:
            self._topic.upstream_opened(header)

    def publish(self, data: bytes) -> None:
        """A monitor publishes: to those that subscribe now."""
        if self._current is not None:
            self._topic.published(Batch(memoryview(encode_frame(data)), 1, 0, owned=True))

    def close(self) -> None:
        """The publication is withdrawn."""
        self._current = None

    def pause(self, seconds: float) -> None:
        """There is nothing to be read: what is beyond the bounds of a subscriber that is behind is dropped."""

    def resume(self) -> None:
        """There is nothing to be read."""

    def announce(self, names: Callable[[], frozenset[str]], type_name: str) -> None:
        """Nobody looks for subscribers by name."""

    def give_again(self) -> None:
        """What monitors publish is not latched."""

    def ask_again(self) -> None:
        """Nothing is asked of control."""

    def found(self, host: str, port: int) -> None:
        """Nothing is asked of control."""

    def refused(self) -> None:
        """Nothing is asked of control."""
