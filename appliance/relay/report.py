"""What the relay tells control: connections, refusals (folded), lost publishers, traffic.

Without a link the counters go on; connections that are open are reported again to a new control.

Invariants:
- `TrafficReported` is sent at most once per `report_every`.
- Equal refusals within that time are one message with a count, and there are at most `refusals` different
  ones; what a flood of strangers sends cannot grow the relay or fill the link.
"""

from collections.abc import Iterable

from appliance.channel.messages import (
    ConnectionClosed,
    ConnectionOpened,
    ConnectionRefused,
    Message,
    TopicTraffic,
    TrafficReported,
)
from appliance.relay.limits import Limits
from appliance.relay.links import Link

_Refusal = tuple[str, str, str, str, str]
_TEXT = 300


class Reporter:
    """The relay's voice; without a control nobody hears it."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._link: Link | None = None
        self._open: dict[int, ConnectionOpened] = {}
        self._number = 0
        self._refused: dict[_Refusal, int] = {}

    def attach(self, link: Link | None) -> None:
        """Speak to this control from now on."""
        self._link = link

    @property
    def attached(self) -> bool:
        """Whether there is a control to hear."""
        return self._link is not None

    def repeat_connections(self) -> None:
        """Tell a new control which connections are open."""
        for message in list(self._open.values()):
            self.send(message)

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
        if self._open.pop(number, None) is not None:
            self.send(ConnectionClosed(number, reason))

    def refused(self, key: str, resource: str, host: str, caller_id: str, reason: str) -> None:
        """A connection is refused: told at once the first time, then counted until the next `tick`."""
        refusal = (key, resource[:_TEXT], host, caller_id[:_TEXT], reason[:_TEXT])
        if refusal in self._refused:
            self._refused[refusal] += 1
        elif len(self._refused) < self._limits.refusals:
            self._refused[refusal] = 0
            self.send(ConnectionRefused(*refusal, 1))
        else:
            folded = ("", "", "", "", "further refusals of other peers, not told one by one")
            self._refused[folded] = self._refused.get(folded, 0) + 1

    def tick(self, traffic: Iterable[TopicTraffic]) -> None:
        """Send the counts since the last tick."""
        for refusal, count in self._refused.items():
            if count:
                self.send(ConnectionRefused(*refusal, count))
        self._refused.clear()
        if self._link is None:
            return
        rows = list(traffic)
        if rows:
            self.send(TrafficReported(rows))
