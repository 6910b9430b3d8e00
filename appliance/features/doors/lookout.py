"""Find the topics and services that a door's identity may see, with definitions and types.

Viewers need a definition before they subscribe. If it is unknown, the door itself subscribes briefly.

1. A result belongs to one topic or service, and is kept until its nodes change. After a change of the policy, it is
   shown until the next one: so viewers keep what they still may see.
2. A look asks about at most `_MAX_PROBES` things, in turn for each host, and first about those that wait longest. So
   names that never answer delay only the names of their own host.
"""

import asyncio
import math
from collections import Counter, defaultdict, deque
from collections.abc import Awaitable, Callable, Collection, Iterable, Mapping
from typing import Literal, NamedTuple, Protocol

from appliance.features.doors.known_types import KnownType, KnownTypes
from appliance.features.doors.rosapi import Sight
from appliance.features.doors.surroundings import DoorSurroundings, SeenService, SeenTopic, VisibleGraph
from roswire.errors import DefinitionError, RosError
from roswire.node import MasterDenialError
from roswire.node.network import PeerUnreachableError

_FRESH_SECONDS = 1.0
_MAX_PROBES = 50  # topics and services that one look asks about
_PROBE_SECONDS = 1.0
_AGAIN_SECONDS = 10.0  # after which a node that failed is asked again, and one for which the door had no slot
_MAX_ROUNDS = 20  # of looks for one answer about all services

_Thing = tuple[Literal["topic", "service"], str]
HostsOf = Callable[[Collection[str]], Awaitable[Mapping[str, str]]]
"""Returns the host of each node, as a text that differs for each host."""


class TopicSource(Protocol):
    """The node of the door."""

    async def learn(self, topic: str) -> KnownType:
        """Subscribe to a topic until its type is known. Raise `RosError`."""

    def heard_type(self, topic: str) -> KnownType | None:
        """Return the type of a topic to which the door subscribes; None if it is not known."""


class _Asked(NamedTuple):
    """The nodes that were queried about a topic or service, the answer, and the time of the next query."""

    nodes: tuple[str, ...]
    policy: int  # its number at the query
    at: float
    known: KnownType | str | None = None
    """The type of a topic, or the name of the type of a service."""
    again: float = math.inf


class Lookout:
    """Finds the surroundings."""

    def __init__(self, sight: Sight, types: KnownTypes, door: TopicSource, hosts: HostsOf) -> None:
        self._sight = sight
        self._types = types
        self._door = door
        self._hosts = hosts
        self._asked: dict[_Thing, _Asked] = {}
        self._policy = 0  # its number
        self._lock = asyncio.Lock()
        self._last: tuple[float, DoorSurroundings] | None = None

    async def look(self) -> DoorSurroundings:
        async with self._lock:
            now = asyncio.get_running_loop().time()
            if self._last is None or now - self._last[0] > _FRESH_SECONDS:
                self._last = now, await self._look()
            return self._last[1]

    async def service_types(self) -> Mapping[str, str]:
        """Return the type of each service that answers the door. Raise `RosError` if the graph is denied."""
        async with self._lock:
            for _round in range(_MAX_ROUNDS):
                graph = await self._sight.graph()
                if not await self._ask(
                    graph, {("service", name): nodes for name, nodes in graph.services.items()}
                ):
                    break
        found = {name: self._asked.get(("service", name)) for name in graph.services}
        return {name: asked.known for name, asked in found.items() if asked and isinstance(asked.known, str)}

    def policy_changed(self) -> None:
        self._policy += 1

    async def _look(self) -> DoorSurroundings:
        try:
            graph = await self._sight.graph()
        except RosError as error:
            return DoorSurroundings(VisibleGraph({}, {}, {}, {}), (), (), str(error))
        things: dict[_Thing, Collection[str]] = {
            ("topic", topic): nodes
            for topic, nodes in graph.publishers.items()
            if not self._types.has_message(graph.types.get(topic, ""))
        }
        await self._ask(graph, things | {("service", name): nodes for name, nodes in graph.services.items()})
        topics = [
            SeenTopic(topic, kind.name, kind.full_text, kind.key.md5sum, kind.key.fingerprint)
            for topic in graph.topics
            if (kind := self._type(topic, graph)) is not None
        ]
        services = [
            seen for service in sorted(graph.services) if (seen := self._service(service)) is not None
        ]
        return DoorSurroundings(graph, topics, services)

    async def _ask(self, graph: VisibleGraph, things: Mapping[_Thing, Collection[str]]) -> int:
        """Ask about things that are due. Return how many others are due."""
        nodes: dict[_Thing, tuple[str, ...]] = {
            ("topic", topic): tuple(names) for topic, names in graph.publishers.items()
        }
        nodes |= {("service", service): tuple(names) for service, names in graph.services.items()}
        self._asked = {
            thing: asked for thing, asked in self._asked.items() if nodes.get(thing) == asked.nodes
        }
        now = asyncio.get_running_loop().time()
        due = [one for one in things if self._is_due(one, now)]
        due.sort(key=lambda one: (self._asked[one].at if one in self._asked else -math.inf, one))
        chosen = due
        if len(due) > _MAX_PROBES:
            hosts = await self._hosts({name for one in due for name in nodes[one]})
            chosen = in_turn([(one, [hosts.get(name, name) for name in nodes[one]]) for one in due])[
                :_MAX_PROBES
            ]
        await asyncio.gather(*(self._ask_one(thing, nodes[thing]) for thing in chosen))
        return len(due) - len(chosen)

    def _is_due(self, thing: _Thing, now: float) -> bool:
        asked = self._asked.get(thing)
        return asked is None or asked.policy != self._policy or asked.again <= now

    async def _ask_one(self, thing: _Thing, nodes: tuple[str, ...]) -> None:
        kind, name = thing
        policy, now = self._policy, asyncio.get_running_loop().time
        try:
            known = await (self._door.learn(name) if kind == "topic" else self._probe(name))
            self._asked[thing] = _Asked(nodes, policy, now(), known)
        except MasterDenialError:
            self._asked[thing] = _Asked(nodes, policy, now())
        except RosError:  # a node that is started again has the same name
            earlier = self._asked.get(thing)
            kept = earlier and earlier.known
            self._asked[thing] = _Asked(nodes, policy, now(), kept, again=now() + _AGAIN_SECONDS)

    async def _probe(self, service: str) -> str:
        try:
            async with asyncio.timeout(_PROBE_SECONDS):
                header = await self._sight.service_header(service)
        except TimeoutError:
            raise PeerUnreachableError(f"{service} does not answer") from None
        return header.get("type", "")

    def _type(self, topic: str, graph: VisibleGraph) -> KnownType | None:
        """Return the type of this topic, and not just one of the same name."""
        name = graph.types.get(topic, "")
        asked = self._asked.get(("topic", topic))
        known: KnownType | str | None = self._door.heard_type(topic)
        if known is None and asked is not None:
            known = asked.known
        elif isinstance(known, KnownType) and topic in graph.publishers:
            now = asyncio.get_running_loop().time()
            self._asked["topic", topic] = _Asked(tuple(graph.publishers[topic]), self._policy, now, known)
        if isinstance(known, KnownType) and known.name == name:
            return known
        try:
            return self._types.message(name) if self._types.has_message(name) else None
        except DefinitionError:
            return None

    def _service(self, service: str) -> SeenService | None:
        asked = self._asked.get(("service", service))
        kind = asked.known if asked is not None and isinstance(asked.known, str) else ""
        try:
            request, response, _definitions = self._types.service(kind)
        except DefinitionError:
            return None
        return SeenService(service, kind, request.full_text, response.full_text)


def in_turn(things: Iterable[tuple[_Thing, Collection[str]]]) -> list[_Thing]:
    """Order things so that hosts alternate. A thing of several hosts counts for the one with the fewest things."""
    rows = [(thing, [*hosts] or [""]) for thing, hosts in things]
    counts = Counter(host for _thing, hosts in rows for host in hosts)
    queues: defaultdict[str, deque[_Thing]] = defaultdict(deque)
    for thing, hosts in rows:
        queues[min(hosts, key=lambda host: (counts[host], host))].append(thing)
    found: list[_Thing] = []
    while queues:
        for host in [*queues]:
            found.append(queues[host].popleft())
            if not queues[host]:
                del queues[host]
    return found
