"""Look at the surroundings of a door: topics and services that its identity may see, with definitions and types.

Viewers list topics before they subscribe, and need the definitions first. A definition that the door does not know
comes with the header of a publisher, so the door subscribes to the topic for a moment. A topic that the policy denies
stays without a definition. The result, or the denial, is kept until the publishers or the providers change.
"""

import asyncio
from collections.abc import Awaitable, Callable, Sequence

from appliance.features.doors.known_types import KnownTypes
from appliance.features.doors.rosapi import Sight
from appliance.features.doors.surroundings import DoorSurroundings, SeenService, SeenTopic, VisibleGraph
from roswire.errors import DefinitionError, RosError

_FRESH_SECONDS = 1.0
_MOST_PROBES = 50  # topics and services that one look asks about


_Question = tuple[str, Sequence[str], Callable[[str], Awaitable[None]]]
"""A topic or service, its publishers or providers, and the function that asks about it."""


class Lookout:
    """Looks at the surroundings; `learn` subscribes to a topic until its definition is known."""

    def __init__(self, sight: Sight, types: KnownTypes, learn: Callable[[str], Awaitable[None]]) -> None:
        self._sight = sight
        self._types = types
        self._learn = learn
        self._asked: dict[str, tuple[str, ...]] = {}  # publishers or providers, when it was asked about
        self._service_types: dict[str, str] = {}
        self._lock = asyncio.Lock()
        self._last: tuple[float, DoorSurroundings] | None = None

    async def look(self) -> DoorSurroundings:
        """Return the present surroundings; those of the last second are good enough."""
        async with self._lock:
            now = asyncio.get_running_loop().time()
            if self._last is None or now - self._last[0] > _FRESH_SECONDS:
                self._last = now, await self._look()
            return self._last[1]

    async def _look(self) -> DoorSurroundings:
        try:
            graph = await self._sight.graph()
        except RosError as error:
            return DoorSurroundings(VisibleGraph({}, {}, {}, {}), (), (), str(error))
        await self._ask(graph)
        topics = [
            SeenTopic(topic, kind, text)
            for topic in graph.topics
            if (kind := graph.types.get(topic, "")) and (text := self._text(kind)) is not None
        ]
        services = [
            seen for service in sorted(graph.services) if (seen := self._service(service)) is not None
        ]
        return DoorSurroundings(graph, topics, services)

    async def _ask(self, graph: VisibleGraph) -> None:
        unknown = [
            topic for topic in sorted(graph.publishers) if self._text(graph.types.get(topic, "")) is None
        ]
        rows: list[_Question] = [(topic, graph.publishers[topic], self._learn) for topic in unknown]
        rows += [(service, graph.services[service], self._probe) for service in sorted(graph.services)]
        new = [row for row in rows if self._asked.get(row[0]) != tuple(row[1])][:_MOST_PROBES]
        self._asked = {
            name: nodes
            for name, nodes in self._asked.items()
            if name in graph.publishers or name in graph.services
        }
        self._service_types = {
            name: kind for name, kind in self._service_types.items() if name in graph.services
        }
        for name, nodes, _ask in new:
            self._asked[name] = tuple(nodes)
        await asyncio.gather(*(_quietly(ask(name)) for name, _nodes, ask in new))

    async def _probe(self, service: str) -> None:
        self._service_types.pop(service, None)
        self._service_types[service] = (await self._sight.service_header(service)).get("type", "")

    def _text(self, kind: str) -> str | None:
        try:
            return self._types.message(kind)[1].full_text(kind)
        except DefinitionError:
            return None

    def _service(self, service: str) -> SeenService | None:
        try:
            kind = self._service_types.get(service, "")
            definitions = self._types.service(kind)[2]
        except DefinitionError:
            return None
        found = definitions.service(kind)
        texts = [definitions.full_text(one.name) for one in (found.request, found.response)]
        return SeenService(service, kind, *texts)


async def _quietly(asking: Awaitable[None]) -> None:
    """Await an answer; a denial, or a node that does not answer, leaves the name unknown."""
    try:
        await asking
    except RosError:
        return
