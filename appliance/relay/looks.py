"""Looks into topics: a few messages, read for a person as subscribers get them, and told to control.

A message is read here, where strangers' bytes are, by the definition in its publisher's header; what goes to control
is bounded: `ros/reading.py` cuts long values, and a look has at most `MOST_MESSAGES`. A topic that nobody looks into
costs nothing.
"""

import hashlib
import time
from collections.abc import Callable, Iterable
from functools import partial

from appliance.channel.messages import LookWanted, Message, MessageSeen
from appliance.relay.connections.frames import Batch
from appliance.relay.connections.topic import RelayedTopic
from appliance.ros.definitions import Definitions
from appliance.ros.errors import DefinitionError
from appliance.ros.reading import read_fields

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
            tap = partial(self._see, wanted.number, topic)
            taps.append((topic, tap))
            topic.look(tap)

    def end(self, number: int) -> None:
        """Look away."""
        for topic, tap in self._open.pop(number, ()):
            topic.look_away(tap)
        self._left.pop(number, None)

    def end_all(self) -> None:
        """There is no control to tell."""
        for number in list(self._open):
            self.end(number)

    def _see(self, number: int, topic: RelayedTopic, batch: Batch) -> None:
        position = 0
        while position < len(batch.view) and self._left.get(number, 0) > 0:
            self._left[number] -= 1
            end = position + 4 + int.from_bytes(batch.view[position : position + 4], "little")
            self._tell(_seen(number, topic, bytes(batch.view[position + 4 : end])))
            position = end


def _seen(number: int, topic: RelayedTopic, data: bytes) -> MessageSeen:
    header = topic.header or {}
    kind, text = header.get("type", ""), header.get("message_definition", "")
    fields, why = None, ""
    try:
        if not text.strip() and header.get("md5sum") != _OF_NOTHING:
            raise DefinitionError("there is none", kind[:200])
        definitions = Definitions.from_full_text(kind, text)
        definitions.md5sum(kind)  # all types are there, and none contains itself
        fields = read_fields(definitions, kind, data)
    except DefinitionError as error:
        why = str(error)
    if fields is None:
        fields = {"data": data[:200].hex()}
        why = f"the definition in the publisher's header cannot be read{': ' + why[:300] if why else ''}"
    return MessageSeen(number, topic.key, time.time_ns(), kind[:200], len(data), fields, why)
