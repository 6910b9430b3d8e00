"""What the relay tells control: connections, refusals (folded), lost publishers, traffic.

Without a link the counters go on, and refusals are counted; a new control is told of both, of the connections that are
open, and of those that have ended meanwhile.

Invariants:
- `TrafficReported` is sent at most once per `report_every`.
- Equal refusals within that time are one message with a count, and there are at most `refusals` different
  ones; what a flood of strangers sends cannot grow the relay or fill the link.
- What limits dropped is counted for at most `_KEPT` parts; beyond, for all others together.
- Of the connections that end without a link, `_KEPT` are kept to be told; the others are counted.
"""

from collections.abc import Callable, Mapping

from appliance.channel.messages import (
    ConnectionClosed,
    ConnectionOpened,
    ConnectionRefused,
    LimitedRow,
    Message,
    MessagesLimited,
    TopicTraffic,
    TrafficReported,
)
from appliance.relay.bounds import Limits
from appliance.relay.connections.loop_channel import Link
from appliance.relay.connections.rate_limit import Part

_Refusal = tuple[str, str, str, str, str, str]
_Limited = tuple[str, str, Part, str, str]
"""Key of the incarnation, topic, whose limit, host and caller id of the publisher or subscriber."""

_TEXT = 300
_KEPT = 1000


class Reporter:
    """The relay's voice; without a control nobody hears it."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._link: Link | None = None
        self._open: dict[int, ConnectionOpened] = {}
        self._number = 0
        self._refused: dict[_Refusal, int] = {}
        self._ended: list[tuple[ConnectionOpened, str]] = []  # without a link
        self._unrecorded = 0
        self._silent = 0  # ticks without a link
        self._memory: dict[str, int] = {}  # as told last
        self._limited: dict[_Limited, list[int]] = {}

    def attach(self, link: Link | None) -> None:
        """Speak to this control from now on."""
        self._link = link

    @property
    def attached(self) -> bool:
        """Whether there is a control to hear."""
        return self._link is not None

    def repeat_connections(self) -> None:
        """Tell a new control which connections have ended while there was none, and which are open."""
        ended, self._ended = self._ended, []
        for opened, reason in ended:
            self.send(opened)
            self.send(ConnectionClosed(opened.number, reason))
        for message in list(self._open.values()):
            self.send(message)
        self._memory = {}

    def send(self, message: Message) -> None:
        """Tell control, if there is one."""
        if self._link is not None:
            self._link.send(message)

    def opened(self, key: str, resource: str, kind: str, host: str, caller_id: str) -> int:
        """A connection is served; its number."""
        self._number += 1
        message = ConnectionOpened(self._number, key, resource, kind, host, caller_id[:_TEXT])
        self._open[self._number] = message
        self.send(message)
        return self._number

    def closed(self, number: int, reason: str) -> None:
        """A connection that was served has ended."""
        opened = self._open.pop(number, None)
        if opened is None:
            return
        if self._link is not None:
            self.send(ConnectionClosed(number, reason))
        elif len(self._ended) < _KEPT:
            self._ended.append((opened, reason))
        else:
            self._unrecorded += 1

    def refused(self, key: str, asked: tuple[str, str], host: str, caller_id: str, reason: str) -> None:
        """A connection is refused: told at once the first time, then counted until the next `tick`.

        `asked` is the kind and the name of what its header asked for.
        """
        kind, resource = asked
        refusal = (key, kind, resource[:_TEXT], host, caller_id[:_TEXT], reason[:_TEXT])
        if refusal in self._refused:
            self._refused[refusal] += 1
        elif len(self._refused) < self._limits.refusals:
            self._refused[refusal] = int(self._link is None)
            self.send(ConnectionRefused(*refusal, 1))
        else:
            folded = ("", "", "", "", "", "further refusals of other peers, not told one by one")
            self._refused[folded] = self._refused.get(folded, 0) + 1

    def limited(self, what: _Limited, messages: int, size: int) -> None:
        """A limit dropped messages: told with the next tick, one row for each part that was limited."""
        if what not in self._limited and len(self._limited) >= _KEPT:
            what = ("", "", what[2], "", "")
        row = self._limited.setdefault(what, [0, 0])
        row[0] += messages
        row[1] += size

    def tick(self, traffic: Callable[[], list[TopicTraffic]], memory: Mapping[str, int]) -> None:
        """Send the counts since the last tick; without a link they stay (`traffic` takes them) for the next.

        `memory` has the bytes that are held now.
        """
        if self._link is None:
            self._silent += 1
            return
        for refusal, count in self._refused.items():
            if count:
                self.send(ConnectionRefused(*refusal, count))
        self._refused.clear()
        rows = traffic()
        if rows or self._unrecorded or memory != self._memory:
            self._memory = dict(memory)
            over = (1 + self._silent) * self._limits.report_every
            self.send(TrafficReported(rows, over, self._unrecorded, self._memory))
        if self._limited:
            self.send(MessagesLimited([LimitedRow(*what, *row) for what, row in self._limited.items()]))
            self._limited.clear()
        self._silent = self._unrecorded = 0
