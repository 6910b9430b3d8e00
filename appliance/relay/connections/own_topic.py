"""The upstream of a topic that the appliance itself publishes: it has a header and no connection."""

from collections.abc import Callable, Sequence

from appliance.relay.connections.relayed_topic import RelayedTopic, Upstream
from appliance.relay.connections.served_subscribers import TopicSubscriber
from appliance.relay.transport.frames import Batch
from roswire.tcpros import encode_frame


class OwnTopicPublisher(Upstream):
    """The upstream of one such topic; `header()` returns None while no specification or feature publishes it."""

    def __init__(self, topic: RelayedTopic, header: Callable[[], dict[str, str] | None]) -> None:
        self._topic = topic
        self._header = header
        self._current: dict[str, str] | None = None
        self._wanted = False

    def connect(self) -> None:
        self._wanted = True
        if self._current is None:
            self.recheck()

    def release(self) -> None:
        self._wanted = False
        if self._current is not None:
            self._current = None
            self._topic.upstream_closed()

    def recheck(self) -> None:
        header = self._header() if self._wanted else None
        if header == self._current:
            return
        self._current = header
        if header is None:
            self._topic.upstream_closed()
        else:
            self._topic.upstream_opened(header)

    def publish(self, data: bytes) -> None:
        if self._current is not None:
            self._topic.published(Batch(memoryview(encode_frame(data)), 1, 0, owned=True))

    def members(self) -> Sequence[TopicSubscriber]:
        """Return the subscribers that get what is published now."""
        return self._topic.members if self._current is not None else ()

    def waiting(self) -> str:
        """Return the name of a subscriber whose socket has not taken all messages, or an empty text."""
        return next((member.caller_id for member in self._topic.members if member.descriptor < 0), "")

    def close(self) -> None:
        self._current = None
