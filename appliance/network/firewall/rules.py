"""The rules of the firewall, as data: what is refused, and in which chain. No I/O.

Invariants:

1. The appliance's own rules only ever *refuse* (or RETURN to the rules of others): installing them opens
   nothing that another firewall on the machine has closed. The one ACCEPT is in ROSRV-FWD, for the
   appliance's own veth.
2. A connection is refused at its first packet, a SYN without ACK, whatever the connection tracker thinks of
   it: no `NOTRACK` rule opens the port, and packets of sockets already closed are left alone (rejecting
   those makes them linger).
3. Who may connect is said positively, then all others are refused. A packet whose owner is unknown is
   refused.
"""

import ipaddress
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

Family = Literal[4, 6]
MAX_PORT = 65535


class Chain(StrEnum):
    """The chains of the appliance; each is hooked into the built-in ones that HOOKS names."""

    IN = "ROSRV-IN"
    OUT = "ROSRV-OUT"
    FORWARD = "ROSRV-FWD"
    NAT = "ROSRV-NAT"
    SOURCE_NAT = "ROSRV-SNAT"


HOOKS: dict[Chain, tuple[str, ...]] = {
    Chain.IN: ("INPUT",),
    Chain.OUT: ("OUTPUT",),
    Chain.FORWARD: ("FORWARD",),
    Chain.NAT: ("PREROUTING", "OUTPUT"),
    Chain.SOURCE_NAT: ("POSTROUTING",),
}
NAT_CHAINS = frozenset({Chain.NAT, Chain.SOURCE_NAT})


class Verdict(StrEnum):
    """What becomes of a packet that matches."""

    RETURN = "RETURN"  # none of the appliance's business: on to the rules of others
    ACCEPT = "ACCEPT"
    RESET = "RESET"  # TCP reset: the peer sees "connection refused"
    DROP = "DROP"
    DNAT = "DNAT"
    MASQUERADE = "MASQUERADE"


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
    """More than `per_second` new connections of one host, after a burst of `burst`."""

    per_second: int
    burst: int

    def __post_init__(self) -> None:
        if not (1 <= self.per_second <= 100_000 and 1 <= self.burst <= 100_000):
            raise ValueError("a rate limit takes 1 to 100000 new connections per second, and for the burst")


@dataclass(frozen=True, kw_only=True)
class Rule:
    """One rule: it matches when everything that is given matches."""

    chain: Chain
    purpose: str  # shown by `rosrv status` and kept as the rule's comment; at most 100 characters
    verdict: Verdict
    family: Family | None = None  # None: both
    arrives_on: Interface | None = None
    leaves_on: Interface | None = None
    source: str | None = None
    destination: str | None = None
    tcp_ports: PortRange | None = None
    udp_ports: PortRange | None = None
    opening: bool = False  # a SYN without ACK
    uid: int | None = None  # the owner of the local socket; chain OUT only
    clear_text: bool = False  # did not come (OUT: does not leave) through IPsec
    above: RateLimit | None = None
    local_destination: bool = False  # an address of this machine
    new_connection: bool = False  # as the connection tracker sees it
    translated: bool = False  # belongs to a connection whose destination was translated
    to: str | None = None  # of DNAT: the address

    def __post_init__(self) -> None:
        if self.verdict is Verdict.RESET and self.tcp_ports is None:
            raise ValueError(f"rule {self.purpose!r}: only TCP can be reset")
        if self.udp_ports is not None and (self.tcp_ports is not None or self.opening):
            raise ValueError(f"rule {self.purpose!r}: a packet is TCP or UDP, not both")
        if self.uid is not None and self.chain is not Chain.OUT:
            raise ValueError(f"rule {self.purpose!r}: a packet has an owner in {Chain.OUT} only")
        if (self.verdict is Verdict.DNAT) != (self.to is not None):
            raise ValueError(f"rule {self.purpose!r}: DNAT and its address go together")

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
            "uid": self.uid,
            "above": f"{self.above.per_second}/s" if self.above else None,
        }
        words = [f"{name} {value}" for name, value in matches.items() if value is not None]
        flags = {
            "syn": self.opening,
            "no ipsec": self.clear_text,
            "to this machine": self.local_destination,
            "new": self.new_connection,
            "translated": self.translated,
        }
        words += [name for name, held in flags.items() if held]
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
class FirewallSettings:
    """What the rules of the appliance's own namespace are built from.

    `rosmaster_port`, `inner_port` and `own_port` may be unknown (None) before their processes run: `Firewall.update`
    adds them. Hosts in `tunnel_only` are accepted through IPsec only: by the kernel's policy, or, when ESP
    runs in user space, on `tunnel_interface`. `api_networks` says who reaches the REST port besides
    loopback: nobody, if empty. `client_ports` are those that the kernel gives to whoever does not choose: the own
    nodes (rosout) listen there on every address, whatever ROS_IP says.
    """

    control_uid: int
    rosmaster_uid: int
    rosmaster_port: int | None = None
    inner_port: int | None = None
    own_port: int | None = None
    master_port: int = 11311
    node_ports: PortRange | None = None
    client_ports: PortRange | None = None
    api_port: int | None = None
    api_networks: tuple[str, ...] = ()
    tunnel_only: tuple[str, ...] = ()
    tunnel_interface: str | None = None
    forwarder: Forwarder | None = None
    new_connections: RateLimit | None = RateLimit(per_second=1000, burst=2000)

    def __post_init__(self) -> None:
        for port in (
            self.rosmaster_port,
            self.inner_port,
            self.own_port,
            self.master_port,
            self.api_port,
        ):
            if port is not None:
                PortRange.one(port)
        for network in (*self.api_networks, *self.tunnel_only):
            family_of(network)
        for name in ("control_uid", "rosmaster_uid"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} {getattr(self, name)} is no user id")


LOOPBACK = Interface("lo")
OUTSIDE = Interface("lo", other=True)


def appliance_rules(settings: FirewallSettings) -> tuple[Rule, ...]:
    """Return the rules of the appliance's namespace, in the order in which they are tried."""
    return (
        *(
            rule
            for network in settings.tunnel_only
            for rule in _tunnel_only(network, settings.tunnel_interface)
        ),
        *inner_port("ROSMaster port", settings.rosmaster_port, "control", settings.control_uid),
        *inner_port("inner node face", settings.inner_port, "rosmaster", settings.rosmaster_uid),
        *inner_port("own nodes' master", settings.own_port, "rosmaster", settings.rosmaster_uid),
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
    if port is None:
        return ()
    ports = PortRange.one(port)
    return (
        Rule(
            chain=Chain.IN,
            purpose=f"{name}: not from outside",
            verdict=Verdict.RESET,
            arrives_on=OUTSIDE,
            tcp_ports=ports,
            opening=True,
        ),
        Rule(
            chain=Chain.OUT,
            purpose=f"{name}: {user} may",
            verdict=Verdict.RETURN,
            leaves_on=LOOPBACK,
            tcp_ports=ports,
            opening=True,
            uid=uid,
        ),
        Rule(
            chain=Chain.OUT,
            purpose=f"{name}: no other user",
            verdict=Verdict.RESET,
            leaves_on=LOOPBACK,
            tcp_ports=ports,
            opening=True,
        ),
    )


def _tunnel_only(network: str, interface: str | None) -> tuple[Rule, ...]:
    """An address that is taken from, and sent to, through its tunnel only."""
    outside = Interface(interface, other=True) if interface else None
    return (
        Rule(
            chain=Chain.IN,
            purpose=f"{network}: through its tunnel only",
            verdict=Verdict.DROP,
            source=network,
            arrives_on=outside,
            clear_text=interface is None,
        ),
        Rule(
            chain=Chain.OUT,
            purpose=f"{network}: never in clear text",
            verdict=Verdict.DROP,
            destination=network,
            leaves_on=outside,
            clear_text=interface is None,
        ),
    )


def _forwarding(forwarder: Forwarder | None) -> tuple[Rule, ...]:
    """The forwarder's packets go to its receiver; whatever else its user sends goes nowhere."""
    if forwarder is None:
        return ()
    ports = PortRange.one(forwarder.port)
    return (
        Rule(
            chain=Chain.OUT,
            purpose="audit log's forwarder: its receiver",
            verdict=Verdict.RETURN,
            destination=forwarder.address,
            tcp_ports=None if forwarder.datagrams else ports,
            udp_ports=ports if forwarder.datagrams else None,
            uid=forwarder.uid,
        ),
        Rule(
            chain=Chain.OUT,
            purpose="audit log's forwarder: nobody else",
            verdict=Verdict.DROP,
            uid=forwarder.uid,
        ),
    )


def _api(settings: FirewallSettings) -> tuple[Rule, ...]:
    if settings.api_port is None:
        return ()
    ports = PortRange.one(settings.api_port)
    allowed = (
        Rule(
            chain=Chain.IN,
            purpose=f"REST port: {network} may",
            verdict=Verdict.RETURN,
            arrives_on=OUTSIDE,
            source=network,
            tcp_ports=ports,
            opening=True,
        )
        for network in settings.api_networks
    )
    # The rate limit stands before the RETURN of the networks, or it would not count them.
    return (
        *_rate_limit(settings.new_connections, "REST port", ports),
        *allowed,
        Rule(
            chain=Chain.IN,
            purpose="REST port: no other network",
            verdict=Verdict.RESET,
            arrives_on=OUTSIDE,
            tcp_ports=ports,
            opening=True,
        ),
    )


def _rate_limits(settings: FirewallSettings) -> tuple[Rule, ...]:
    ports = [("RVMaster port", PortRange.one(settings.master_port))]
    if settings.node_ports is not None:
        ports.append(("node and relay ports", settings.node_ports))
    return tuple(rule for name, one in ports for rule in _rate_limit(settings.new_connections, name, one))


def _chosen_by_the_kernel(settings: FirewallSettings) -> tuple[Rule, ...]:
    """Nobody outside has business with the ports of the own nodes; with those that were chosen, he may have."""
    if settings.client_ports is None:
        return ()
    chosen = (
        ("RVMaster port", PortRange.one(settings.master_port)),
        ("node and relay ports", settings.node_ports),
        ("REST port", PortRange.one(settings.api_port) if settings.api_port is not None else None),
    )
    return (
        *(
            Rule(
                chain=Chain.IN,
                purpose=f"{name}: not one of the kernel's choice",
                verdict=Verdict.RETURN,
                arrives_on=OUTSIDE,
                tcp_ports=ports,
                opening=True,
            )
            for name, ports in chosen
            if ports is not None and ports.overlaps(settings.client_ports)
        ),
        Rule(
            chain=Chain.IN,
            purpose="own nodes' ports: not from outside",
            verdict=Verdict.RESET,
            arrives_on=OUTSIDE,
            tcp_ports=settings.client_ports,
            opening=True,
        ),
    )


def _rate_limit(limit: RateLimit | None, name: str, ports: PortRange) -> tuple[Rule, ...]:
    """Drop what is above the limit: the peer's kernel tries again a second later, which slows it down."""
    if limit is None:
        return ()
    return (
        Rule(
            chain=Chain.IN,
            purpose=f"{name}: new connections per host",
            verdict=Verdict.DROP,
            arrives_on=OUTSIDE,
            tcp_ports=ports,
            opening=True,
            above=limit,
        ),
    )
