"""Reports to control: connections, refusals, lost publishers, traffic. A new control gets the counts so far.

- Equal refusals within `report_every` become one message with a count, and `refusals` different ones are divided
  among hosts: a flood can neither grow the relay nor fill the link, nor hide the refusals of another host.
- Without a link, at most `_KEPT` ended connections are kept; the rest are only counted.
  Limits are divided like refusals.
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
from appliance.quotas.peers import ReportShares
from appliance.relay.relay_limits import RelayLimits
from appliance.relay.transport.loop_channel import LoopLink
from appliance.relay.transport.rate_limit import Part

_Refusal = tuple[str, str, str, str, str, str]
_Limited = tuple[str, str, Part, str, str]
"""Key of the incarnation, topic, scope of the limit, host and caller id of the publisher or subscriber."""

_TEXT = 300
_KEPT = 1000


class Reporter:
    """Sends reports over the link to control; without a link, keeps or counts them."""

    def __init__(self, limits: RelayLimits) -> None:
        self._limits = limits
        self._link: LoopLink | None = None
        self._open: dict[int, ConnectionOpened] = {}
        self._number = 0
        self._refused: dict[_Refusal, int] = {}
        self._refusals = ReportShares(limits.refusals)
        self._ended: list[tuple[ConnectionOpened, str]] = []  # connections that ended without a link
        self._unrecorded = 0
        self._silent = 0  # ticks without a link
        self._memory: dict[str, int] = {}  # as last reported
        self._limited: dict[_Limited, list[int]] = {}
        self._limitations = ReportShares(_KEPT)

    def attach(self, link: LoopLink | None) -> None:
        self._link = link

    @property
    def attached(self) -> bool:
        return self._link is not None

    def repeat_connections(self) -> None:
        ended, self._ended = self._ended, []
        for opened, reason in ended:
            self.send(opened)
            self.send(ConnectionClosed(opened.number, reason))
        for message in list(self._open.values()):
            self.send(message)
        self._memory = {}

    def send(self, message: Message) -> None:
        if self._link is not None:
            self._link.send(message)

    def opened(self, key: str, resource: str, kind: str, host: str, caller_id: str) -> int:
        self._number += 1
        message = ConnectionOpened(self._number, key, resource, kind, host, caller_id[:_TEXT])
        self._open[self._number] = message
        self.send(message)
        return self._number

    def closed(self, number: int, reason: str) -> None:
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
        """Report a refusal at once, and count equal ones until the next `tick`."""
        kind, resource = asked
        refusal = (key, kind, resource[:_TEXT], host, caller_id[:_TEXT], reason[:_TEXT])
        if refusal in self._refused:
            self._refused[refusal] += 1
        elif (rest := self._refusals.rest_of(host)) is None:
            self._refused[refusal] = int(self._link is None)
            self.send(ConnectionRefused(*refusal, 1))
        else:
            folded = ("", "", "", rest, "", "further rejections, not reported individually")
            self._refused[folded] = self._refused.get(folded, 0) + 1

    def limited(self, what: _Limited, messages: int, size: int) -> None:
        if what not in self._limited and (rest := self._limitations.rest_of(what[3])) is not None:
            what = ("", "", what[2], rest, "")
        row = self._limited.setdefault(what, [0, 0])
        row[0] += messages
        row[1] += size

    def tick(self, traffic: Callable[[], list[TopicTraffic]], memory: Mapping[str, int]) -> None:
        """Send the counts since the last tick.

        `traffic` returns and resets the traffic counts; `memory` has the bytes held now in each pool.
        """
        if self._link is None:
            self._silent += 1
            return
        for refusal, count in self._refused.items():
            if count:
                self.send(ConnectionRefused(*refusal, count))
        self._refused.clear()
        self._refusals.clear()
        rows = traffic()
        if rows or self._unrecorded or memory != self._memory:
            self._memory = dict(memory)
            over = (1 + self._silent) * self._limits.report_every
            self.send(TrafficReported(rows, over, self._unrecorded, self._memory))
        if self._limited:
            self.send(MessagesLimited([LimitedRow(*what, *row) for what, row in self._limited.items()]))
            self._limited.clear()
            self._limitations.clear()
        self._silent = self._unrecorded = 0
