"""The registry: who is who, what each node registered, and who was told what.

An *incarnation* is one life of a node: its name and the API URI it registered with, from one host. It holds the
two faces and the relay port that stand for the node. The registry is plain state: it does no I/O and has no clock;
every change returns what is to be kept of it (`Durable`), for `enactor` to carry out.

Invariants:

1. At most one incarnation of a name is *live*; it alone holds the name. An earlier one is *replaced* and never
   comes back.
2. A live incarnation that does not answer any more becomes a *shadow*: its registrations are kept but count for
   nobody until it returns or expires. A shadow does not hold its name.
3. A registration has the order in which it was made; a rebuilt ROSMaster is given them in that order.
4. Keys and ports are never given to another incarnation while this one is known.
"""

import enum
import secrets
from bisect import bisect_left, insort
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

from appliance.channel import rosout_address
from appliance.policy.model import Address
from roswire.uris import NodeUri, node_uri

ANY_TYPE = "*"
"""The type of a topic for who takes any."""

_MOST_UNUSED_TYPES = 10_000
"""Topics that nobody has whose types are known: names without end are no way to take memory."""

PUBLISHER_PATH = "/publisher/"
"""The path of the API of the appliance's own publisher, on the listener of the inner faces."""


class Kind(enum.StrEnum):
    """What can be registered."""

    PUBLICATION = "publication"
    SUBSCRIPTION = "subscription"
    SERVICE = "service"
    PARAMETER = "parameter"


_OF_TOPICS = (Kind.PUBLICATION, Kind.SUBSCRIPTION)


class Life(enum.StrEnum):
    """Where an incarnation stands."""

    LIVE = "live"
    SHADOW = "shadow"
    REPLACED = "replaced"


@dataclass(frozen=True, slots=True)
class Registration:
    """One thing a node registered; `detail` is the topic's type, or the service's `rosrpc` port."""

    kind: Kind
    resource: str
    detail: str
    order: int


@dataclass(slots=True)
class Incarnation:
    """One life of a node.

    `api` is the URI it gave (its host is a claim and never followed); `told` is the appliance's address that this
    node reaches us at, used in every URI we tell it. `own` marks the appliance's own nodes (the rosout aggregator).
    It has a port on every relay process: `relay_port` on the first, `more_relay_ports` on the others.
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
    life: Life = Life.LIVE
    changed: float = 0.0  # monotonic seconds when `life` changed, or of the start if that was before it
    touched: float = 0.0  # monotonic seconds of its last registering call
    registrations: dict[tuple[Kind, str], Registration] = field(default_factory=dict)
    shelf: dict[tuple[Kind, str], Registration] = field(default_factory=dict)  # what the policy took back
    told_lists: dict[str, tuple[str, ...]] = field(default_factory=dict)
    more_relay_ports: tuple[int, ...] = ()
    calls: int = 0  # registering calls of it that are under way

    @property
    def spare(self) -> bool:
        """Whether it has nothing, was taken nothing from, and asks for nothing now."""
        return not (self.registrations or self.shelf or self.calls or self.own) or self.life is Life.REPLACED

    @property
    def of_monitors(self) -> bool:
        """Whether this is the appliance's own publisher of what monitors publish."""
        return self.own and self.api.path == PUBLISHER_PATH

    @property
    def relay_ports(self) -> tuple[int, ...]:
        """Its port on each relay process."""
        return (self.relay_port, *self.more_relay_ports)

    @property
    def ports(self) -> tuple[int, ...]:
        """Every port that stands for it."""
        return (self.outer_port, *self.relay_ports)

    @property
    def real_uri(self) -> str:
        """The node's own API at its peer address (told only where nothing is mediated)."""
        return node_uri(str(self.host), self.api.port, self.api.path)

    @property
    def call_uri(self) -> NodeUri:
        """Where the appliance calls the node: at its peer address, whatever host it claimed; our own at `own_node`."""
        host = rosout_address.ADDRESS if self.own and not self.of_monitors else str(self.host)
        return NodeUri("http", host, self.api.port, self.api.path)

    def outer_uri(self, told: str) -> str:
        """The URI other nodes know this one by, as seen by somebody who reaches the appliance at `told`."""
        return node_uri(told, self.outer_port)

    def uri_for(self, told: str, *, hidden: bool) -> str:
        """The outer URI when `hidden`, else the real one; the appliance's own nodes have no other for anybody."""
        return self.outer_uri(told) if hidden or self.own else self.real_uri

    def in_order(self) -> list[Registration]:
        """What it registered, in the order in which it did."""
        return sorted(self.registrations.values(), key=lambda registration: registration.order)

    def resources(self, kind: Kind) -> list[str]:
        """What it registered of that kind, in order."""
        return [
            registration.resource for registration in self.registrations.values() if registration.kind is kind
        ]


@dataclass(frozen=True, slots=True)
class SaveNode:
    """Keep an incarnation: it is new, or its `life` or its ports have changed."""

    node: Incarnation


@dataclass(frozen=True, slots=True)
class EraseNode:
    """The incarnation and all its registrations are gone."""

    key: str


@dataclass(frozen=True, slots=True)
class SaveRegistration:
    """Keep a registration of the incarnation with this key; `shelved` is one that the policy took back."""

    key: str
    registration: Registration
    shelved: bool = False


@dataclass(frozen=True, slots=True)
class EraseRegistration:
    """A registration is gone, or is not remembered on the shelf any more."""

    key: str
    kind: Kind
    resource: str
    shelved: bool = False


Durable = SaveNode | EraseNode | SaveRegistration | EraseRegistration


class Registry:
    """All incarnations that are known, by key, by name and by topic."""

    def __init__(self) -> None:
        self._by_key: dict[str, Incarnation] = {}
        self._known: dict[tuple[str, Address, str], Incarnation] = {}
        self._live: dict[str, Incarnation] = {}
        self._topics: dict[tuple[Kind, str], dict[str, Incarnation]] = {}
        self._types: dict[str, str] = {}  # of topics, as ROSMaster has them
        self._unused_types: dict[str, None] = {}  # of topics that nobody has any more, the oldest first
        self._subscribed_keys: list[str] = []  # the parameters of `_topics`, sorted
        self._nodes_of: Counter[Address] = Counter()
        self._registrations_of: Counter[Address] = Counter()
        self._order = 0
        self.version = 0  # another after every change

    # --- looking ---

    def by_key(self, key: str) -> Incarnation | None:
        """The incarnation with this key, whatever its life."""
        return self._by_key.get(key)

    def find(self, name: str, host: Address, api_text: str) -> Incarnation | None:
        """The incarnation that registered as `name` from `host` with this API URI."""
        return self._known.get((name, host, api_text))

    def holder(self, name: str) -> Incarnation | None:
        """The live incarnation that holds a name: one with at least one registration."""
        incarnation = self._live.get(name)
        return incarnation if incarnation is not None and incarnation.registrations else None

    def occupant(self, name: str) -> Incarnation | None:
        """The live incarnation that holds a name, or would if it were given back what the policy took from it."""
        incarnation = self._live.get(name)
        there = incarnation is not None and (incarnation.registrations or incarnation.shelf)
        return incarnation if there else None

    def live(self) -> list[Incarnation]:
        """All live incarnations."""
        return list(self._live.values())

    def all(self) -> list[Incarnation]:
        """Every incarnation that is known."""
        return list(self._by_key.values())

    def registered(self, kind: Kind, resource: str) -> Iterable[Incarnation]:
        """Live incarnations that registered this resource, in the order of registration."""
        return self._topics.get((kind, resource), {}).values()

    def resources(self) -> Iterator[tuple[Kind, str, Iterable[Incarnation]]]:
        """All that live incarnations registered, with who did."""
        return ((kind, resource, holders.values()) for (kind, resource), holders in self._topics.items())

    def type_of(self, topic: str) -> str:
        """The type of a topic: what the last publisher said, else the first subscriber that named one."""
        return self._types.get(topic, ANY_TYPE)

    def types(self) -> Iterable[tuple[str, str]]:
        """Every topic and its type; also of topics that nobody has any more, as ROSMaster remembers them."""
        return self._types.items()

    @property
    def tells_parameters(self) -> bool:
        """Whether live incarnations subscribed to any parameter."""
        return bool(self._subscribed_keys)

    def subscribed_below(self, key: str) -> list[str]:
        """The keys of parameters below `key` that live incarnations subscribed to, sorted."""
        keys, above = self._subscribed_keys, key.rstrip("/")
        # Those that begin with `above/` stand together, before `above0`: '0' follows '/'.
        below = keys[bisect_left(keys, f"{above}/") : bisect_left(keys, f"{above}0")]
        return [found for found in below if found != "/"]

    def nodes_of(self, host: Address) -> int:
        """How many incarnations of a host are known (for the limit per host)."""
        return self._nodes_of.get(host, 0)

    def spare_of(self, host: Address) -> Incarnation | None:
        """The incarnation of a host that makes room first: one that has nothing, else the one that was lost first."""
        mine = [incarnation for incarnation in self._by_key.values() if incarnation.host == host]
        idle = next((incarnation for incarnation in mine if incarnation.spare), None)
        gone = (incarnation for incarnation in mine if incarnation.life is not Life.LIVE)
        return idle or min(gone, key=lambda incarnation: incarnation.changed, default=None)

    def spare(self, host: Address) -> Incarnation | None:
        """The incarnation that makes room for one of this host: of it, or of another host one that has nothing."""
        return self.spare_of(host) or next(
            (incarnation for incarnation in self._by_key.values() if incarnation.spare), None
        )

    @property
    def registrations(self) -> int:
        """How many registrations all hosts have."""
        return self._registrations_of.total()

    def registrations_by_host(self) -> Iterable[tuple[Address, int]]:
        """How many registrations each host has."""
        return self._registrations_of.items()

    def registrations_of(self, host: Address) -> int:
        """How many registrations a host has (for the limit per host)."""
        return self._registrations_of.get(host, 0)

    def in_order(self) -> Iterator[tuple[Incarnation, Registration]]:
        """Every registration of live incarnations, in the order they were made."""
        pairs = [
            (incarnation, registration)
            for incarnation in self._live.values()
            for registration in incarnation.registrations.values()
        ]
        return iter(sorted(pairs, key=lambda pair: pair[1].order))

    def uris_for(self, reader: Incarnation, kind: Kind, topic: str, *, hidden: bool) -> tuple[str, ...]:
        """The URIs of a topic's publishers or subscribers as `reader` is told them.

        Its own entry is its own real URI, as it gave it; the others' are as `Incarnation.uri_for` has them. The
        appliance's own nodes reach others through the appliance only.
        """
        return tuple(
            incarnation.api_text
            if incarnation is reader
            else incarnation.uri_for(reader.told, hidden=hidden or reader.own)
            for incarnation in self.registered(kind, topic)
        )

    # --- changing ---

    def add(self, incarnation: Incarnation) -> list[Durable]:
        """Make a new incarnation known; it holds nothing yet."""
        self.version += 1
        self._by_key[incarnation.key] = incarnation
        self._known[incarnation.name, incarnation.host, incarnation.api_text] = incarnation
        self._nodes_of[incarnation.host] += 1
        return [SaveNode(incarnation)]

    def restore(self, incarnation: Incarnation) -> None:
        """Put back an incarnation that was read from the store, with its registrations."""
        self.version += 1
        self._by_key[incarnation.key] = incarnation
        self._known[incarnation.name, incarnation.host, incarnation.api_text] = incarnation
        self._nodes_of[incarnation.host] += 1
        self._registrations_of[incarnation.host] += len(incarnation.registrations)
        for registration in incarnation.registrations.values():
            self._order = max(self._order, registration.order)
        if incarnation.life is Life.LIVE:
            if self.occupant(incarnation.name) is None:
                self._live[incarnation.name] = incarnation
            for registration in incarnation.registrations.values():
                self._index(incarnation, registration)

    def register(self, incarnation: Incarnation, kind: Kind, resource: str, detail: str) -> list[Durable]:
        """Record that ROSMaster took this registration."""
        kept: list[Durable] = []
        self.version += 1
        if incarnation.life is Life.SHADOW:  # it was lost while its call was under way
            kept += self.revive(incarnation, incarnation.changed)
        self._live[incarnation.name] = incarnation
        registration = incarnation.registrations.get((kind, resource))
        if registration is None or registration.detail != detail:
            self._order += 1
            order = registration.order if registration is not None else self._order
            self._registrations_of[incarnation.host] += registration is None
            registration = Registration(kind, resource, detail, order)
            incarnation.registrations[kind, resource] = registration
            kept.append(SaveRegistration(incarnation.key, registration))
        self._index(incarnation, registration)
        return kept + self.unshelve(incarnation, kind, resource)

    def shelve(self, incarnation: Incarnation, registration: Registration) -> list[Durable]:
        """Remember what the policy took back: should it be granted again, the node would not ask for it."""
        incarnation.shelf[registration.kind, registration.resource] = registration
        return [SaveRegistration(incarnation.key, registration, shelved=True)]

    def unshelve(self, incarnation: Incarnation, kind: Kind, resource: str) -> list[Durable]:
        """It is registered again, or the node gave it up; nothing to be kept if it was not on the shelf."""
        if incarnation.shelf.pop((kind, resource), None) is None:
            return []
        return [EraseRegistration(incarnation.key, kind, resource, shelved=True)]

    def unregister(self, incarnation: Incarnation, kind: Kind, resource: str) -> list[Durable]:
        """Record that a registration is gone; nothing to be kept if there was none."""
        if incarnation.registrations.pop((kind, resource), None) is None:
            return []
        self.version += 1
        self._registrations_of[incarnation.host] -= 1
        self._unindex(incarnation, kind, resource)
        return [EraseRegistration(incarnation.key, kind, resource)]

    def replace(self, incarnation: Incarnation, when: float) -> list[Durable]:
        """Another incarnation took the name: this one's registrations are gone."""
        kept = [
            kept
            for kind, resource in list(incarnation.registrations)
            for kept in self.unregister(incarnation, kind, resource)
        ]
        return kept + self._retire(incarnation, Life.REPLACED, when)

    def overshadow(self, incarnation: Incarnation, when: float) -> list[Durable]:
        """The node does not answer: its registrations count for nobody until it returns."""
        for kind, resource in incarnation.registrations:
            self._unindex(incarnation, kind, resource)
        return self._retire(incarnation, Life.SHADOW, when)

    def revive(self, incarnation: Incarnation, when: float) -> list[Durable]:
        """A shadow answers again and its name is free: it is live as before."""
        self.version += 1
        incarnation.life, incarnation.changed = Life.LIVE, when
        self._live[incarnation.name] = incarnation
        for registration in incarnation.registrations.values():
            self._index(incarnation, registration)
        return [SaveNode(incarnation)]

    def forget(self, incarnation: Incarnation) -> list[Durable]:
        """Drop an incarnation for good; its ports may go to another."""
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
        return [EraseNode(incarnation.key)]

    def _retire(self, incarnation: Incarnation, life: Life, when: float) -> list[Durable]:
        self.version += 1
        incarnation.life, incarnation.changed = life, when
        incarnation.told_lists.clear()
        if self._live.get(incarnation.name) is incarnation:
            del self._live[incarnation.name]
        return [SaveNode(incarnation)]

    def _index(self, incarnation: Incarnation, registration: Registration) -> None:
        holders = self._topics.setdefault((registration.kind, registration.resource), {})
        if not holders and registration.kind is Kind.PARAMETER:
            insort(self._subscribed_keys, registration.resource)
        holders[incarnation.key] = incarnation
        self._note_type(registration)

    def _note_type(self, registration: Registration) -> None:
        """Take a topic's type as ROSMaster does: a publisher's, or a subscriber's and `*` where there is none yet."""
        kind, topic, told = registration.kind, registration.resource, registration.detail
        if kind not in _OF_TOPICS:
            return
        self._unused_types.pop(topic, None)
        publishes, known = kind is Kind.PUBLICATION, topic in self._types
        if (publishes or not known) if told != ANY_TYPE else (publishes and not known):
            self._types[topic] = told

    def adopt_types(self, types: Iterable[tuple[str, str]]) -> None:
        """Take what ROSMaster remembers: of topics from before control began."""
        self.version += 1
        for topic, told in types:
            self._types[topic] = told
            if not self._has_topic(topic):
                self._remember_unused(topic)

    def forget_types(self) -> None:
        """A new ROSMaster knows nothing of topics that nobody has."""
        self.version += 1
        for topic in self._unused_types:
            self._types.pop(topic, None)
        self._unused_types.clear()

    def _remember_unused(self, topic: str) -> None:
        self._unused_types[topic] = None
        if len(self._unused_types) > _MOST_UNUSED_TYPES:
            oldest = next(iter(self._unused_types))
            del self._unused_types[oldest]
            self._types.pop(oldest, None)

    def _has_topic(self, topic: str) -> bool:
        return any((kind, topic) in self._topics for kind in _OF_TOPICS)

    def _unindex(self, incarnation: Incarnation, kind: Kind, resource: str) -> None:
        holders = self._topics.get((kind, resource))
        if holders is not None:
            holders.pop(incarnation.key, None)
            if not holders:
                del self._topics[kind, resource]
                if kind in _OF_TOPICS and not self._has_topic(resource):
                    self._remember_unused(resource)
                if kind is Kind.PARAMETER:
                    del self._subscribed_keys[bisect_left(self._subscribed_keys, resource)]


def new_key() -> str:
    """A key for a new incarnation: 128 random bits, so that an inner URI cannot be guessed."""
    return secrets.token_hex(16)
