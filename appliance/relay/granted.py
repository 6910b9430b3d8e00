"""What control has stated: which incarnations, publications and services there are, and who may have them.

The relay decides nothing. This table answers two questions, "is there a grant for this peer?" and "what is at
this port?", and turns a restatement into withdrawals.

Invariants:
- Nothing is served that is not in the table.
- Between `StateBegan` and `StateEnded` everything stated before still holds, so a restarted control
  interrupts nobody; at `StateEnded` whatever was not said again is withdrawn. A `StateBegan` that is followed
  by another (control died in the middle) withdraws nothing.
- An incarnation that is withdrawn takes its publications, services and grants with it.
"""

from collections import Counter
from dataclasses import dataclass
from typing import NamedTuple

from appliance.channel.messages import (
    ClientGranted,
    ClientRevoked,
    GrantInstalled,
    GrantRevoked,
    Message,
    NodePlaced,
    NodeWithdrawn,
    PublicationPlaced,
    PublicationWithdrawn,
    ServicePlaced,
    ServiceWithdrawn,
)
from appliance.quotas.pool import Standing
from appliance.relay.loop import ANYBODY, UNKNOWN

Statement = NodePlaced | PublicationPlaced | ServicePlaced | GrantInstalled | ClientGranted
_Fact = tuple[str, ...]


class _About(NamedTuple):
    """A kind of facts: what states one, what withdraws it, and the fields of both that tell it from others."""

    stated: type[Statement]
    withdrawn: type[Message]
    fields: tuple[str, ...]


_ABOUT = {
    "node": _About(NodePlaced, NodeWithdrawn, ("key",)),
    "publication": _About(PublicationPlaced, PublicationWithdrawn, ("key", "topic")),
    "service": _About(ServicePlaced, ServiceWithdrawn, ("key", "service")),
    "grant": _About(GrantInstalled, GrantRevoked, ("key", "topic", "host", "caller_id")),
    "client": _About(ClientGranted, ClientRevoked, ("key", "service", "host", "caller_id")),
}
_KINDS: dict[type, str] = {
    type_: kind for kind, about in _ABOUT.items() for type_ in (about.stated, about.withdrawn)
}


@dataclass(frozen=True)
class Service:
    """Where a service really is, and the node that offers it."""

    key: str
    service: str
    host: str
    port: int
    node: str
    """The name of the node that offers it."""


class StatedTable:
    """Control's statements, as one table that can be restated."""

    def __init__(self) -> None:
        self._facts: dict[_Fact, Message] = {}
        self._by_key: dict[str, dict[_Fact, None]] = {}
        self._hosts: Counter[str] = Counter()
        self._named: set[str] = set()  # hosts that the policy names, by what was stated last
        self._clients: dict[_Fact, dict[str, None]] = {}  # names, by service and host
        self._restated: set[_Fact] | None = None
        self._epoch = 0

    @property
    def restating(self) -> bool:
        """Whether a restatement is under way."""
        return self._restated is not None

    def begin(self, epoch: int) -> None:
        """A restatement starts."""
        self._restated = set()
        self._epoch = epoch

    def end(self, epoch: int) -> list[Message]:
        """The restatement is over: the withdrawals of what was not said again, already taken from the
        table."""
        if self._restated is None or epoch != self._epoch:
            return []
        gone = [fact for fact in self._facts if fact not in self._restated]
        self._restated = None
        withdrawals = [_ABOUT[kind].withdrawn(*about) for kind, *about in gone]
        for message in withdrawals:
            self.withdraw(message)
        return withdrawals

    def state(self, message: Statement) -> None:
        """Control says that something is so."""
        fact = _fact(message)
        self._take_out(fact)
        self._facts[fact] = message
        self._by_key.setdefault(fact[1], {})[fact] = None
        self._hosts[_host(fact, message)] += 1
        self._name(message)
        if isinstance(message, ClientGranted):
            self._clients.setdefault(fact[:4], {})[message.caller_id] = None
        if self._restated is not None:
            self._restated.add(fact)

    def withdraw(self, message: Message) -> None:
        """Control says that something is so no longer; unknown things are fine."""
        if isinstance(message, NodeWithdrawn):
            for fact in list(self._by_key.get(message.key, ())):
                self._forget(fact)
        else:
            self._forget(_fact(message))

    def standing(self, host: str) -> Standing:
        """A host with a node or a grant has a registration; what the policy says of others is not known here."""
        return Standing.REGISTERED if host in self._hosts else Standing.STRANGER

    def payer(self, host: str) -> str:
        """Return who pays for the processor time of a host: it itself, or all hosts together that no rule names."""
        if host not in self._hosts:
            return UNKNOWN
        return host if host in self._named else ANYBODY

    def node(self, key: str) -> NodePlaced | None:
        """The incarnation behind a key."""
        node = self._facts.get(("node", key))
        return node if isinstance(node, NodePlaced) else None

    def publication(self, key: str, topic: str) -> PublicationPlaced | None:
        """The publication of a topic by an incarnation."""
        publication = self._facts.get(("publication", key, topic))
        return publication if isinstance(publication, PublicationPlaced) else None

    def service(self, key: str, service: str) -> Service | None:
        """Where an incarnation's service is."""
        placed = self._facts.get(("service", key, service))
        if not isinstance(placed, ServicePlaced):
            return None
        node = self.node(key)
        return Service(key, service, placed.host, placed.port, key if node is None else node.name)

    def may_subscribe(self, key: str, topic: str, host: str, caller_id: str) -> bool:
        """Whether this subscriber may have this topic of that incarnation."""
        return ("grant", key, topic, host, caller_id) in self._facts

    def grant(self, key: str, topic: str, host: str, caller_id: str) -> GrantInstalled | None:
        """The grant of this subscriber for this topic of that incarnation."""
        grant = self._facts.get(("grant", key, topic, host, caller_id))
        return grant if isinstance(grant, GrantInstalled) else None

    def may_call(self, key: str, service: str, host: str, caller_id: str) -> bool:
        """Whether this client may call this service of that incarnation."""
        return ("client", key, service, host, caller_id) in self._facts

    def client_of(self, key: str, service: str, host: str) -> str | None:
        """A name under which this host may call this service; None when it may not."""
        return next(iter(self._clients.get(("client", key, service, host), ())), None)

    def _name(self, message: Statement) -> None:
        """Note whether the policy names the host of a statement."""
        if isinstance(message, NodePlaced | ServicePlaced):
            return
        if isinstance(message, PublicationPlaced):
            node = self.node(message.key)
            host = "" if node is None else node.host
        else:
            host = message.host
        if message.named:
            self._named.add(host)
        else:
            self._named.discard(host)

    def _forget(self, fact: _Fact) -> None:
        self._take_out(fact)
        if self._restated is not None:
            self._restated.discard(fact)

    def _take_out(self, fact: _Fact) -> None:
        message = self._facts.pop(fact, None)
        if message is not None:
            of_key = self._by_key[fact[1]]
            del of_key[fact]
            if not of_key:
                del self._by_key[fact[1]]
            host = _host(fact, message)
            self._hosts[host] -= 1
            if not self._hosts[host]:
                del self._hosts[host]
                self._named.discard(host)
        if isinstance(message, ClientGranted):
            names = self._clients[fact[:4]]
            del names[fact[4]]
            if not names:
                del self._clients[fact[:4]]


def _fact(message: Message) -> _Fact:
    """What a statement, or its withdrawal, is about."""
    kind = _KINDS.get(type(message))
    if kind is None:
        raise TypeError(f"{type(message).__name__} withdraws nothing")
    return (kind, *(getattr(message, field) for field in _ABOUT[kind].fields))


def _host(fact: _Fact, message: Message) -> str:
    """The host that a statement is about; empty where it names none of its own."""
    return message.host if isinstance(message, NodePlaced) else fact[3] if len(fact) > 3 else ""
