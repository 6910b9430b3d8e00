"""Keep the registry: nodes, and their registrations. No I/O, no clock.

1. At most one incarnation of a name (one life of a node, with an API URI on one host) is *live*, and only it holds
   the name. An earlier one is *replaced*, and never comes back.
2. A live incarnation that no longer answers becomes a *shadow*. Its registrations are kept, but have no effect until
   the node returns or the shadow expires. A shadow does not hold its name.
3. Registrations are numbered, so that a rebuilt ROS master gets them in their original order.
4. While an incarnation is known, no other incarnation gets its key or ports.
"""

import enum
import secrets
from bisect import bisect_left, insort
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

from appliance.channel import rosout_address
from appliance.policy.model import Address
from appliance.store.state_file import PermissionRow
from roswire.names import ROSOUT
from roswire.uris import NodeUri, node_uri

ANY_TYPE = "*"
"""The type of a topic for subscribers that accept any type."""

_MAX_UNUSED_TYPES = 10_000
"""The most topics without a node whose types are kept. This limits memory."""

PUBLISHER_PATH = "/publisher/"
"""The path of the node API of the appliance's own publisher, on the listener of the master-side endpoints."""


class HostFullError(Exception):
    """A host has as many nodes as it may have, and each is in use."""


class Kind(enum.StrEnum):
    PUBLICATION = "publication"
    SUBSCRIPTION = "subscription"
    SERVICE = "service"
    PARAMETER = "parameter"


_OF_EVERY_NODE = ("get_loggers", "set_logger_level", "tf2_frames")  # private services of the client libraries
OF_TOPICS = (Kind.PUBLICATION, Kind.SUBSCRIPTION)


class Life(enum.StrEnum):
    """The state of an incarnation; the registry no longer has a forgotten one."""

    LIVE = "live"
    SHADOW = "shadow"
    REPLACED = "replaced"
    FORGOTTEN = "forgotten"


ENDED = frozenset({Life.REPLACED, Life.FORGOTTEN})
"""The states of incarnations whose endpoints are closed."""


@dataclass(frozen=True, slots=True)
class NodeRegistration:
    """A registration of a node. `detail` is the topic's type or the service's `rosrpc` port."""

    kind: Kind
    resource: str
    detail: str
    order: int


@dataclass(slots=True, eq=False)
class Incarnation:
    """One life of a node.

    The host part of `api`, the registered URI, is not verified and never used. `told` is the address at which this
    node reaches the appliance; all URIs for this node use it. `reached` is False for a node that cannot be called, as
    behind NAT: it subscribes to what is there, and gets no calls. It is True once a call was answered, else None.
    """

    key: str
    name: str
    host: Address
    api: NodeUri
    api_text: str
    told: str
    outer_port: int
    relay_port: int
    own: bool = False
    reached: bool | None = None
    life: Life = Life.LIVE
    changed: float = 0.0  # monotonic seconds of the last change of `life`, or of control's start
    touched: float = 0.0  # monotonic seconds of its last registering call
    registrations: dict[tuple[Kind, str], NodeRegistration] = field(default_factory=dict)
    shelf: dict[tuple[Kind, str], NodeRegistration] = field(default_factory=dict)  # withdrawn by the policy
    more_relay_ports: tuple[int, ...] = ()
    calls: int = 0  # the number of registering calls of this incarnation that are under way

    @property
    def evictable(self) -> bool:
        return not (self.registrations or self.shelf or self.calls or self.own) or self.life is Life.REPLACED

    @property
    def gone(self) -> bool:
        """Whether it has unregistered everything: it has ended, or registers nothing. It is kept for its next call."""
        return self.life is Life.LIVE and not (self.registrations or self.shelf)

    @property
    def only_listens(self) -> bool:
        """Whether it subscribes, and offers nothing but what every node does."""
        offers = {Kind.PUBLICATION, Kind.SERVICE}
        kinds = {kind for kind, resource in self.registrations if not self.offered_by_every(resource)}
        return any(kind not in offers for kind, _resource in self.registrations) and not kinds & offers

    def offered_by_every(self, resource: str) -> bool:
        """Return whether the client libraries register this publication or service for every node."""
        return resource == ROSOUT or resource in {f"{self.name}/{service}" for service in _OF_EVERY_NODE}

    @property
    def of_monitors(self) -> bool:
        return self.own and self.api.path == PUBLISHER_PATH

    @property
    def relay_ports(self) -> tuple[int, ...]:
        return (self.relay_port, *self.more_relay_ports)

    @property
    def ports(self) -> tuple[int, ...]:
        return (self.outer_port, *self.relay_ports)

    @property
    def real_uri(self) -> str:
        return node_uri(str(self.host), self.api.port, self.api.path)

    @property
    def call_uri(self) -> NodeUri:
        host = rosout_address.ADDRESS if self.own and not self.of_monitors else str(self.host)
        return NodeUri("http", host, self.api.port, self.api.path)

    def outer_uri(self, told: str) -> str:
        return node_uri(told, self.outer_port)

    def uri_for(self, told: str, *, hidden: bool) -> str:
        """Return the outer URI if `hidden`; the appliance's own nodes have no other."""
        return self.outer_uri(told) if hidden or self.own else self.real_uri

    def in_order(self) -> list[NodeRegistration]:
        return sorted(self.registrations.values(), key=lambda registration: registration.order)

    def resources(self, kind: Kind) -> list[str]:
        return [
            registration.resource for registration in self.registrations.values() if registration.kind is kind
        ]


class RegistrationKey(NamedTuple):
    """A registration that a node has or had. `shelved`: a registration that the policy withdrew."""

    node: Incarnation
    kind: Kind
    resource: str
    shelved: bool = False


Change = Incarnation | RegistrationKey | PermissionRow
"""A node whose life may have changed, a registration of a node, or a grant."""


class Registry:
    """All known incarnations."""

    def __init__(self, nodes_of_host: int = 500) -> None:
        self._most_of_host = nodes_of_host
        self._woken: list[Callable[[], None]] = []
        self._by_key: dict[str, Incarnation] = {}
        self._known: dict[tuple[str, Address, str], Incarnation] = {}
        self._live: dict[str, Incarnation] = {}
        self._topics: dict[tuple[Kind, str], dict[str, Incarnation]] = {}
        self._types: dict[str, str] = {}  # the type of each topic, as in the ROS master
        self._unused_types: dict[str, None] = {}  # topics without a node, oldest first
        self._subscribed_keys: list[str] = []  # the subscribed parameters in `_topics`, sorted
        self._nodes_of: Counter[Address] = Counter()
        self._registrations_of: Counter[Address] = Counter()
        self._order = 0
        self.version = 0  # increases with every change
        self._changed: dict[Change, None] = {}

    def on_change(self, woken: Callable[[], None]) -> None:
        """Call `woken` for the first of several changes."""
        self._woken.append(woken)

    def mark(self, change: Change) -> None:
        if not self._changed:
            for woken in self._woken:
                woken()
        self._changed[change] = None

    def take_changes(self) -> list[Change]:
        """Return what has changed since the last call: first the nodes, then the rest in order."""
        if not self._changed:
            return []
        changed, self._changed = self._changed, {}
        nodes = [change for change in changed if isinstance(change, Incarnation)]
        return [*nodes, *(change for change in changed if not isinstance(change, Incarnation))]

    # --- looking ---

    def by_key(self, key: str) -> Incarnation | None:
        return self._by_key.get(key)

    def find(self, name: str, host: Address, api_text: str) -> Incarnation | None:
        return self._known.get((name, host, api_text))

    def holder(self, name: str) -> Incarnation | None:
        incarnation = self._live.get(name)
        return incarnation if incarnation is not None and incarnation.registrations else None

    def occupant(self, name: str) -> Incarnation | None:
        incarnation = self._live.get(name)
        there = incarnation is not None and (incarnation.registrations or incarnation.shelf)
        return incarnation if there else None

    def live(self) -> list[Incarnation]:
        return list(self._live.values())

    def all(self) -> list[Incarnation]:
        return list(self._by_key.values())

    def registrants(self, kind: Kind, resource: str) -> Iterable[Incarnation]:
        return self._topics.get((kind, resource), {}).values()

    def resources(self) -> Iterator[tuple[Kind, str, Iterable[Incarnation]]]:
        return ((kind, resource, holders.values()) for (kind, resource), holders in self._topics.items())

    def type_of(self, topic: str) -> str:
        return self._types.get(topic, ANY_TYPE)

    def types(self) -> Iterable[tuple[str, str]]:
        """Return the types of topics, including topics without a node, like the ROS master."""
        return self._types.items()

    @property
    def tells_parameters(self) -> bool:
        return bool(self._subscribed_keys)

    def subscribed_below(self, key: str) -> list[str]:
        keys, above = self._subscribed_keys, key.rstrip("/")
        # All keys that begin with `above/` are adjacent. `above0` is after them, because '0' follows '/' in ASCII.
        below = keys[bisect_left(keys, f"{above}/") : bisect_left(keys, f"{above}0")]
        return [found for found in below if found != "/"]

    def nodes_of(self, host: Address) -> int:
        return self._nodes_of.get(host, 0)

    def room_for(self, name: str, host: Address, api_text: str) -> Incarnation | None:
        """Return the unused or lost incarnation that a new one replaces at its host's limit; None if there is room.

        Raises `HostFullError`.
        """
        if self.nodes_of(host) < self._most_of_host or self.find(name, host, api_text) is not None:
            return None
        evicted = self._evictable_of(host)
        if evicted is None:
            raise HostFullError(
                f"{host} has {self._most_of_host} nodes, the limit for one host: raise limits.nodes_per_host"
            )
        return evicted

    def _evictable_of(self, host: Address) -> Incarnation | None:
        mine = [incarnation for incarnation in self._by_key.values() if incarnation.host == host]
        idle = next((incarnation for incarnation in mine if incarnation.evictable), None)
        gone = (incarnation for incarnation in mine if incarnation.life is not Life.LIVE)
        return idle or min(gone, key=lambda incarnation: incarnation.changed, default=None)

    def evictable_for(self, host: Address, *, lost_before: float) -> Incarnation | None:
        """Return an evictable or lost incarnation of this host, or else one of another host: evictable, or lost longest
        and before `lost_before` (monotonic seconds).
        """
        known = self._by_key.values()
        idle = next((incarnation for incarnation in known if incarnation.evictable), None)
        away = (one for one in known if one.life is Life.SHADOW and one.changed < lost_before)
        return self._evictable_of(host) or idle or min(away, key=lambda one: one.changed, default=None)

    @property
    def registrations(self) -> int:
        return self._registrations_of.total()

    def registrations_by_host(self) -> Iterable[tuple[Address, int]]:
        return self._registrations_of.items()

    def registrations_of(self, host: Address) -> int:
        return self._registrations_of.get(host, 0)

    def machines(self) -> dict[str, int]:
        return Counter(
            str(one.host) for one in self._by_key.values() if one.life is Life.LIVE and not one.own
        )

    def in_order(self) -> Iterator[tuple[Incarnation, NodeRegistration]]:
        pairs = [
            (incarnation, registration)
            for incarnation in self._live.values()
            for registration in incarnation.registrations.values()
        ]
        return iter(sorted(pairs, key=lambda pair: pair[1].order))

    def uris_for(self, reader: Incarnation, kind: Kind, topic: str, *, hidden: bool) -> tuple[str, ...]:
        """Return URIs for `reader`; its own entry is the URI that it registered.

        The appliance's own nodes reach other nodes only through the appliance.
        """
        return tuple(
            incarnation.api_text
            if incarnation is reader
            else incarnation.uri_for(reader.told, hidden=hidden or reader.own)
            for incarnation in self.registrants(kind, topic)
        )

    # --- changing ---

    def add(self, incarnation: Incarnation) -> None:
        self._know(incarnation)
        self.mark(incarnation)

    def _know(self, incarnation: Incarnation) -> None:
        self.version += 1
        self._by_key[incarnation.key] = incarnation
        self._known[incarnation.name, incarnation.host, incarnation.api_text] = incarnation
        self._nodes_of[incarnation.host] += 1

    def reached_at(self, incarnation: Incarnation, told: str) -> None:
        if incarnation.told != told:
            incarnation.told = told
            self.mark(incarnation)

    def restore(self, incarnation: Incarnation) -> None:
        self._know(incarnation)
        self._registrations_of[incarnation.host] += len(incarnation.registrations)
        for registration in incarnation.registrations.values():
            self._order = max(self._order, registration.order)
        if incarnation.life is Life.LIVE:
            if self.occupant(incarnation.name) is None:
                self._live[incarnation.name] = incarnation
            for registration in incarnation.registrations.values():
                self._index(incarnation, registration)

    def register(self, incarnation: Incarnation, kind: Kind, resource: str, detail: str) -> None:
        self.version += 1
        self._live[incarnation.name] = incarnation
        registration = incarnation.registrations.get((kind, resource))
        if registration is None or registration.detail != detail:
            self._order += 1
            order = registration.order if registration is not None else self._order
            self._registrations_of[incarnation.host] += registration is None
            registration = NodeRegistration(kind, resource, detail, order)
            incarnation.registrations[kind, resource] = registration
            self.mark(RegistrationKey(incarnation, kind, resource))
        self._index(incarnation, registration)
        self.unshelve(incarnation, kind, resource)

    def shelve(self, incarnation: Incarnation, registration: NodeRegistration) -> None:
        incarnation.shelf[registration.kind, registration.resource] = registration
        self.mark(RegistrationKey(incarnation, registration.kind, registration.resource, shelved=True))

    def unshelve(self, incarnation: Incarnation, kind: Kind, resource: str) -> None:
        if incarnation.shelf.pop((kind, resource), None) is not None:
            self.mark(RegistrationKey(incarnation, kind, resource, shelved=True))

    def unregister(self, incarnation: Incarnation, kind: Kind, resource: str) -> None:
        if incarnation.registrations.pop((kind, resource), None) is None:
            return
        self.version += 1
        self._registrations_of[incarnation.host] -= 1
        self._unindex(incarnation, kind, resource)
        self.mark(RegistrationKey(incarnation, kind, resource))

    def replace(self, incarnation: Incarnation, when: float) -> None:
        for kind, resource in list(incarnation.registrations):
            self.unregister(incarnation, kind, resource)
        self._retire(incarnation, Life.REPLACED, when)

    def overshadow(self, incarnation: Incarnation, when: float) -> None:
        for kind, resource in incarnation.registrations:
            self._unindex(incarnation, kind, resource)
        self._retire(incarnation, Life.SHADOW, when)

    def revive(self, incarnation: Incarnation, when: float) -> None:
        self.version += 1
        incarnation.life, incarnation.changed = Life.LIVE, when
        self._live[incarnation.name] = incarnation
        for registration in incarnation.registrations.values():
            self._index(incarnation, registration)
        self.mark(incarnation)

    def forget(self, incarnation: Incarnation) -> None:
        self.version += 1
        for kind, resource in incarnation.registrations:
            self._unindex(incarnation, kind, resource)
        if self._live.get(incarnation.name) is incarnation:
            del self._live[incarnation.name]
        if self._by_key.pop(incarnation.key, None) is not None:
            self._nodes_of[incarnation.host] -= 1
            self._registrations_of[incarnation.host] -= len(incarnation.registrations)
        identity = incarnation.name, incarnation.host, incarnation.api_text
        if self._known.get(identity) is incarnation:
            del self._known[identity]
        incarnation.life = Life.FORGOTTEN
        self.mark(incarnation)

    def _retire(self, incarnation: Incarnation, life: Life, when: float) -> None:
        self.version += 1
        incarnation.life, incarnation.changed = life, when
        if self._live.get(incarnation.name) is incarnation:
            del self._live[incarnation.name]
        self.mark(incarnation)

    def _index(self, incarnation: Incarnation, registration: NodeRegistration) -> None:
        holders = self._topics.setdefault((registration.kind, registration.resource), {})
        if not holders and registration.kind is Kind.PARAMETER:
            insort(self._subscribed_keys, registration.resource)
        holders[incarnation.key] = incarnation
        self._note_type(registration)

    def _note_type(self, registration: NodeRegistration) -> None:
        kind, topic, told = registration.kind, registration.resource, registration.detail
        if kind not in OF_TOPICS:
            return
        self._unused_types.pop(topic, None)
        publishes, known = kind is Kind.PUBLICATION, topic in self._types
        if (publishes or not known) if told != ANY_TYPE else (publishes and not known):
            self._types[topic] = told

    def adopt_types(self, types: Iterable[tuple[str, str]]) -> None:
        self.version += 1
        for topic, told in types:
            if self.type_of(topic) == ANY_TYPE:
                self._types[topic] = told
                if not self._has_topic(topic):
                    self._remember_unused(topic)

    def forget_types(self) -> None:
        self.version += 1
        for topic in self._unused_types:
            self._types.pop(topic, None)
        self._unused_types.clear()

    def _remember_unused(self, topic: str) -> None:
        self._unused_types[topic] = None
        if len(self._unused_types) > _MAX_UNUSED_TYPES:
            oldest = next(iter(self._unused_types))
            del self._unused_types[oldest]
            self._types.pop(oldest, None)

    def _has_topic(self, topic: str) -> bool:
        return any((kind, topic) in self._topics for kind in OF_TOPICS)

    def _unindex(self, incarnation: Incarnation, kind: Kind, resource: str) -> None:
        holders = self._topics.get((kind, resource))
        if holders is not None:
            holders.pop(incarnation.key, None)
            if not holders:
                del self._topics[kind, resource]
                if kind in OF_TOPICS and not self._has_topic(resource):
                    self._remember_unused(resource)
                if kind is Kind.PARAMETER:
                    del self._subscribed_keys[bisect_left(self._subscribed_keys, resource)]


def new_key() -> str:
    """Return 128 random bits, so that the master-side URI of an incarnation cannot be guessed."""
    return secrets.token_hex(16)
