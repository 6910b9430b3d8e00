"""Say where a guard cannot help: the base is on another machine, or takes its commands past the appliance.

1. A cut between the appliance and the base ends the guard's stops too.
2. A process that can reach the base's own ports can give it other publishers. So each node that carries out a guarded
   command is asked for its connections, one node at a time, and a publisher that the appliance did not give it is
   reported if it is there twice in a row.
"""

import asyncio
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple, Protocol

from appliance.channel.answers.graph_answers import Graph
from appliance.features.guards.guard_facts import facts_of
from appliance.features.guards.robot_graph import RobotGraph
from appliance.features.guards.view import BypassedGuard

_PAUSE_SECONDS = 2.0
"""Between two questions, so that each of ten drivers is asked every 20 seconds."""
_MOST_UNANSWERED = 3


class GuardedDriver(NamedTuple):
    """A node that carries out a guarded command, and its host."""

    topic: str
    node: str
    host: str


class ConnectedNodes(Protocol):
    """The core's knowledge of nodes' machines and connections (`control/operators/node_connections.py`)."""

    def is_here(self, host: str) -> bool | None:
        """Return whether a host is the appliance's machine, or null if the appliance cannot know."""

    async def unknown_publishers(self, node: str, topic: str) -> list[str] | None:
        """Return the URIs of a node's publishers that the appliance did not give it, or null without an answer."""


class Placement:
    """Finds the drivers of guarded topics; `commands()` returns these topics. `report` takes each new bypass."""

    def __init__(
        self,
        commands: Callable[[], Iterable[str]],
        graph: Callable[[], Graph],
        connections: ConnectedNodes,
        report: Callable[[BypassedGuard], None],
    ) -> None:
        self._report = report
        self._commands, self._graph, self._connections = commands, graph, connections
        self.elsewhere: list[str] = []
        self._suspected: dict[GuardedDriver, set[str]] = {}
        self._confirmed: dict[GuardedDriver, list[str]] = {}
        self._unanswered: dict[GuardedDriver, int] = {}

    @property
    def bypassed(self) -> list[BypassedGuard]:
        return [_bypassed(driver, uris) for driver, uris in sorted(self._confirmed.items())]

    @property
    def unanswered(self) -> list[str]:
        """The nodes that do not say from whom they take a guarded command."""
        return sorted(
            {driver.node for driver, times in self._unanswered.items() if times >= _MOST_UNANSWERED}
        )

    async def watch(self) -> None:
        while True:
            for driver in self.look():
                await self.ask(driver)
                await asyncio.sleep(_PAUSE_SECONDS)
            await asyncio.sleep(_PAUSE_SECONDS)

    def look(self) -> list[GuardedDriver]:
        """Find the drivers, and return those to ask."""
        commands = {*self._commands()}
        drivers = self._drivers(commands) if commands else []
        self.elsewhere = [*self._sentences(drivers)]
        for known in (self._suspected, self._confirmed, self._unanswered):
            for driver in known.keys() - {*drivers}:
                known.pop(driver)
        return drivers

    async def ask(self, driver: GuardedDriver) -> None:
        uris = await self._connections.unknown_publishers(driver.node, driver.topic)
        if uris is None:
            self._unanswered[driver] = self._unanswered.get(driver, 0) + 1
            return
        self._unanswered.pop(driver, None)
        again = [uri for uri in uris if uri in self._suspected.get(driver, ())]
        self._suspected[driver] = {*uris}
        if again:
            if driver not in self._confirmed:
                self._report(_bypassed(driver, again))
            self._confirmed[driver] = again
        elif not uris:
            self._confirmed.pop(driver, None)

    def sentences(self, topic: str) -> list[str]:
        """Return a sentence for each host of a new guard's base that is another machine."""
        return [*self._sentences(self._drivers({topic}))]

    def _drivers(self, commands: set[str]) -> list[GuardedDriver]:
        graph = self._graph()
        hosts = {node.name: node.host for node in graph.nodes}
        robots = RobotGraph(tuple(facts_of(graph)))
        return [
            GuardedDriver(topic.name, node, hosts[node])
            for topic in robots.topics if topic.name in commands
            for node in sorted(robots.ends(topic)) if node in hosts
        ]  # fmt: skip

    def _sentences(self, drivers: Iterable[GuardedDriver]) -> Iterator[str]:
        for topic, host in dict.fromkeys((driver.topic, driver.host) for driver in drivers):
            here = self._connections.is_here(host)
            if here is None:
                yield (
                    f"{topic}: the base is on {host}: if that is another machine than this container's, a cut between"
                    " here and there is not guarded"
                )
            elif not here:
                yield f"{topic}: the base is on {host}: a cut between here and there is not guarded"


def _bypassed(driver: GuardedDriver, uris: list[str]) -> BypassedGuard:
    return BypassedGuard(driver.topic, driver.node, driver.host, uris)
