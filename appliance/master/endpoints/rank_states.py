"""The drivers of topics with a rank, as the relays last reported them. No I/O.

The reports survive a relay, and the next one begins with them. After a start of control, each topic is `unknown` until
its relay reports.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass, field

from appliance.channel.messages import RankFreed, RankReported
from appliance.channel.messages.relay_link import RankPlace

UNKNOWN = RankReported("", "", 0, "unknown")


@dataclass(slots=True)
class RankStates:
    """The last reports by topic. `listeners` are called with each new one."""

    send: Callable[[RankFreed], bool]
    """Sends an order to the relay of a topic, and returns whether it is there."""
    listeners: list[Callable[[RankReported], None]] = field(default_factory=list)
    _last: dict[str, RankReported] = field(default_factory=dict)

    def of(self, topic: str) -> RankReported:
        return self._last.get(topic, UNKNOWN)

    def place(self, topic: str, rank: int, free: float) -> RankPlace:
        known = self.of(topic)
        return RankPlace(rank, free, known.key, known.rank, known.standing)

    def reported(self, report: RankReported) -> None:
        if report != self._last.get(report.topic):
            self._last[report.topic] = report
            for listener in self.listeners:
                listener(report)

    def free(self, topic: str) -> bool:
        """Hand a topic back; return False if its relay is away."""
        if not self.send(RankFreed(topic)):
            return False
        self.reported(RankReported(topic, "", self.of(topic).rank, "free"))
        return True

    def keep(self, topics: Collection[str]) -> None:
        """Forget all other topics: the policy gives them no rank."""
        self._last = {topic: report for topic, report in self._last.items() if topic in topics}
