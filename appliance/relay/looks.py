"""Looks into topics: a few messages, read for a person as subscribers get them, and told to control.

A message is read here, where strangers' bytes are, by the definition in its publisher's header; what goes to control
is bounded: `ros/reading.py` cuts long values, and a look has at most `MOST_MESSAGES`. The definition is read once for
a look and a publisher. A topic that nobody looks into costs nothing.
"""

import hashlib
import time
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

from appliance.channel.messages import LookWanted, Message, MessageSeen
from appliance.relay.connections.frames import Batch
from appliance.relay.connections.topic import RelayedTopic
from appliance.ros.definitions import Definitions
from appliance.ros.errors import DefinitionError
from appliance.ros.reading import read_bytes, read_fields

MOST_LOOKS = 8
MOST_MESSAGES = 20
_OF_NOTHING = hashlib.md5(b"", usedforsecurity=False).hexdigest()  # the md5sum of std_msgs/Empty

Tap = Callable[[Batch], None]


class Looks:
    """Who looks into which topics. `tell(message)` reaches control."""

    def __init__(self, tell: Callable[[Message], None]) -> None:
        self._tell = tell
        self._open: dict[int, list[tuple[RelayedTopic, Tap]]] = {}
        self._left: dict[int, int] = {}

    def begin(self, wanted: LookWanted, topics: Iterable[RelayedTopic]) -> None:
        """Look into a topic, of all its publishers; beyond `MOST_LOOKS` nothing is seen."""
        if len(self._open) >= MOST_LOOKS:
            return
        taps = self._open[wanted.number] = []
        self._left[wanted.number] = min(wanted.messages, MOST_MESSAGES)
        for topic in topics:
            tap = partial(self._see, wanted.number, topic, _Reader(topic))
            taps.append((topic, tap))
            topic.look(tap, latched=wanted.latched)

    def end(self, number: int) -> None:
        """Look away."""
        for topic, tap in self._open.pop(number, ()):
            topic.look_away(tap)
        self._left.pop(number, None)

    def end_all(self) -> None:
        """There is no control to tell."""
        for number in list(self._open):
            self.end(number)

    def _see(self, number: int, topic: RelayedTopic, reader: "_Reader", batch: Batch) -> None:
        position = 0
        while position < len(batch.view) and self._left.get(number, 0) > 0:
            self._left[number] -= 1
            end = position + 4 + int.from_bytes(batch.view[position : position + 4], "little")
            data = bytes(batch.view[position + 4 : end])
            kind, fields, why = reader.read(data)
            self._tell(MessageSeen(number, topic.key, time.time_ns(), kind[:200], len(data), fields, why))
            position = end


class _Reader:
    """Reads the messages of one publisher by the definition in the header that it has at the time."""

    def __init__(self, topic: RelayedTopic) -> None:
        self._topic = topic
        self._header: Mapping[str, str] | None = None
        self._definitions: Definitions | None = None
        self._why = ""

    def read(self, data: bytes) -> tuple[str, dict[str, Any], str]:
        """The type, the fields, and why there are none but the first bytes."""
        header = self._topic.header or {}
        kind = header.get("type", "")
        if header is not self._header:
            self._header, self._definitions, self._why = header, None, ""
            try:
                self._definitions = _definitions(kind, header)
            except DefinitionError as error:
                self._why = f": {str(error)[:300]}"
        fields = read_fields(self._definitions, kind, data) if self._definitions is not None else None
        if fields is not None:
            return kind, fields, ""
        why = f"the definition in the publisher's header cannot be read{self._why}"
        return kind, {"data": read_bytes(data)}, why


def _definitions(kind: str, header: Mapping[str, str]) -> Definitions:
    text = header.get("message_definition", "")
    if not text.strip() and header.get("md5sum") != _OF_NOTHING:
        raise DefinitionError("there is none", kind[:200])
    definitions = Definitions.from_full_text(kind, text)
    definitions.md5sum(kind)  # all types are there, and none contains itself
    return definitions
