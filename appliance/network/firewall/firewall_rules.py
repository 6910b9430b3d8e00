"""The rules of the firewall, as data: what is refused, and in which chain. No I/O.

Invariants:

1. The appliance's own rules only ever *refuse* (or RETURN to the rules of others): installing them opens
   nothing that another firewall on the machine has closed.
2. A connection is refused at its first packet, a SYN without ACK, whatever the connection tracker thinks of
   it: no `NOTRACK` rule opens the port, and packets of sockets already closed are left alone (rejecting
   those makes them linger).
3. Who may connect is said positively, then all others are refused. A packet whose owner is unknown is
   refused.
4. What counts the connections of a host counts those that it has answered in: the address of a first packet can be
   anybody's, and he must not pay for it.
"""

import ipaddress
from collections.abc import Iterator
from dataclasses import KW_ONLY, dataclass
from enum import StrEnum
from functools import partial
from typing import Literal, NamedTuple

Family = Literal[4, 6]
MAX_PORT = 65535


class Chain(StrEnum):
    """The chains of the appliance; each is hooked into the kernel where HOOKS says."""

    IN = "ROSRV-IN"
    OUT = "ROSRV-OUT"
    FORWARD = "ROSRV-FWD"
    NAT = "ROSRV-NAT"
    SOURCE_NAT = "ROSRV-SNAT"
    ARRIVING = "ROSRV-PRE"
    KEPT_SOURCE = "ROSRV-KEEP"
    LEAVING = "ROSRV-POST"


class Hook(NamedTuple):
    """Where the kernel tries a chain: chains of one place in the order of their priorities, smallest first."""

    place: str
    kind: Literal["filter", "nat"] = "filter"
    priority: int = 0


# A connection takes the first translation that any chain of the kind `nat` gives it, whoever made the chain. Everybody
# else's are at 100 (firewalld's at 110); none may be before -199.
HOOKS: dict[Chain, tuple[Hook, ...]] = {
    Chain.IN: (Hook("INPUT"),),
    Chain.OUT: (Hook("OUTPUT"),),
    Chain.FORWARD: (Hook("FORWARD"),),
    Chain.NAT: (Hook("PREROUTING", "nat", -100), Hook("OUTPUT", "nat", -100)),
    Chain.SOURCE_NAT: (Hook("POSTROUTING", "nat", 100),),
    Chain.ARRIVING: (Hook("PREROUTING", priority=-300),),  # before the connection tracker
    Chain.KEPT_SOURCE: (Hook("POSTROUTING", "nat", -199),),
    Chain.LEAVING: (Hook("POSTROUTING", priority=300),),  # after all translation
}
COUNTED_MARK = 0x40000000  # the bit of the connection tracker's mark that says so
SOURCE_TRANSLATIONS = frozenset({"MASQUERADE", "SNAT", "NETMAP"})  # targets of iptables


class Verdict(StrEnum):
    """What becomes of a packet that matches."""

    RETURN = "RETURN"  # none of the appliance's business: on to the rules of others
    RESET = "RESET"  # TCP reset: the peer sees "connection refused"
    DROP = "DROP"
    DNAT = "DNAT"
    MASQUERADE = "MASQUERADE"
    COUNTED = "COUNTED"  # the connection is marked: what matches `answered` is no more true of it
    KEEP_SOURCE = "KEEP SOURCE"  # translated to the source it has: no later chain can give it another
    # TTL or hop limit 255, and on: a router that passes the packet on makes it smaller
    FULL_HOPS = "FULL HOPS"


@dataclass(frozen=True)
class PortRange:
    """Ports `first` to `last`, both included."""

    first: int
    last: int

    def __post_init__(self) -> None:
        if not 1 <= self.first <= self.last <= MAX_PORT:
            raise ValueError(
                f"{self.first}-{self.last} is no range of ports (1 to {MAX_PORT}, smaller first)"
            )

    @classmethod
    def one(cls, port: int) -> "PortRange":
        """Return the range of one port."""
        return cls(port, port)

    def overlaps(self, other: "PortRange") -> bool:
        """Return whether some port is in both."""
        return self.first <= other.last and other.first <= self.last

    def __str__(self) -> str:
        return str(self.first) if self.first == self.last else f"{self.first}-{self.last}"


@dataclass(frozen=True)
class Interface:
    """A network interface; with `other`, every interface but that one."""

    name: str
    other: bool = False

    def __str__(self) -> str:
        return f"not {self.name}" if self.other else self.name


@dataclass(frozen=True)
class RateLimit:
    """Where it stands in a rule: more than `per_second` new connections of one host, after a burst of `burst`."""

    per_second: int
    burst: int

    def __post_init__(self) -> None:
        if not (1 <= self.per_second <= 100_000 and 1 <= self.burst <= 100_000):
            raise ValueError("a rate limit takes 1 to 100000 new connections per second, and for the burst")


@dataclass(frozen=True)
class Rule:
    """One rule: it matches when everything that is given matches."""

    purpose: str  # shown by `rosrv status` and kept as the rule's comment; at most 100 characters
    verdict: Verdict
    _: KW_ONLY
    chain: Chain
    family: Family | None = None  # None: both
    arrives_on: Interface | None = None
    leaves_on: Interface | None = None
    source: str | None = None
    destination: str | None = None
    tcp_ports: PortRange | None = None
    udp_ports: PortRange | None = None
    from_ports: PortRange | None = None  # of TCP
    opening: bool = False  # a SYN without ACK
    accepting: bool = False  # a SYN with ACK: the answer of a socket that listens
    uid: int | None = None  # the owner of the local socket; chain OUT only
    clear_text: bool = False  # did not come (OUT: does not leave) through IPsec
    above: RateLimit | None = None
    local_destination: bool = False  # an address of this machine
    local_source: bool = False  # an address of this machine
    forwarded: bool | None = None  # chain LEAVING only: passed on for another machine (False: made here)
    distant: bool = False  # a router passed it on: its TTL or hop limit is below 255
    new_connection: bool = False  # as the connection tracker sees it
    unknown: bool = False  # of no connection that the tracker knows: new, untracked, invalid
    answered: bool = False  # of a connection, not counted yet, whose opener has answered our SYN-ACK
    translated: bool = False  # belongs to a connection whose destination was translated
    to: str | None = None  # of DNAT: the address

    def __post_init__(self) -> None:
        impossible = {
            "only TCP can be reset": self.verdict is Verdict.RESET and self.tcp_ports is None,
            "a packet is TCP or UDP, not both": self.udp_ports is not None and self.is_tcp,
            f"a packet has an owner in {Chain.OUT} only": self.uid is not None
            and self.chain is not Chain.OUT,
            f"where a packet came from is matched in {Chain.LEAVING} only": self.forwarded is not None
            and self.chain is not Chain.LEAVING,
            "a limit counts who has answered; others may be named by anybody": self.above is not None
            and not self.answered,
            "DNAT and its address go together": (self.verdict is Verdict.DNAT) != (self.to is not None),
        }
        for reason, is_so in impossible.items():
            if is_so:
                raise ValueError(f"rule {self.purpose!r}: {reason}")

    @property
    def is_tcp(self) -> bool:
        """Whether something of TCP's header is matched."""
        return self.tcp_ports is not None or self.from_ports is not None or self.opening or self.accepting

    def families(self) -> tuple[Family, ...]:
        """Return the families the rule is for: its own, that of its addresses, or both."""
        given = self.source or self.destination or self.to
        if given is not None:
            return (family_of(given),)
        return (4, 6) if self.family is None else (self.family,)

    def describe(self) -> str:
        """Return the matches and the verdict in words of netfilter, for people."""
        matches = {
            "in": self.arrives_on,
            "out": self.leaves_on,
            "source": self.source,
            "destination": self.destination,
            "tcp": self.tcp_ports,
            "udp": self.udp_ports,
            "from tcp": self.from_ports,
            "uid": self.uid,
            "above": f"{self.above.per_second}/s" if self.above else None,
        }
        words = [f"{name} {value}" for name, value in matches.items() if value is not None]
        flags = {
            "syn": self.opening,
            "syn ack": self.accepting,
            "no ipsec": self.clear_text,
            "to this machine": self.local_destination,
            "from this machine's address": self.local_source,
            "forwarded": self.forwarded is True,
            "made here": self.forwarded is False,
            "passed on by a router": self.distant,
            "new": self.new_connection,
            "of no known connection": self.unknown,
            "answered": self.answered,
            "translated": self.translated,
        }
        words += [name for name, is_held in flags.items() if is_held]
        return f"{', '.join(words) or 'all'} -> {self.verdict}{f' to {self.to}' if self.to else ''}"


@dataclass(frozen=True)
class Forwarder:
    """The local user that sends the audit log on, and the one receiver that it may reach."""

    uid: int
    address: str
    port: int
    datagrams: bool = False  # UDP, else TCP

    def __post_init__(self) -> None:
        PortRange.one(self.port)
        family_of(self.address)
        if self.uid < 0:
            raise ValueError(f"forwarder: {self.uid} is no user id")


@dataclass(frozen=True, kw_only=True)
class OwnNode:
    """The local user of the appliance's own node (rosout), who may reach it, and whom it may reach.

    It listens on every address, at a port that the kernel chooses for its node API and at one of `ports` for messages.
    So its API is called at `address`, one of loopback's that nobody else may connect to, and it takes no other
    connection but the relay's at `ports`. `master_port` (None: not known yet) is where it finds its master.
    """

    uid: int
    relay_uid: int
    address: str
    ports: PortRange
    master_port: int | None = None

    def __post_init__(self) -> None:
        family_of(self.address)
        if min(self.uid, self.relay_uid) < 0:
            raise ValueError(f"own node: {min(self.uid, self.relay_uid)} is no user id")


@dataclass(frozen=True, kw_only=True)
class FirewallSettings:
    """What the rules of the appliance's own namespace are built from.

    `rosmaster_port` and `inner_port` may be unknown (None) before their processes run: `Firewall.update`
    adds them. Hosts in `tunnel_only` are accepted through IPsec only: by the kernel's policy, or, when ESP
    runs in user space, on `tunnel_interface`. `api_networks` says who reaches the REST port besides
    loopback: nobody, if empty. `neighbours` are addresses of the machine at the other end of the link (isolation
    netns): only packets that it made itself may bear them, which come with a full TTL. `client_ports` are those
    that the kernel gives to whoever does not choose: the own nodes (rosout) listen there on every address, whatever
    ROS_IP says.
    """

    control_uid: int
    rosmaster_uid: int
    rosmaster_port: int | None = None
    inner_port: int | None = None
    own_node: OwnNode | None = None
    master_port: int = 11311
    node_ports: PortRange | None = None
    client_ports: PortRange | None = None
    api_port: int | None = None
    api_networks: tuple[str, ...] = ()
    neighbours: tuple[str, ...] = ()
    tunnel_only: tuple[str, ...] = ()
    tunnel_interface: str | None = None
    forwarder: Forwarder | None = None
    new_connections: RateLimit | None = RateLimit(per_second=1000, burst=2000)

    def __post_init__(self) -> None:
        for port in (self.rosmaster_port, self.inner_port, self.master_port, self.api_port):
            if port is not None:
                PortRange.one(port)
        for network in (*self.api_networks, *self.tunnel_only, *self.neighbours):
            family_of(network)
        for name in ("control_uid", "rosmaster_uid"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} {getattr(self, name)} is no user id")

    @property
    def api_ports(self) -> PortRange | None:
        """The REST port as a range; None without REST."""
        return None if self.api_port is None else PortRange.one(self.api_port)


LOOPBACK = Interface("lo")
OUTSIDE = Interface("lo", other=True)
_ANY_PORT = PortRange(1, MAX_PORT)

# What most rules share: first packets from outside, and those that local users send over loopback.
_arriving = partial(Rule, chain=Chain.IN, arrives_on=OUTSIDE, opening=True)
_connecting = partial(Rule, chain=Chain.OUT, leaves_on=LOOPBACK, opening=True)
_sending = partial(Rule, chain=Chain.OUT)


def appliance_rules(settings: FirewallSettings) -> tuple[Rule, ...]:
    """Return the rules of the appliance's namespace, in the order in which they are tried."""
    return (
        *(
            _arriving(
                f"{neighbour}: the machine's own packets only", Verdict.DROP, source=neighbour, distant=True
            )
            for neighbour in settings.neighbours
        ),
        *(
            rule
            for network in settings.tunnel_only
            for rule in _tunnel_only(network, settings.tunnel_interface)
        ),
        *inner_port("ROSMaster port", settings.rosmaster_port, "control", settings.control_uid),
        *inner_port("inner node face", settings.inner_port, "rosmaster", settings.rosmaster_uid),
        *_rosmaster(settings),
        *_own_node(settings),
        *_forwarding(settings.forwarder),
        *_api(settings),
        *_rate_limits(settings),
        *_chosen_by_the_kernel(settings),
    )


def family_of(address: str) -> Family:
    """Return the family of an address or network.

    Raises: ValueError, naming the text, if it is neither.
    """
    try:
        return 6 if ipaddress.ip_network(address).version == 6 else 4
    except ValueError as error:
        text = f"{address!r} is no address or network such as 10.1.2.3 or 10.1.2.0/24: {error}"
        raise ValueError(text) from None


def inner_port(name: str, port: int | None, user: str, uid: int) -> tuple[Rule, ...]:
    """Return the rules of a port that one local user alone may connect to, over loopback; none for None."""
    return () if port is None else _inner_ports(name, PortRange.one(port), user, uid)


def _inner_ports(name: str, ports: PortRange, user: str, uid: int) -> tuple[Rule, ...]:
    return (
        _arriving(f"{name}: not from outside", Verdict.RESET, tcp_ports=ports),
        _connecting(f"{name}: {user} may", Verdict.RETURN, tcp_ports=ports, uid=uid),
        _connecting(f"{name}: no other user", Verdict.RESET, tcp_ports=ports),
    )


def _rosmaster(settings: FirewallSettings) -> tuple[Rule, ...]:
    """Once the inner faces are there, ROSMaster connects to nothing else."""
    if settings.inner_port is None:
        return ()
    uid = settings.rosmaster_uid
    return (
        _connecting("rosmaster: connects to nothing else", Verdict.RESET, tcp_ports=_ANY_PORT, uid=uid),
        _sends_nothing_out("rosmaster", uid),
    )


def _own_node(settings: FirewallSettings) -> tuple[Rule, ...]:
    """Control alone calls the own node, and that reaches its master, faces and relays only."""
    node = settings.own_node
    if node is None:
        return ()
    api = partial(_sending, destination=node.address, tcp_ports=_ANY_PORT, opening=True)
    answer = partial(_sending, uid=node.uid, accepting=True)
    return (
        api("own node's API: control may", Verdict.RETURN, uid=settings.control_uid),
        api("own node's API: no other user", Verdict.RESET),
        *_inner_ports("own node's messages", node.ports, "relay", node.relay_uid),
        answer("own node: control is answered", Verdict.RETURN, source=node.address),
        answer("own node: the relay is answered", Verdict.RETURN, from_ports=node.ports),
        answer("own node: nobody else is answered", Verdict.DROP),
        *inner_port("own node's master", node.master_port, "rosout", node.uid),
        *_ports_of_others(node.uid, settings),
        _sends_nothing_out("own node", node.uid),
    )


def _ports_of_others(uid: int, settings: FirewallSettings) -> Iterator[Rule]:
    """What the own node has no business with: RVMaster's port, REST, low ports, and those of the kernel's choice.

    Not said positively: which ports the faces and relays have, a new policy may change.
    """
    chosen, faces = settings.client_ports, settings.node_ports
    if faces is not None and chosen is not None and faces.overlaps(chosen):
        yield _connecting("own node: faces and relays", Verdict.RETURN, tcp_ports=faces, uid=uid)
    closed = {
        "RVMaster port": PortRange.one(settings.master_port),
        "REST port": settings.api_ports,
        "low port": PortRange(1, 1023),
        "port of the kernel's choice": chosen,
    }
    for name, ports in closed.items():
        if ports is not None:
            yield _connecting(f"own node: no {name}", Verdict.RESET, tcp_ports=ports, uid=uid)


def _sends_nothing_out(name: str, uid: int) -> Rule:
    return _sending(f"{name}: sends nothing out", Verdict.DROP, leaves_on=OUTSIDE, uid=uid)


def _tunnel_only(network: str, interface: str | None) -> tuple[Rule, ...]:
    """An address that is taken from, and sent to, through its tunnel only."""
    outside = Interface(interface, other=True) if interface else None
    refused = partial(Rule, verdict=Verdict.DROP, clear_text=interface is None)
    return (
        refused(f"{network}: through its tunnel only", chain=Chain.IN, source=network, arrives_on=outside),
        refused(f"{network}: never in clear text", chain=Chain.OUT, destination=network, leaves_on=outside),
    )


def _forwarding(forwarder: Forwarder | None) -> tuple[Rule, ...]:
    """The forwarder's packets go to its receiver; whatever else its user sends goes nowhere."""
    if forwarder is None:
        return ()
    sending = partial(_sending, uid=forwarder.uid)
    ports = PortRange.one(forwarder.port)
    return (
        sending(
            "audit log's forwarder: its receiver",
            Verdict.RETURN,
            destination=forwarder.address,
            tcp_ports=None if forwarder.datagrams else ports,
            udp_ports=ports if forwarder.datagrams else None,
        ),
        sending("audit log's forwarder: nobody else", Verdict.DROP),
    )


def _api(settings: FirewallSettings) -> tuple[Rule, ...]:
    ports = settings.api_ports
    if ports is None:
        return ()
    return (
        *_rate_limit(settings.new_connections, "REST port", ports),
        *(
            _arriving(f"REST port: {network} may", Verdict.RETURN, source=network, tcp_ports=ports)
            for network in settings.api_networks
        ),
        _arriving("REST port: no other network", Verdict.RESET, tcp_ports=ports),
    )


def _rate_limits(settings: FirewallSettings) -> tuple[Rule, ...]:
    limit, nodes = settings.new_connections, settings.node_ports
    return (
        *_rate_limit(limit, "RVMaster port", PortRange.one(settings.master_port)),
        *(_rate_limit(limit, "node and relay ports", nodes) if nodes is not None else ()),
    )


def _chosen_by_the_kernel(settings: FirewallSettings) -> Iterator[Rule]:
    """Nobody outside has business with the ports of the own nodes; with those that were chosen, he may have."""
    if settings.client_ports is None:
        return
    chosen = {
        "RVMaster port": PortRange.one(settings.master_port),
        "node and relay ports": settings.node_ports,
        "REST port": settings.api_ports,
    }
    for name, ports in chosen.items():
        if ports is not None and ports.overlaps(settings.client_ports):
            yield _arriving(f"{name}: not one of the kernel's choice", Verdict.RETURN, tcp_ports=ports)
    yield _arriving("own nodes' ports: not from outside", Verdict.RESET, tcp_ports=settings.client_ports)


def _rate_limit(limit: RateLimit | None, name: str, ports: PortRange) -> tuple[Rule, ...]:
    """Count the connections of each host; what is above the limit is dropped, and sent again by the host's kernel.

    Counted is the first packet after the handshake, once for each connection: who sends it has received our SYN-ACK,
    so the address is not somebody else's. First packets are the kernel's affair: it remembers as many half-open
    connections as the listener asked for, and answers more of them with SYN cookies, which take no memory.
    """
    if limit is None:
        return ()
    established = partial(Rule, chain=Chain.IN, arrives_on=OUTSIDE, tcp_ports=ports, answered=True)
    return (
        established(f"{name}: new connections per host", Verdict.DROP, above=limit),
        established(f"{name}: counted", Verdict.COUNTED),
    )
