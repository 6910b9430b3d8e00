"""Define the rules of the firewall as data. No I/O.

1. The rules only refuse, or RETURN to the rules of other programs, so they open no port that others closed.
2. A connection is refused at its SYN, without the connection tracker, so a `NOTRACK` rule cannot open the port.
   Packets of closed sockets pass, because rejecting them would delay the end of a connection.
3. Packets without a known owner are refused.
"""

import ipaddress
from collections.abc import Iterator
from dataclasses import KW_ONLY, dataclass
from enum import StrEnum
from functools import partial
from typing import Literal, NamedTuple

from appliance.network.listening_sockets import TcpSocket

Family = Literal[4, 6]
MAX_PORT = 65535


class Chain(StrEnum):
    """A chain of netfilter; `HOOKS` has the hooks in the kernel."""

    IN = "ROSRV-IN"
    OUT = "ROSRV-OUT"
    FORWARD = "ROSRV-FWD"
    NAT = "ROSRV-NAT"
    SOURCE_NAT = "ROSRV-SNAT"
    ARRIVING = "ROSRV-PRE"
    KEPT_SOURCE = "ROSRV-KEEP"
    LEAVING = "ROSRV-POST"
    HOLD = "ROSRV-HOLD"


class Hook(NamedTuple):
    """A hook; its chains run by priority, smallest first."""

    place: str
    kind: Literal["filter", "nat"] = "filter"
    priority: int = 0


# The first matching chain of type `nat` translates a connection, whichever program made the chain. Other programs use
# priority 100 (firewalld: 110); the kernel permits no priority below -199 for this type.
HOOKS: dict[Chain, tuple[Hook, ...]] = {
    Chain.IN: (Hook("INPUT"),),
    Chain.OUT: (Hook("OUTPUT"),),
    Chain.FORWARD: (Hook("FORWARD"),),
    Chain.NAT: (Hook("PREROUTING", "nat", -100), Hook("OUTPUT", "nat", -100)),
    Chain.SOURCE_NAT: (Hook("POSTROUTING", "nat", 100),),
    Chain.ARRIVING: (Hook("PREROUTING", priority=-300),),  # before the connection tracker
    Chain.KEPT_SOURCE: (Hook("POSTROUTING", "nat", -199),),
    Chain.LEAVING: (Hook("POSTROUTING", priority=300),),  # after all translation
    Chain.HOLD: (Hook("INPUT"),),
}
COUNTED_MARK = 0x40000000  # a bit of the connection tracker's mark
SOURCE_TRANSLATIONS = frozenset({"MASQUERADE", "SNAT", "NETMAP"})  # targets of iptables


class PacketVerdict(StrEnum):
    RETURN = "RETURN"  # continue with the rules of other programs
    RESET = "RESET"  # TCP reset: the peer sees "connection refused"
    DROP = "DROP"
    DNAT = "DNAT"
    MASQUERADE = "MASQUERADE"
    COUNTED = "COUNTED"  # mark the connection; `answered` no longer matches
    KEEP_SOURCE = "KEEP SOURCE"  # translate to the present source, so no later chain can translate it
    # Set the TTL or hop limit to 255 and continue; routers decrease it.
    FULL_HOPS = "FULL HOPS"


@dataclass(frozen=True)
class PortRange:
    """A range of ports that includes both ends."""

    first: int
    last: int

    def __post_init__(self) -> None:
        if not 1 <= self.first <= self.last <= MAX_PORT:
            raise ValueError(
                f"{self.first}-{self.last} is not a range of ports: give FIRST-LAST (1 to {MAX_PORT}, smaller first)"
            )

    @classmethod
    def one(cls, port: int) -> "PortRange":
        return cls(port, port)

    def __contains__(self, port: int) -> bool:
        return self.first <= port <= self.last

    def overlaps(self, other: "PortRange") -> bool:
        return self.first <= other.last and other.first <= self.last

    def __str__(self) -> str:
        return str(self.first) if self.first == self.last else f"{self.first}-{self.last}"


@dataclass(frozen=True)
class Interface:
    """An interface; `other` means every interface except this one."""

    name: str
    other: bool = False

    def __str__(self) -> str:
        return f"not {self.name}" if self.other else self.name


@dataclass(frozen=True)
class RateLimit:
    """A limit per host that matches new connections above `per_second`, after `burst`."""

    per_second: int
    burst: int

    def __post_init__(self) -> None:
        if not (1 <= self.per_second <= 100_000 and 1 <= self.burst <= 100_000):
            raise ValueError("a rate limit takes 1 to 100000 new connections per second, and for the burst")


@dataclass(frozen=True)
class PacketRule:
    """A rule that matches if all given conditions do."""

    purpose: str  # shown by `rosrv status` and kept as the rule's comment; at most 100 characters
    verdict: PacketVerdict
    _: KW_ONLY
    chain: Chain
    family: Family | None = None  # None: both families
    arrives_on: Interface | None = None
    leaves_on: Interface | None = None
    source: str | None = None
    destination: str | None = None
    tcp_ports: PortRange | None = None
    udp_ports: PortRange | None = None
    from_ports: PortRange | None = None  # TCP source ports
    opening: bool = False  # a SYN without ACK
    accepting: bool = False  # a SYN with ACK: the answer of a listening socket
    uid: int | None = None  # the owner of the local socket; chain OUT only
    clear_text: bool = False  # did not arrive (chain OUT: does not leave) through IPsec
    above: RateLimit | None = None
    local_destination: bool = False  # the destination is an address of this machine
    local_source: bool = False  # the source is an address of this machine
    forwarded: bool | None = None  # chain LEAVING only: forwarded for another machine (False: made here)
    distant: bool = False  # forwarded by a router: TTL or hop limit below 255
    new_connection: bool = False  # new to the connection tracker
    unknown: bool = False  # belongs to no tracked connection: new, untracked or invalid
    answered: bool = False  # belongs to an uncounted connection whose opener answered our SYN-ACK
    translated: bool = False  # belongs to a connection with a translated destination
    to: str | None = None  # for DNAT: the new destination address
    seconds: int | None = None  # matches for this time after it is installed, to one TCP port

    def __post_init__(self) -> None:
        impossible = {
            "only TCP can be reset": self.verdict is PacketVerdict.RESET and self.tcp_ports is None,
            "a packet is TCP or UDP, not both": self.udp_ports is not None and self.is_tcp,
            f"a packet has an owner in {Chain.OUT} only": self.uid is not None
            and self.chain is not Chain.OUT,
            f"where a packet came from is matched in {Chain.LEAVING} only": self.forwarded is not None
            and self.chain is not Chain.LEAVING,
            "a rate limit counts only sources that have answered; others can be forged": self.above
            is not None
            and not self.answered,
            "DNAT and its address go together": (self.verdict is PacketVerdict.DNAT) != (self.to is not None),
            "a rule for some seconds has one port": self.seconds is not None
            and (self.tcp_ports is None or self.tcp_ports.first != self.tcp_ports.last),
        }
        for reason, is_so in impossible.items():
            if is_so:
                raise ValueError(f"rule {self.purpose!r}: {reason}")

    @property
    def is_tcp(self) -> bool:
        return self.tcp_ports is not None or self.from_ports is not None or self.opening or self.accepting

    def refuses(self, socket: TcpSocket, *, accepted: bool, near: bool) -> bool:
        """Return whether it keeps such a connection from beginning, though perhaps an earlier rule permits it.

        `accepted`: this end did not open it. `near`: the other end is also on this machine.
        """
        interface = self.arrives_on or self.leaves_on
        here, there = (socket.local_address, socket.port), (socket.peer_address, socket.peer_port)
        source, destination = (there, here) if self.chain is Chain.IN else (here, there)
        return (
            self.verdict in (PacketVerdict.RESET, PacketVerdict.DROP)
            and (self.opening or self.accepting)
            and not self.distant
            and accepted == (self.accepting or self.chain is Chain.IN)
            and (interface is None or near != interface.other)
            and (self.source is None or _is_in(source[0], self.source))
            and (self.destination is None or _is_in(destination[0], self.destination))
            and (self.from_ports is None or source[1] in self.from_ports)
            and (self.tcp_ports is None or destination[1] in self.tcp_ports)
            and self.uid in (None, socket.uid)
        )

    def families(self) -> tuple[Family, ...]:
        given = self.source or self.destination or self.to
        if given is not None:
            return (family_of(given),)
        return (4, 6) if self.family is None else (self.family,)

    def describe(self) -> str:
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
            "seconds": self.seconds,
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


def _is_in(address: str, network: str) -> bool:
    return ipaddress.ip_address(address) in ipaddress.ip_network(network)


@dataclass(frozen=True)
class ForwarderAccess:
    """A user of this machine that may connect to one receiver, and to nothing else."""

    uid: int
    address: str
    port: int
    name: str
    datagrams: bool = False  # True: UDP; False: TCP

    def __post_init__(self) -> None:
        PortRange.one(self.port)
        family_of(self.address)
        if self.uid < 0:
            raise ValueError(f"{self.name}: {self.uid} is not a user id")


@dataclass(frozen=True)
class PeerAccess:
    """The access of two appliances to each other, both at `port`."""

    other: str
    port: int

    def __post_init__(self) -> None:
        PortRange.one(self.port)
        family_of(self.other)


@dataclass(frozen=True, kw_only=True)
class OwnNodeAccess:
    """The appliance's own node (rosout), which listens on every address.

    Only control may call its node API, at `address`; only the relay may connect to `ports`.
    """

    uid: int
    relay_uid: int
    address: str
    ports: PortRange
    master_port: int | None = None

    def __post_init__(self) -> None:
        family_of(self.address)
        if min(self.uid, self.relay_uid) < 0:
            raise ValueError(f"own node: {min(self.uid, self.relay_uid)} is not a user id")


@dataclass(frozen=True)
class OwnNetworkAccess:
    """The network of doors. Control makes each of their sockets; only control and the relay connect to their nodes."""

    network: str
    relay_uid: int

    def __post_init__(self) -> None:
        family_of(self.network)
        if self.relay_uid < 0:
            raise ValueError(f"the network of doors: {self.relay_uid} is not a user id")


@dataclass(frozen=True, kw_only=True)
class FirewallSettings:
    """The values for the rules of the appliance's namespace.

    Hosts in `tunnel_only` are accepted through IPsec only: on `tunnel_interface` if ESP runs in user space.
    `neighbours` are addresses of the machine at the other
    end of the link (isolation netns); only packets with a full TTL may have them. Even with ROS_IP, rosout listens on
    every address in `client_ports`.
    """

    control_uid: int
    rosmaster_uid: int
    rosmaster_port: int | None = None
    inner_port: int | None = None
    own_node: OwnNodeAccess | None = None
    master_port: int = 11311
    node_ports: PortRange | None = None
    client_ports: PortRange | None = None
    api_port: int | None = None
    api_networks: tuple[str, ...] = ()
    neighbours: tuple[str, ...] = ()
    tunnel_only: tuple[str, ...] = ()
    tunnel_interface: str | None = None
    forwarders: tuple[ForwarderAccess, ...] = ()
    peer: PeerAccess | None = None
    own_network: OwnNetworkAccess | None = None
    own_ports: tuple[PortRange, ...] = ()
    new_connections: RateLimit | None = RateLimit(per_second=1000, burst=2000)

    def __post_init__(self) -> None:
        for port in (self.rosmaster_port, self.inner_port, self.master_port, self.api_port):
            if port is not None:
                PortRange.one(port)
        for network in (*self.api_networks, *self.tunnel_only, *self.neighbours):
            family_of(network)
        for name, uid in (("control_uid", self.control_uid), ("rosmaster_uid", self.rosmaster_uid)):
            if uid < 0:
                raise ValueError(f"{name} {uid} is not a user id")

    @property
    def api_ports(self) -> PortRange | None:
        return None if self.api_port is None else PortRange.one(self.api_port)


LOOPBACK = Interface("lo")
OUTSIDE = Interface("lo", other=True)
_ANY_PORT = PortRange(1, MAX_PORT)

# Conditions that most rules share: first packets from outside, and first packets of local users over loopback.
_arriving = partial(PacketRule, chain=Chain.IN, arrives_on=OUTSIDE, opening=True)
_connecting = partial(PacketRule, chain=Chain.OUT, leaves_on=LOOPBACK, opening=True)
_sending = partial(PacketRule, chain=Chain.OUT)


def appliance_rules(settings: FirewallSettings) -> tuple[PacketRule, ...]:
    return (
        *(
            _arriving(
                f"{neighbour}: the machine's own packets only",
                PacketVerdict.DROP,
                source=neighbour,
                distant=True,
            )
            for neighbour in settings.neighbours
        ),
        *(
            rule
            for network in settings.tunnel_only
            for rule in _tunnel_only(network, settings.tunnel_interface)
        ),
        *_own_network(settings.own_network, settings.control_uid),
        *inner_port("ROS master port", settings.rosmaster_port, "control", settings.control_uid),
        *inner_port("master-side proxy endpoint", settings.inner_port, "rosmaster", settings.rosmaster_uid),
        *_rosmaster(settings),
        *_own_node(settings),
        *(rule for forwarder in settings.forwarders for rule in _forwarding(forwarder)),
        *_peer(settings.peer),
        *_api(settings),
        *_rate_limits(settings),
        *_chosen_by_the_kernel(settings),
    )


def family_of(address: str) -> Family:
    """Return the family of an address or network. Raises `ValueError`."""
    try:
        return 6 if ipaddress.ip_network(address).version == 6 else 4
    except ValueError as error:
        text = f"{address!r} is not an address or network such as 10.1.2.3 or 10.1.2.0/24: {error}"
        raise ValueError(text) from None


def inner_port(name: str, port: int | None, user: str, uid: int) -> tuple[PacketRule, ...]:
    return () if port is None else _inner_ports(name, PortRange.one(port), user, uid)


def _inner_ports(name: str, ports: PortRange, user: str, uid: int) -> tuple[PacketRule, ...]:
    return (
        _arriving(f"{name}: not from outside", PacketVerdict.RESET, tcp_ports=ports),
        _connecting(f"{name}: {user} may", PacketVerdict.RETURN, tcp_ports=ports, uid=uid),
        _connecting(f"{name}: no other user", PacketVerdict.RESET, tcp_ports=ports),
    )


def _rosmaster(settings: FirewallSettings) -> tuple[PacketRule, ...]:
    if settings.inner_port is None:
        return ()
    uid = settings.rosmaster_uid
    return (
        _connecting("rosmaster: connects to nothing else", PacketVerdict.RESET, tcp_ports=_ANY_PORT, uid=uid),
        _sends_nothing_out("rosmaster", uid),
    )


def _own_node(settings: FirewallSettings) -> tuple[PacketRule, ...]:
    """Return the rules of the own node, which only control calls."""
    node = settings.own_node
    if node is None:
        return ()
    api = partial(_sending, destination=node.address, tcp_ports=_ANY_PORT, opening=True)
    answer = partial(_sending, uid=node.uid, accepting=True)
    return (
        api("own node's API: control may", PacketVerdict.RETURN, uid=settings.control_uid),
        api("own node's API: no other user", PacketVerdict.RESET),
        *_inner_ports("own node's messages", node.ports, "relay", node.relay_uid),
        answer("own node: control is answered", PacketVerdict.RETURN, source=node.address),
        answer("own node: the relay is answered", PacketVerdict.RETURN, from_ports=node.ports),
        answer("own node: no other user is answered", PacketVerdict.DROP),
        *inner_port("own node's master", node.master_port, "rosout", node.uid),
        *_ports_of_others(node.uid, settings),
        _sends_nothing_out("own node", node.uid),
    )


def _ports_of_others(uid: int, settings: FirewallSettings) -> Iterator[PacketRule]:
    """Yield rules that block ports instead of permitting some: a new policy may change the permitted ones."""
    chosen, faces = settings.client_ports, settings.node_ports
    if faces is not None and chosen is not None and faces.overlaps(chosen):
        yield _connecting("own node: faces and relays", PacketVerdict.RETURN, tcp_ports=faces, uid=uid)
    closed = {
        "RVMaster port": PortRange.one(settings.master_port),
        "REST port": settings.api_ports,
        "low port": PortRange(1, 1023),
        "port of the kernel's choice": chosen,
    }
    for name, ports in closed.items():
        if ports is not None:
            yield _connecting(f"own node: no {name}", PacketVerdict.RESET, tcp_ports=ports, uid=uid)


def _sends_nothing_out(name: str, uid: int) -> PacketRule:
    return _sending(f"{name}: sends nothing out", PacketVerdict.DROP, leaves_on=OUTSIDE, uid=uid)


def _tunnel_only(network: str, interface: str | None) -> tuple[PacketRule, ...]:
    outside = Interface(interface, other=True) if interface else None
    refused = partial(PacketRule, verdict=PacketVerdict.DROP, clear_text=interface is None)
    return (
        refused(f"{network}: through its tunnel only", chain=Chain.IN, source=network, arrives_on=outside),
        refused(f"{network}: never in clear text", chain=Chain.OUT, destination=network, leaves_on=outside),
    )


def _own_network(access: OwnNetworkAccess | None, control_uid: int) -> tuple[PacketRule, ...]:
    if access is None:
        return ()
    network = access.network
    outside = partial(PacketRule, verdict=PacketVerdict.DROP, chain=Chain.IN, arrives_on=OUTSIDE)
    # The kernel gives a connection to a door's node the node's own address as its source, so these rules come first.
    calls = partial(_sending, destination=network, tcp_ports=_ANY_PORT, opening=True)
    begins = partial(_sending, source=network, tcp_ports=_ANY_PORT, opening=True)
    answers = partial(_sending, source=network, accepting=True)
    return (
        outside(f"{network}: doors have no other machine's packets", source=network),
        outside(f"{network}: no other machine reaches a door's node", destination=network),
        calls(f"{network}: control calls doors' nodes", PacketVerdict.RETURN, uid=control_uid),
        calls(f"{network}: the relay connects to doors' nodes", PacketVerdict.RETURN, uid=access.relay_uid),
        calls(f"{network}: no other user reaches a door's node", PacketVerdict.RESET),
        begins(f"{network}: control connects for doors", PacketVerdict.RETURN, uid=control_uid),
        begins(f"{network}: no other user connects as a door", PacketVerdict.RESET),
        answers(f"{network}: control listens for doors", PacketVerdict.RETURN, uid=control_uid),
        answers(f"{network}: no other user listens as a door", PacketVerdict.DROP),
    )


def _forwarding(forwarder: ForwarderAccess) -> tuple[PacketRule, ...]:
    sending = partial(_sending, uid=forwarder.uid)
    ports = PortRange.one(forwarder.port)
    return (
        sending(
            f"{forwarder.name}: its receiver",
            PacketVerdict.RETURN,
            destination=forwarder.address,
            tcp_ports=None if forwarder.datagrams else ports,
            udp_ports=ports if forwarder.datagrams else None,
        ),
        sending(f"{forwarder.name}: no other destination", PacketVerdict.DROP),
    )


def _peer(access: PeerAccess | None) -> tuple[PacketRule, ...]:
    if access is None:
        return ()
    port = PortRange.one(access.port)
    datagrams = partial(PacketRule, chain=Chain.IN, arrives_on=OUTSIDE, udp_ports=port)
    return (
        _arriving(
            "replication: the other appliance may", PacketVerdict.RETURN, source=access.other, tcp_ports=port
        ),
        _arriving("replication: no other host", PacketVerdict.RESET, tcp_ports=port),
        datagrams("lease: the other appliance may", PacketVerdict.RETURN, source=access.other),
        datagrams("lease: no other host", PacketVerdict.DROP),
    )


def _api(settings: FirewallSettings) -> tuple[PacketRule, ...]:
    ports = settings.api_ports
    if ports is None:
        return ()
    return (
        *_rate_limit(settings.new_connections, "REST port", ports),
        *(
            _arriving(f"REST port: {network} may", PacketVerdict.RETURN, source=network, tcp_ports=ports)
            for network in settings.api_networks
        ),
        _arriving("REST port: no other network", PacketVerdict.RESET, tcp_ports=ports),
    )


def _rate_limits(settings: FirewallSettings) -> tuple[PacketRule, ...]:
    limit, nodes = settings.new_connections, settings.node_ports
    return (
        *_rate_limit(limit, "RVMaster port", PortRange.one(settings.master_port)),
        *(_rate_limit(limit, "node and relay ports", nodes) if nodes is not None else ()),
        *(rule for port in settings.own_ports for rule in _rate_limit(limit, f"door's port {port}", port)),
    )


def _chosen_by_the_kernel(settings: FirewallSettings) -> Iterator[PacketRule]:
    """Yield rules that close these ports, except configured ones, to other machines: the own node listens there."""
    if settings.client_ports is None:
        return
    chosen = {
        "RVMaster port": PortRange.one(settings.master_port),
        "node and relay ports": settings.node_ports,
        "REST port": settings.api_ports,
        **{f"door's port {port}": port for port in settings.own_ports},
    }
    for name, ports in chosen.items():
        if ports is not None and ports.overlaps(settings.client_ports):
            yield _arriving(f"{name}: not one of the kernel's choice", PacketVerdict.RETURN, tcp_ports=ports)
    yield _arriving(
        "own nodes' ports: not from outside", PacketVerdict.RESET, tcp_ports=settings.client_ports
    )


def _rate_limit(limit: RateLimit | None, name: str, ports: PortRange) -> tuple[PacketRule, ...]:
    """Return rules that limit the new connections of each host.

    The first packet after the handshake counts: its sender received our SYN-ACK, so its address is not forged.
    Against forged first packets, the kernel answers with SYN cookies, which need no memory.
    """
    if limit is None:
        return ()
    established = partial(PacketRule, chain=Chain.IN, arrives_on=OUTSIDE, tcp_ports=ports, answered=True)
    return (
        established(f"{name}: new connections per host", PacketVerdict.DROP, above=limit),
        established(f"{name}: counted", PacketVerdict.COUNTED),
    )
