"""Tap topics for operators: send control a few messages, as subscribers get them.

The relay parses them, because it handles untrusted bytes anyway.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial

from appliance.base import clock
from appliance.channel.messages import LookEnded, LookWanted, Message, MessageSeen
from appliance.quotas.table import TOPIC_LOOKS
from appliance.relay.connections.relayed_topic import RelayedTopic, Tap
from appliance.relay.transport.frames import Batch
from roswire.message_view import PublisherReader

MAX_LOOKS = TOPIC_LOOKS.bounds.whole
MAX_MESSAGES = 20


class TopicTaps:
    """The topics that operators tap; `tell(message)` sends a message to control."""

    def __init__(self, tell: Callable[[Message], None]) -> None:
        self._tell = tell
        self._open: dict[int, list[tuple[RelayedTopic, Tap]]] = {}
        self._left: dict[int, int] = {}

    def order(self, message: LookWanted | LookEnded, topics: Iterable[RelayedTopic]) -> None:
        if isinstance(message, LookWanted):
            self._begin(message, [topic for topic in topics if topic.topic == message.topic])
        else:
            self._end(message.number)

    def _begin(self, wanted: LookWanted, topics: Iterable[RelayedTopic]) -> None:
        if len(self._open) >= MAX_LOOKS:
            return
        taps = self._open[wanted.number] = []
        self._left[wanted.number] = min(wanted.messages, MAX_MESSAGES)
        for topic in topics:
            tap = partial(self._see, wanted.number, topic, _Reader(topic))
            taps.append((topic, tap))
            topic.tap(tap, latched=wanted.latched)

    def _end(self, number: int) -> None:
        for topic, tap in self._open.pop(number, ()):
            topic.untap(tap)
        self._left.pop(number, None)

    def end_all(self) -> None:
        for number in list(self._open):
            self._end(number)

    def _see(self, number: int, topic: RelayedTopic, reader: _Reader, batch: Batch) -> None:
        position = 0
        while position < len(batch.view) and self._left.get(number, 0) > 0:
            self._left[number] -= 1
            end = position + 4 + int.from_bytes(batch.view[position : position + 4], "little")
            data = bytes(batch.view[position + 4 : end])
            kind, fields, why = reader.read(data)
            self._tell(MessageSeen(number, topic.key, clock.wall_ns(), kind[:200], len(data), fields, why))
            position = end


class _Reader:
    """Reads one publisher's messages by the definition in the publisher's current header."""

    def __init__(self, topic: RelayedTopic) -> None:
        self._topic = topic
        self._header: Mapping[str, str] | None = None
        self._reader = PublisherReader({})

    def read(self, data: bytes) -> tuple[str, dict[str, object], str]:
        header = self._topic.header or {}
        if header is not self._header:
            self._header, self._reader = header, PublisherReader(header)
        return self._reader.type, *self._reader.read(data)
