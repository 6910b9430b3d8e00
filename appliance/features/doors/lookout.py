"""Find the topics and services that a door's identity may see, with definitions and types.

Viewers need a definition before they subscribe. If it is unknown, the door itself subscribes briefly. A result is
kept until the nodes of the topic or service change, and a denial at most until the policy changes.
"""

import asyncio
import math
from collections.abc import Awaitable, Callable
from typing import Literal, NamedTuple

from appliance.features.doors.known_types import KnownTypes
from appliance.features.doors.rosapi import Sight
from appliance.features.doors.surroundings import DoorSurroundings, SeenService, SeenTopic, VisibleGraph
from roswire.errors import DefinitionError, LimitExceededError, RosError
from roswire.node import MasterDenialError
from roswire.node.network import PeerUnreachableError

_FRESH_SECONDS = 1.0
_MOST_PROBES = 50  # topics and services that one look asks about
_AGAIN_SECONDS = (
    10.0  # after which a node is asked again that did not answer, or for which the door had no slot
)

_Thing = tuple[Literal["topic", "service"], str]


class _Asked(NamedTuple):
    """The nodes that were queried about a topic or service, and the time of the next query."""

    nodes: tuple[str, ...]
    again: float = math.inf
    denied: int | None = None  # the policy that denied it


class Lookout:
    """Finds the surroundings; `learn` subscribes to a topic until its definition is known."""

    def __init__(self, sight: Sight, types: KnownTypes, learn: Callable[[str], Awaitable[None]]) -> None:
        self._sight = sight
        self._types = types
        self._learn = learn
        self._asked: dict[_Thing, _Asked] = {}
        self._service_types: dict[str, str] = {}
        self._policy = 0  # its number
        self._lock = asyncio.Lock()
        self._last: tuple[float, DoorSurroundings] | None = None

    async def look(self) -> DoorSurroundings:
        async with self._lock:
            now = asyncio.get_running_loop().time()
            if self._last is None or now - self._last[0] > _FRESH_SECONDS:
                self._last = now, await self._look()
            return self._last[1]

    def policy_changed(self) -> None:
        self._policy += 1

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
        now = asyncio.get_running_loop().time()
        nodes: dict[_Thing, tuple[str, ...]] = {
            ("topic", topic): tuple(graph.publishers[topic])
            for topic in sorted(graph.publishers)
            if self._text(graph.types.get(topic, "")) is None
        }
        nodes |= {("service", service): tuple(graph.services[service]) for service in sorted(graph.services)}
        self._asked = {
            thing: asked
            for thing, asked in self._asked.items()
            if nodes.get(thing) == asked.nodes and asked.denied in (None, self._policy)
        }
        self._service_types = {
            name: kind for name, kind in self._service_types.items() if name in graph.services
        }
        due = [one for one in nodes if one not in self._asked or self._asked[one].again <= now]
        await asyncio.gather(*(self._ask_one(thing, nodes[thing]) for thing in due[:_MOST_PROBES]))

    async def _ask_one(self, thing: _Thing, nodes: tuple[str, ...]) -> None:
        kind, name = thing
        policy = self._policy
        try:
            await (self._learn if kind == "topic" else self._probe)(name)
            self._asked[thing] = _Asked(nodes)
        except (PeerUnreachableError, LimitExceededError):
            self._asked[thing] = _Asked(nodes, again=asyncio.get_running_loop().time() + _AGAIN_SECONDS)
        except RosError as error:
            self._asked[thing] = _Asked(
                nodes, denied=policy if isinstance(error, MasterDenialError) else None
            )

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
