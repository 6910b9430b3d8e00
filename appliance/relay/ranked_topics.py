"""The topics with a rank of one relay: their drivers, and what follows from a hand-over.

The state of a topic lives as long as one of its publishers. Control keeps the last report for the next publisher, and
for the next relay.
"""

from collections.abc import Callable, Iterable
from functools import partial

from appliance.channel.messages import PublicationPlaced, RankReported
from appliance.relay.connections.ranked_publication import RankedPublication
from appliance.relay.connections.relayed_topic import RelayedTopic
from appliance.relay.loop import EventLoop
from appliance.relay.ranked_topic import RankDriver, RankedTopic

_CHECK_SECONDS, _SETTLING_SECONDS = 0.03, 0.01  # less than `STALL_SECONDS`


class RankedTopics:
    """Gives publishers their rank, and reports drivers. `relayed(topic)` returns the publications of a topic."""

    def __init__(
        self,
        loop: EventLoop,
        report: Callable[[RankReported], None],
        relayed: Callable[[str], Iterable[RelayedTopic]],
    ) -> None:
        self._loop = loop
        self._report = report
        self._relayed = relayed
        self._topics: dict[str, RankedTopic] = {}
        self._checked: set[str] = set()

    def place(self, placed: PublicationPlaced, relayed: RelayedTopic) -> None:
        if placed.rank is None:
            self.withdraw(placed.key, placed.topic)
            relayed.give_rank(None)
            return
        topic = self._topics.get(placed.topic)
        if topic is None:
            changed = partial(self._changed, placed.topic)
            topic = self._topics[placed.topic] = RankedTopic(placed.rank, self._loop.clock(), changed)
            self._watch(placed.topic)
        new = placed.key not in topic.keys
        topic.place(placed.key, placed.rank.rank, placed.rank.free)
        if new:
            relayed.give_rank(RankedPublication(topic, placed.key))

    def withdraw(self, key: str, name: str) -> None:
        topic = self._topics.get(name)
        if topic is None or key not in topic.keys:
            return
        topic.withdraw(key, self._loop.clock())
        if not topic.keys:
            del self._topics[name]

    def free(self, name: str) -> None:
        topic = self._topics.get(name)
        if topic is not None:
            topic.free(self._loop.clock())

    def repeat(self) -> None:
        for name, topic in self._topics.items():
            self._say(name, topic.driver)

    def _changed(self, name: str, driver: RankDriver) -> None:
        self._say(name, driver)
        self._watch(name)
        for relayed in self._relayed(name):
            if relayed.key != driver.key:
                relayed.hush()

    def _say(self, name: str, driver: RankDriver) -> None:
        self._report(RankReported(name, driver.key, driver.rank, driver.standing))

    def _watch(self, name: str) -> None:
        if name not in self._checked and name in self._topics:
            self._checked.add(name)
            seconds = _SETTLING_SECONDS if self._topics[name].is_settling else _CHECK_SECONDS
            self._loop.after(seconds, partial(self._check, name))

    def _check(self, name: str) -> None:
        self._checked.discard(name)
        topic = self._topics.get(name)
        if topic is not None and topic.expire(self._loop.clock()) is not None:
            self._watch(name)
