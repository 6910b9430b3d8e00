"""The state that control wants: incarnations, publications, services, and the grants for them.

Between `StateBegan` and `StateEnded`, earlier facts stay valid, so a restart of control interrupts no connection.
`StateEnded` withdraws the facts that were not stated again. If control dies before it, nothing is withdrawn.
"""

from collections import Counter
from dataclasses import dataclass

from appliance.channel import messages
from appliance.quotas.pool import QuotaClass
from appliance.relay.loop import ANYBODY, UNKNOWN

PeerGrant = tuple[str, str, str, str, str]
"""A peer's grant: `topic` or `service`, the incarnation's key, the name of the topic or service, host, caller id."""


@dataclass(frozen=True)
class ServiceEndpoint:
    """The address of a service, and the node that offers it; `own`: the appliance's own node."""

    key: str
    service: str
    host: str
    port: int
    node: str
    own: bool


class GrantTable:
    """The facts that control has stated."""

    def __init__(self) -> None:
        self._facts: dict[messages.Fact, messages.Message] = {}
        self._by_key: dict[str, dict[messages.Fact, None]] = {}
        self._hosts: Counter[str] = Counter()
        self._named: set[str] = set()  # hosts that the policy names, according to their last statement
        self._clients: dict[messages.Fact, dict[str, None]] = {}  # names of clients by service and host
        self._restated: set[messages.Fact] | None = None
        self._epoch = 0

    @property
    def restating(self) -> bool:
        return self._restated is not None

    def begin(self, epoch: int) -> None:
        self._restated = set()
        self._epoch = epoch

    def end(self, epoch: int) -> list[messages.Fact]:
        if self._restated is None or epoch != self._epoch:
            return []
        gone = [fact for fact in self._facts if fact not in self._restated]
        self._restated = None
        for fact in gone:
            self.withdraw(fact)
        return gone

    def state(self, message: messages.RelayFact) -> None:
        fact = messages.identity(message)
        self._take_out(fact)
        self._facts[fact] = message
        self._by_key.setdefault(fact[1], {})[fact] = None
        self._hosts[_host(fact, message)] += 1
        self._name(message)
        if isinstance(message, messages.ClientGranted):
            self._clients.setdefault(fact[:4], {})[message.caller_id] = None
        if self._restated is not None:
            self._restated.add(fact)

    def withdraw(self, fact: messages.Fact) -> None:
        for one in list(self._by_key.get(fact[1], ())) if fact[0] == "node" else (fact,):
            self._forget(one)

    def is_registered(self, host: str) -> bool:
        return self.quota_class(host) is QuotaClass.REGISTERED

    def quota_class(self, host: str) -> QuotaClass:
        return QuotaClass.REGISTERED if host in self._hosts else QuotaClass.UNKNOWN

    def payer(self, host: str) -> str:
        if host not in self._hosts:
            return UNKNOWN
        return host if host in self._named else ANYBODY

    def node(self, key: str) -> messages.NodePlaced | None:
        node = self._facts.get(("node", key))
        return node if isinstance(node, messages.NodePlaced) else None

    def publication(self, key: str, topic: str) -> messages.PublicationPlaced | None:
        publication = self._facts.get(("publication", key, topic))
        return publication if isinstance(publication, messages.PublicationPlaced) else None

    def service(self, key: str, service: str) -> ServiceEndpoint | None:
        placed = self._facts.get(("service", key, service))
        if not isinstance(placed, messages.ServicePlaced):
            return None
        node = self.node(key)
        name, own = (key, False) if node is None else (node.name, node.monitors)
        return ServiceEndpoint(key, service, placed.host, placed.port, name, own)

    def grant(self, key: str, topic: str, host: str, caller_id: str) -> messages.GrantInstalled | None:
        grant = self._facts.get(("grant", key, topic, host, caller_id))
        return grant if isinstance(grant, messages.GrantInstalled) else None

    def may_call(self, key: str, service: str, host: str, caller_id: str) -> bool:
        return ("client", key, service, host, caller_id) in self._facts

    def asks(self, key: str, service: str, host: str, caller_id: str) -> bool:
        granted = self._facts.get(("client", key, service, host, caller_id))
        return not isinstance(granted, messages.ClientGranted) or granted.asks

    def client_of(self, key: str, service: str, host: str) -> str | None:
        return next(iter(self._clients.get(("client", key, service, host), ())), None)

    def _name(self, message: messages.RelayFact) -> None:
        if isinstance(message, messages.NodePlaced | messages.ServicePlaced):
            return
        if isinstance(message, messages.PublicationPlaced):
            node = self.node(message.key)
            host = "" if node is None else node.host
        else:
            host = message.host
        if message.named:
            self._named.add(host)
        else:
            self._named.discard(host)

    def _forget(self, fact: messages.Fact) -> None:
        self._take_out(fact)
        if self._restated is not None:
            self._restated.discard(fact)

    def _take_out(self, fact: messages.Fact) -> None:
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
        if isinstance(message, messages.ClientGranted):
            names = self._clients[fact[:4]]
            del names[fact[4]]
            if not names:
                del self._clients[fact[:4]]


def _host(fact: messages.Fact, message: messages.Message) -> str:
    return message.host if isinstance(message, messages.NodePlaced) else fact[3] if len(fact) > 3 else ""
