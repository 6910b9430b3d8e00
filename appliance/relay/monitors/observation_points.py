"""Where monitors see something: which publication or service, whose message, and which of its messages."""

import struct
from collections import OrderedDict
from collections.abc import Mapping
from typing import Any, NamedTuple

from appliance.relay.monitors.batch import Passage
from rosmop.run.causes import SEQ, Sender

HEAD = 12
"""Bytes of `std_msgs/Header` that are told: seq and stamp."""

_HEADER = struct.Struct("<III")
_SENDERS = 4096


class Place(NamedTuple):
    """A topic or service of an incarnation, and the sender of what is seen there: publisher, client or server."""

    key: str
    resource: str
    host: str = ""
    caller_id: str = ""


NOWHERE = Place("", "")
"""What happens by time is about no message."""


class Senders:
    """Numbers for places, by which monitors tell later what came from where; the latest `_SENDERS` are known."""

    def __init__(self) -> None:
        self._places: OrderedDict[int, Place] = OrderedDict()
        self._numbers: dict[Place, int] = {}
        self._last = 0

    def number(self, place: Place) -> int:
        """The number of a place."""
        found = self._numbers.get(place)
        if found is None:
            self._last = found = self._last + 1
            self._numbers[place] = found
            self._places[found] = place
            if len(self._places) > _SENDERS:
                del self._numbers[self._places.popitem(last=False)[1]]
        self._places.move_to_end(found)
        return found

    def place(self, number: int) -> Place | None:
        """The place that has this number."""
        return self._places.get(number)


class Sighting:
    """One message of a publication: where it is in its passage, and how it began when it came, if it has a header.

    When the passage is over (None), `position` is its number.
    """

    __slots__ = ("_head", "_passage", "_position")

    def __init__(self, passage: Passage | None, position: int, head: bytes) -> None:
        self._passage = passage
        self._position = position
        self._head = head

    def at(self, number: int) -> "Sighting":
        """The same for when the passage is over; the number of the message is known."""
        return Sighting(None, number, self._head)

    def sender(self, source: int) -> Sender:
        """The sender, and the message's seq if it has a header."""
        if len(self._head) == HEAD:
            return Sender(source, _HEADER.unpack(self._head)[0], SEQ)
        return Sender(source)

    def detail(self) -> Mapping[str, Any]:
        """Its number among those of its publication that this relay received; seq and stamp if it has a header."""
        passage, position = self._passage, self._position
        detail: dict[str, Any] = {"number": passage.number_at(position) if passage is not None else position}
        if len(self._head) == HEAD:
            detail["seq"], seconds, nanoseconds = _HEADER.unpack(self._head)
            detail["stamp"] = f"{seconds}.{nanoseconds:09}"
        return detail
