"""Isolation `netns`: the appliance in a namespace of its own on a bare host.

```
 hosts of the network                host                              namespace `rosrv`
        |            +-------------------------------+         +---------------------------+
        +---- eth0 --| ROSRV-NAT: 11311, node ports  |--veth---| eth0 10.111.0.2           |
                     | on every address of the host  |         | RVMaster, relay, rosmaster|
                     +-------------------------------+         +---------------------------+
```

Invariants:

1. What arrives on an address of the host for a forwarded port goes to the namespace with its source address
   kept; the host's own processes reach it by any address of the host and by 127.0.0.1 (::1 stays refused, for
   it cannot leave a host). What the appliance opens bears the host's address on the network.
2. A connection reaches the appliance under the address of the machine that made it. Rules of others that translate
   addresses (of containers, virtual machines, clients of a hotspot) do not apply to the appliance's link: a
   connection takes the first translation that it is given, and ROSRV-KEEP stands before all others and gives it its own
   source. Should a forwarded packet bear an address of this machine all the same, ROSRV-POST drops it. While the
   rules are not there (somebody flushed them) the appliance itself knows such a packet by its TTL: the host's own
   have 255 on that link, and no router can pass a packet on with that.
3. Nothing else of the namespace can be reached through the host, and a host that was no router does not
   become one: forwarding is on, but the chain ROSRV-FWD lets only the appliance's packets pass.
4. Whatever is changed is recorded first, so that `down`, or `up` after a crash, puts it back. Nothing
   without a record is taken for ours: a namespace or interface of the same name is an error, not a
   leftover.
5. One appliance on a host: a lock that the kernel releases with the process says whether a record is a
   leftover.
"""

import contextlib
import fcntl
import ipaddress
import itertools
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from appliance.base.atomic_files import write_whole
from appliance.channel.answers.status import FirewallRule
from appliance.network import interfaces
from appliance.network.endings import end_processes
from appliance.network.firewall import iptables
from appliance.network.firewall.firewall import statuses
from appliance.network.firewall.firewall_rules import (
    LOOPBACK,
    Chain,
    Family,
    Interface,
    PortRange,
    Rule,
    Verdict,
    family_of,
)
from appliance.network.firewall.nft import NftBackend
from appliance.network.ip_forwarding import Forwarding
from appliance.network.listening_sockets import listening_ports, udp_ports_in_use
from appliance.network.namespaces import Namespace, NetworkError, require_privileges
from appliance.network.public_address import Endpoint, outward_address

INSIDE = "eth0"
_CANDIDATES = 64
_TUNNELS = (PortRange.one(500), PortRange.one(4500))  # IKE; ESP in UDP
_POOL = ipaddress.IPv4Network("10.111.0.0/16")
_POOL6 = ipaddress.IPv6Network("fd52:4f53:5256::/48")


@dataclass(frozen=True, kw_only=True)
class IsolationSettings:
    """Where the appliance's namespace is, and what is forwarded to it.

    `subnet` and `subnet6` None: the first one of a private pool that no route of the host names.
    """

    ports: tuple[PortRange, ...]  # TCP
    name: str = "rosrv"
    subnet: str | None = None  # at least two addresses, such as 10.111.0.0/30
    subnet6: str | None = None
    directory: Path = Path("/run/rosrv")  # of the record and the lock, the same for all appliances of a host

    def __post_init__(self) -> None:
        if not self.ports:
            raise ValueError("isolation netns: no port to forward was given")
        for text, version in ((self.subnet, 4), (self.subnet6, 6)):
            if text is not None and (
                family_of(text) != version or ipaddress.ip_network(text).num_addresses < 4
            ):
                raise ValueError(
                    f"isolation netns: {text!r} is no IPv{version} network with room for two hosts"
                )

    @property
    def link(self) -> str:
        """The host's end of the veth pair."""
        return f"veth-{self.name}"[: interfaces.IFNAMSIZ]


@dataclass(frozen=True)
class Ends:
    """The addresses of a subnet: the host's and the appliance's, without prefix length."""

    network: str
    host: str
    appliance: str

    @property
    def length(self) -> int:
        """Prefix length, in bits."""
        return ipaddress.ip_network(self.network).prefixlen


class Isolation:
    """The namespace of the appliance and its way to the host's networks."""

    def __init__(self, host: Namespace, settings: IsolationSettings) -> None:
        self._host = host
        self.settings = settings
        self.namespace = Namespace(settings.name)
        self.ends: dict[Family, Ends] = {}
        self._backend = NftBackend(host)
        self._rules: tuple[Rule, ...] = ()
        self._routers: tuple[Family, ...] = ()
        self._forwarding = Forwarding(host)
        self._lock: int | None = None

    def up(self) -> None:
        """Make the namespace, its addresses and its forwarding; what a crash left is taken down first.

        Raises: PrivilegeError; NetworkError naming what is in the way. Nothing is left behind then.
        """
        require_privileges("isolation netns")
        self._take_lock()
        try:
            self._clear_leftovers()
            self._refuse_foreign()
            self._choose_subnets()
            self._write_record()
            self._build()
        except BaseException:
            self.down()
            raise

    def down(self) -> None:
        """Take everything away again and put the host's settings back; taking down twice is fine."""
        if self._lock is None:
            return
        try:
            self._clear_leftovers()
            if self._rules:
                self._forget_tunnels()
        finally:
            self.ends.clear()
            self._rules = ()
            os.close(self._lock)
            self._lock = None

    def host_address_for(self, peer: str) -> str:
        """Return the address by which `peer` reaches the host: what nodes on that peer are to be told."""
        return interfaces.source_address_for(self._host, peer)

    def endpoint(self) -> Endpoint:
        """Where hosts of other networks reach the host. Raises: NetworkError when that cannot be told."""
        return outward_address(self._host, without=("lo", self.settings.link))

    def obstacles(self) -> tuple[str, ...]:
        """Name chains of others on the host that drop forwarded packets unless told otherwise.

        A drop there cannot be undone from here; whoever owns the chain must let the appliance's link pass.
        """
        link = self.settings.link
        return tuple(
            f"{chain} drops what is forwarded by default: let interface {link} pass in it, both ways"
            for chain in (*self._backend.foreign_forward_drops(), *iptables.foreign_forward_drops(self._host))
        )

    def translations(self) -> tuple[str, ...]:
        """Name chains of others on the host that translate the addresses of other machines or containers.

        They do not apply to connections to the appliance, which sees those hosts as they are.
        """
        return (*self._backend.foreign_translations(), *iptables.foreign_translations(self._host))

    def forward_tunnels(self) -> None:
        """Forward IKE and ESP (UDP 500 and 4500) too from now on. Raises: NetworkError if the host uses them itself."""
        rules = isolation_rules(self.settings, self.ends, self._routers, udp=_TUNNELS)
        if rules == self._rules:
            return
        used = self._host.run(udp_ports_in_use) & {port.first for port in _TUNNELS}
        if used:
            raise NetworkError(
                f"the host has a program of its own on UDP {', '.join(map(str, sorted(used)))}, where the appliance's"
                " tunnels arrive: stop it (a strongSwan of the host?), or run the appliance in a container"
            )
        self._install(rules)

    def put_rules_back(self) -> None:
        """Install the rules on the host again, when somebody took them away."""
        if self._rules:
            self._install(self._rules)

    def rules(self) -> tuple[FirewallRule, ...]:
        """Return the rules on the host with their counters."""
        return statuses(self._rules, self._backend.counters())

    def _install(self, rules: tuple[Rule, ...]) -> None:
        self._backend.install(rules)
        self._rules = rules
        self._forget_tunnels()

    def _forget_tunnels(self) -> None:
        """Let the next packet of each tunnel go where the rules say now."""
        from appliance.network import conntrack  # noqa: PLC0415  pyroute2: see `links`

        conntrack.forget(self._host, [port.first for port in _TUNNELS])

    def _build(self) -> None:
        settings, inside = self.settings, self.namespace
        inside.create()
        interfaces.set_link(inside, "lo", up=True)
        interfaces.create_veth(self._host, settings.link, inside, INSIDE)
        for family, ends in self.ends.items():
            interfaces.add_address(self._host, settings.link, f"{ends.host}/{ends.length}")
            interfaces.add_address(inside, INSIDE, f"{ends.appliance}/{ends.length}")
            interfaces.add_near_route(
                self._host, settings.link, ends.appliance, source=ends.host, hop_limit=255
            )
            interfaces.add_route(inside, "default", ends.host)
            if family == 4:  # so that packets the host sends from 127.0.0.1 may leave on this link
                self._host.sysctl(f"net/ipv4/conf/{settings.link}/route_localnet", "1")
        routers = tuple(family for family in self.ends if self._forwarding.before(family))
        self._routers = routers
        self._install(isolation_rules(settings, self.ends, routers))  # before forwarding is turned on
        self._forwarding.enable(tuple(self.ends))

    def _choose_subnets(self) -> None:
        taken = [ipaddress.ip_network(text) for text in interfaces.networks(self._host)]
        self.ends = {4: _choose(self.settings.subnet, _POOL, 30, taken)}
        if self._forwarding.has_ipv6():
            self.ends[6] = _choose(self.settings.subnet6, _POOL6, 64, taken)

    def _refuse_foreign(self) -> None:
        name, link = self.settings.name, self.settings.link
        if self.namespace.exists():
            raise NetworkError(
                f"there is a network namespace {name} that this appliance has not made: "
                f"`sudo ip netns delete {name}` if nobody needs it, or give the appliance another name"
            )
        if link in interfaces.links(self._host):
            raise NetworkError(
                f"there is an interface {link} that this appliance has not made: `ip link delete {link}`"
            )
        in_use = self._host.run(listening_ports)
        clashes = [
            str(port)
            for port in sorted(in_use)
            if any(r.first <= port <= r.last for r in self.settings.ports)
        ]
        if clashes:
            raise NetworkError(
                f"the host has programs of its own that listen on TCP {', '.join(clashes[:8])}, which would "
                "be forwarded to the appliance: stop them (a roscore?), or give the appliance other ports"
            )

    def _take_lock(self) -> None:
        if self._lock is not None:
            raise NetworkError(f"isolation {self.settings.name} is up already")
        self.settings.directory.mkdir(mode=0o755, parents=True, exist_ok=True)
        lock = os.open(
            self.settings.directory / "isolation.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600
        )
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(lock)
            raise NetworkError(
                "another appliance with isolation netns is running on this host "
                f"({self._recorded_name()}): stop it first"
            ) from None
        self._lock = lock

    @property
    def _record(self) -> Path:
        return self.settings.directory / "isolation.json"

    def _recorded_name(self) -> str:
        """Return the namespace of the appliance that is running, for a message."""
        try:
            return f"namespace {json.loads(self._record.read_text(encoding='utf-8'))['namespace']}"
        except (OSError, ValueError, KeyError, TypeError):
            return "still starting"

    def _write_record(self) -> None:
        """Write what will have to be put back, before anything is changed."""
        record = {
            "namespace": self.settings.name,
            "link": self.settings.link,
            "settings": self._forwarding.record(),
        }
        write_whole(self._record, json.dumps(record).encode(), 0o644)

    def _clear_leftovers(self) -> None:
        """Undo what the record says, if there is one."""
        try:
            record = json.loads(self._record.read_text(encoding="utf-8"))
            leftover, link = Namespace(record["namespace"]), str(record["link"])
            settings = {str(key): str(value) for key, value in record["settings"].items()}
        except FileNotFoundError:
            return
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise NetworkError(
                f"{self._record} cannot be read ({error}): look at it and delete it"
            ) from error
        self._forwarding.restore(settings)  # before the chain that keeps the host from being a router goes
        self._backend.remove()
        interfaces.delete_link(self._host, link)
        end_processes(leftover.processes())
        leftover.delete()
        with contextlib.suppress(FileNotFoundError):
            self._record.unlink()


def isolation_rules(
    settings: IsolationSettings,
    ends: dict[Family, Ends],
    routers: tuple[Family, ...],
    *,
    udp: tuple[PortRange, ...] = (),
) -> tuple[Rule, ...]:
    """Return the rules on the host; `routers` are the families for which the host was a router before.

    `udp` are ports that are forwarded besides the TCP ports of the settings.
    """
    inward, outward = Interface(settings.link), Interface(settings.link, other=True)
    forwarded = partial(Rule, chain=Chain.FORWARD)
    leaving = partial(Rule, chain=Chain.LEAVING, leaves_on=inward)
    rules = [
        Rule(
            "the appliance does not reach the host's loopback",
            Verdict.DROP,
            chain=Chain.IN,
            arrives_on=inward,
            destination="127.0.0.0/8",
            new_connection=True,
        ),
        forwarded("forwarded ports", Verdict.RETURN, leaves_on=inward, translated=True),
        forwarded("no other way to the appliance", Verdict.DROP, leaves_on=inward, unknown=True),
        Rule("the host's own loopback", Verdict.RETURN, chain=Chain.ARRIVING, arrives_on=LOOPBACK),
        leaving(
            "no packet of others under an address of the host",
            Verdict.DROP,
            arrives_on=outward,  # neighbour discovery is made here, and is said to arrive where it leaves
            local_source=True,
            forwarded=True,
        ),
        leaving("the host's own packets: full TTL", Verdict.FULL_HOPS, forwarded=False),
    ]
    for family, end in ends.items():
        if family not in routers:
            no_router = partial(forwarded, family=family, arrives_on=outward, leaves_on=outward)
            rules.append(no_router(f"the host is no IPv{family} router", Verdict.DROP))
        rules += [_loopback(family, inward), *_true_sources(family, end, inward)]
        rules += [_forward("TCP", ports, end, outward) for ports in settings.ports]
        rules += [_forward("UDP", ports, end, outward) for ports in udp]
        masqueraded = partial(Rule, chain=Chain.SOURCE_NAT, source=end.network, leaves_on=outward)
        rules.append(masqueraded(f"the appliance's own connections, IPv{family}", Verdict.MASQUERADE))
    return tuple(rules)


def _true_sources(family: Family, end: Ends, inward: Interface) -> tuple[Rule, ...]:
    """Nobody has an address of the link but its two ends, and what enters it has the source it came with."""
    elsewhere = partial(Rule, chain=Chain.ARRIVING, arrives_on=Interface(inward.name, other=True))
    entering = partial(Rule, chain=Chain.KEPT_SOURCE, family=family, leaves_on=inward)
    return (
        elsewhere(
            f"IPv{family} addresses of the appliance's link, from elsewhere", Verdict.DROP, source=end.network
        ),
        entering(f"to the appliance: nobody else translates IPv{family} sources", Verdict.KEEP_SOURCE),
    )


def _loopback(family: Family, inward: Interface) -> Rule:
    """127.0.0.1 is forwarded under the veth's address; ::1 cannot leave a host, so it stays refused."""
    if family == 4:
        local = partial(Rule, chain=Chain.KEPT_SOURCE, source="127.0.0.0/8", leaves_on=inward)
        return local("from the host's own loopback", Verdict.MASQUERADE)
    return Rule("not from ::1", Verdict.RETURN, chain=Chain.NAT, destination="::1")


def _forward(protocol: Literal["TCP", "UDP"], ports: PortRange, end: Ends, outward: Interface) -> Rule:
    return Rule(
        f"{protocol} {ports} to the appliance, IPv{family_of(end.appliance)}",
        Verdict.DNAT,
        chain=Chain.NAT,
        arrives_on=outward,
        tcp_ports=ports if protocol == "TCP" else None,
        udp_ports=ports if protocol == "UDP" else None,
        local_destination=True,
        to=end.appliance,
    )


_Network = ipaddress.IPv4Network | ipaddress.IPv6Network


def _choose(wanted: str | None, pool: _Network, length: int, taken: list[_Network]) -> Ends:
    """Return the ends of the wanted subnet, or of the first one of the pool that collides with nothing."""
    if wanted is not None:
        network = ipaddress.ip_network(wanted)
        for other in taken:
            if _collide(network, other):
                raise NetworkError(
                    f"isolation netns: {network} collides with {other}, which this host has a route to"
                )
        return _ends(network)
    candidates: Iterator[_Network] = iter(pool.subnets(new_prefix=length))
    for candidate in itertools.islice(candidates, _CANDIDATES):
        if not any(_collide(candidate, other) for other in taken):
            return _ends(candidate)
    raise NetworkError(f"isolation netns: this host has routes to all of {pool}: give a free subnet")


def _collide(one: _Network, other: _Network) -> bool:
    return one.version == other.version and one.overlaps(other)


def _ends(network: _Network) -> Ends:
    return Ends(str(network), str(network[1]), str(network[2]))
