"""Isolation `netns`: run the appliance in a separate namespace on a bare host (docs/reference/processes.md).

1. A connection arrives with the address of the machine that made it: the first translation wins, and the chain
   ROSRV-KEEP, which keeps the source, comes before those of other programs. If a forwarded packet still has an
   address of this machine, ROSRV-POST drops it. If these rules are flushed, the TTL reveals such packets: the
   host's own have 255 on the link.
2. The host does not become a router: forwarding is enabled, but ROSRV-FWD passes only the appliance's packets.
3. Every change is recorded before it is made, so that `down`, or `up` after a crash, undoes it. A namespace or an
   interface of the same name without a record is an error.
4. The lock of the appliance ends with its process, so a record without a lock is left from a crash.
5. While rules were gone, other machines could reach the robot's own master. Once they are back, connections of that
   time are ended, and none goes on: a rule drops packets to that master, also those of a connection that has begun.
"""

import contextlib
import errno
import fcntl
import ipaddress
import json
import math
import os
import socket
import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

from appliance.base import clock
from appliance.base.atomic_files import write_whole
from appliance.channel.answers.status import FirewallRule
from appliance.network import close_ports, interfaces, vendor_masters
from appliance.network.cut import DisturbedConnections, close_port, open_port, refuse_no_port, run_nft
from appliance.network.firewall import iptables
from appliance.network.firewall.firewall import installing_again, statuses
from appliance.network.firewall.firewall_rules import (
    LOOPBACK,
    Chain,
    Family,
    Interface,
    PacketRule,
    PacketVerdict,
    PortRange,
    family_of,
)
from appliance.network.firewall.nft import TABLE, NftBackend
from appliance.network.firewall.rule_watch import RuleWatch, subscribe
from appliance.network.listening_sockets import listening_ports, udp_ports_in_use
from appliance.network.machine_addresses import machine_addresses
from appliance.network.namespaces import Namespace, NetworkError, end_processes, require_privileges
from appliance.network.port_holders import PortsInUseError, describe_holder
from appliance.network.public_address import PublicAddress, outward_address

# Delete entries of the connection tracker.
#
# Address translation applies only to the first packet of a connection. A host that keeps sending UDP (IKE, ESP in
# UDP) keeps its old entry alive, so changed rules would not redirect its packets.

_FAMILIES = (socket.AF_INET, socket.AF_INET6)


def forget_tracked(namespace: Namespace, ports: Iterable[int]) -> int:
    """Delete the entries of the namespace's own addresses; return their number. Raises `NetworkError`."""
    pyroute2 = interfaces.netlink_library()
    own = {address.partition("/")[0] for address in interfaces.addresses(namespace)}
    try:
        return namespace.run(
            lambda: sum(_forget(family, port, own) for family in _FAMILIES for port in ports)
        )
    except (pyroute2.NetlinkError, OSError) as error:
        raise NetworkError(f"deleting entries of the connection tracker: {error}") from error


def _forget(family: int, port: int, own: set[str]) -> int:
    pyroute2 = interfaces.netlink_library()
    tuples = pyroute2.netlink.nfnetlink.nfctsocket.NFCTAttrTuple
    wanted = tuples(family=family, proto=socket.IPPROTO_UDP, dport=port)
    deleted = 0
    with pyroute2.NFCTSocket(nfgen_family=family) as tracker:
        for message in list(tracker.dump(tuple_orig=wanted)):
            entry = tuples.from_netlink(family, message.get_attr("CTA_TUPLE_ORIG"))
            # Kernels before 5.8 do not filter.
            if (entry.proto, entry.dport) != (wanted.proto, port) or entry.daddr not in own:
                continue
            try:
                tracker.entry("del", tuple_orig=entry)
            except pyroute2.NetlinkError as error:
                if error.code != errno.ENOENT:  # ENOENT: the entry ended before its removal
                    raise
            else:
                deleted += 1
    return deleted


INSIDE = "eth0"
_TUNNELS = (PortRange.one(500), PortRange.one(4500))  # IKE; ESP in UDP
_POOL = ipaddress.IPv4Network("10.111.0.0/16")
_POOL6 = ipaddress.IPv6Network("fd52:4f53:5256::/48")
_AN_HOUR = 3600.0
_GLOBAL: dict[Family, str] = {4: "net/ipv4/ip_forward", 6: "net/ipv6/conf/all/forwarding"}


@dataclass(frozen=True, kw_only=True)
class IsolationSettings:
    """The appliance's namespace, and the ports forwarded to it."""

    ports: tuple[PortRange, ...]  # TCP
    master: int | None = None  # forwarded by `forward_master` only, when RVMaster answers
    datagrams: tuple[PortRange, ...] = ()  # UDP
    refused: tuple[
        tuple[Family, PortRange], ...
    ] = ()  # ports on which the appliance does not listen in this family
    name: str = "rosrv"
    directory: Path = Path("/run/rosrv")  # for the record and the lock; shared by all appliances of a host
    takes_over: Callable[[], bool] = lambda: False  # whether a ROS master of the robot may listen on `master`
    holds: Callable[[], bool] = lambda: False  # whether nodes must not reach that master, even after a crash
    wants: Callable[[], bool] = lambda: False  # whether the graph of that master is to be taken over
    left_alone: Callable[[], tuple[str, ...]] = tuple  # control groups of the robot's own masters
    nodes: Callable[[], tuple[str, ...]] = tuple  # keys of processes that were connected to a master

    def __post_init__(self) -> None:
        if not self.ports:
            raise ValueError("isolation netns: no port to forward was given")

    @property
    def link(self) -> str:
        return f"veth-{self.name}"[: interfaces.IFNAMSIZ]


@dataclass(frozen=True)
class LinkAddresses:
    """The addresses of the link's ends."""

    network: str
    host: str
    appliance: str

    @property
    def length(self) -> int:
        return ipaddress.ip_network(self.network).prefixlen


class _IpForwarding:
    """Reads, enables and restores IP forwarding.

    The kernel copies the global setting to every interface, so each is also recorded. A host that forwards ignores
    IPv6 router advertisements unless `accept_ra` is 2.
    """

    def __init__(self, host: Namespace) -> None:
        self._host = host

    def has_ipv6(self) -> bool:
        if not self._host.run(Path("/proc/sys/net/ipv6").exists):
            return False
        return self._host.sysctl("net/ipv6/conf/all/disable_ipv6") == "0"

    def before(self, family: Family) -> bool:
        return self._host.sysctl(_GLOBAL[family]) != "0"

    def record(self) -> dict[str, str]:
        families: tuple[Family, ...] = (4, 6) if self.has_ipv6() else (4,)
        keys = [_GLOBAL[family] for family in families]
        for name in (*interfaces.links(self._host), "default"):
            keys += [f"net/ipv{family}/conf/{name}/forwarding" for family in families]
            keys += [f"net/ipv6/conf/{name}/accept_ra" for family in families if family == 6]
        return {key: self._host.sysctl(key) for key in keys}

    def enable(self, families: Sequence[Family]) -> None:
        if 6 in families and not self.before(6):
            for name in interfaces.links(self._host):
                key = f"net/ipv6/conf/{name}/accept_ra"
                if self._host.sysctl(key) == "1":
                    self._host.sysctl(key, "2")
        for family in families:
            if not self.before(family):
                self._host.sysctl(_GLOBAL[family], "1")

    def restore(self, record: dict[str, str]) -> None:
        for key, value in record.items():
            if self._host.run((Path("/proc/sys") / key).exists) and self._host.sysctl(key) != value:
                self._host.sysctl(key, value)


class Isolation:
    """The namespace of the appliance and its link to the host's networks."""

    def __init__(self, host: Namespace, settings: IsolationSettings) -> None:
        self._host = host
        self.settings = settings
        self.namespace = Namespace(settings.name)
        self.ends: dict[Family, LinkAddresses] = {}
        self._backend = NftBackend(host)
        self._rules: tuple[PacketRule, ...] = ()
        self._udp: tuple[PortRange, ...] = ()
        self._tcp: tuple[PortRange, ...] = ()
        self._serves_nodes = False
        self._turn = threading.Lock()  # so that no rule is restored during a change, or after the removal
        self.removed_at = -math.inf
        self.installed_at = -math.inf
        self._routers: tuple[Family, ...] = ()
        self._forwarding = _IpForwarding(host)
        self._disturbed = DisturbedConnections(host, self.namespace, settings.link)
        self._protection = ""  # the rules of `rosrv protect` on this machine
        self.unprotected = ""  # why they are not in force again, after another program removed them
        self._dropped: dict[str, tuple[int, float]] = {}  # by a rule's purpose: packets, and when they grew
        self._missing: list[str] = []  # rules that were missing, until `put_rules_back` has returned them
        self._lock: int | None = None

    def up(self) -> None:
        """Build the isolation, after removing leftovers of a crash.

        Raises `PrivilegeError`, or `NetworkError`; the host is then left unchanged.
        """
        require_privileges("isolation netns")
        self._take_lock()
        try:
            self._close_master()
            self._clear_leftovers()
            self._refuse_foreign()
            self._choose_subnets()
            self._write_record()
            self._build()
        except BaseException:
            self.down()
            raise

    def down(self) -> None:
        if self._lock is None:
            return
        with self._turn:
            rules, self._rules = self._rules, ()
            self._protection = self.unprotected = ""
            self._missing.clear()
        try:
            self._close_master()
            self._clear_leftovers()
            if rules:
                self._forget_tunnels()
        finally:
            self.ends.clear()
            self.removed_at = -math.inf
            self._udp = self._tcp = ()
            self._serves_nodes = False
            os.close(self._lock)
            self._lock = None

    def clear(self) -> None:
        """Remove what a crashed appliance left. Raises `NetworkError`, for example while an appliance runs."""
        require_privileges("isolation netns")
        self._take_lock()
        try:
            self._clear_leftovers()
            open_port(self._host)
        finally:
            assert self._lock is not None  # noqa: S101  it was taken
            os.close(self._lock)
            self._lock = None

    @property
    def host(self) -> Namespace:
        return self._host

    def host_address_for(self, peer: str) -> str:
        return interfaces.source_address_for(self._host, peer)

    def machine_addresses(self) -> tuple[str, ...]:
        """Return the host's addresses, without those of the appliance's link. Cheap."""
        ours = {end.host for end in self.ends.values()}
        return tuple(address for address in self._host.run(machine_addresses) if address not in ours)

    def endpoint(self) -> PublicAddress:
        """Return the address by which other networks reach this machine. Raises `NetworkError` if it is unknown."""
        return outward_address(self._host, without=("lo", self.settings.link))

    def obstacles(self) -> tuple[str, ...]:
        """Return what keeps connections from their end on this machine, with a remedy for each."""
        link = self.settings.link
        obstacles = [
            f"{chain} drops forwarded packets by default: let interface {link} pass in it, both ways"
            for chain in (*self._backend.foreign_forward_drops(), *iptables.foreign_forward_drops(self._host))
        ]
        obstacles += [
            f"packets from {source} have routing table {table}, but the appliance's answers do not: `ip rule add iif"
            f" {link} lookup {table}`, and `advertise` {source} to the networks behind it"
            for source, table in interfaces.tables_of_sources(self._host, link)
        ]
        if taken := self._listening_ports((*self.settings.ports, *self._tcp)):
            holder = self._host.run(lambda: describe_holder(taken))
            obstacles.append(f"{holder}, which leads to the appliance: give it another port")
        no_router = {_no_router(family): _GLOBAL[family].replace("/", ".") for family in self.ends}
        obstacles += [
            f"{rule.purpose}, and dropped packets in the last hour: if containers, virtual machines or a hotspot send"
            f" them, write `{no_router[rule.purpose]} = 1` into /etc/sysctl.d, and boot again"
            for rule in self.rules()
            if rule.purpose in no_router and self._drops(rule)
        ]
        return tuple(obstacles)

    def _drops(self, rule: FirewallRule) -> bool:
        packets, time = self._dropped.get(rule.purpose, (0, -math.inf))
        if rule.packets not in (0, packets):  # 0: they were restored
            packets, time = self._dropped[rule.purpose] = rule.packets, clock.now()
        return clock.now() < time + _AN_HOUR

    def forward_again(self) -> tuple[Family, ...]:
        """Enable the forwarding that another program has ended; return its families. Raises `NetworkError`."""
        ended = tuple(family for family in self.ends if not self._forwarding.before(family))
        self._forwarding.enable(ended)
        return ended

    def translations(self) -> tuple[str, ...]:
        return (*self._backend.foreign_translations(), *iptables.foreign_translations(self._host))

    def forward_tunnels(self) -> None:
        """Forward IKE and ESP to the appliance. Raises `NetworkError` if the host uses UDP 500 or 4500."""
        used = self._host.run(udp_ports_in_use) & {port.first for port in _TUNNELS}
        if used and self._udp != _TUNNELS:
            raise NetworkError(
                f"a program of the host uses UDP {', '.join(map(str, sorted(used)))}, needed by the appliance's"
                " tunnels: stop it (strongSwan's own service: systemctl mask --now strongswan), or run the appliance"
                " in a container"
            )
        self._udp = _TUNNELS
        self._bring()

    def require_free(self, ports: Iterable[int]) -> None:
        """Raise `NetworkError` if a program of the host listens on a port that is not forwarded."""
        used = self._host.run(listening_ports) & ({*ports} - {port_range.first for port_range in self._tcp})
        if used:
            raise NetworkError(
                f"a program of the host listens on TCP {', '.join(map(str, sorted(used)))}: stop it, or choose"
                " another port"
            )

    def forward_also(self, ports: tuple[PortRange, ...]) -> None:
        self._tcp = ports
        self._bring()

    def forward_master(self) -> None:
        """Forward the port of RVMaster, which answers now. Raises `PortsInUseError`."""
        if not self._serves_nodes:
            self._refuse_listeners(self._own_master())
        self._serves_nodes = True
        self._bring()

    def _close_master(self) -> None:
        """Refuse the robot's own master while there are no rules, if a crash or a failure left its graph taken over."""
        if self.settings.master is not None and self.settings.holds():
            close_port(self._host, self.settings.link, self.settings.master)

    @property
    def awaits_graph(self) -> bool:
        return self.settings.master is not None and not self._serves_nodes and self.settings.wants()

    @property
    def is_released(self) -> bool:
        return self.settings.master is not None and not self._serves_nodes and not self.settings.wants()

    def withdraw_master(self) -> None:
        """End what `forward_master` began: the port is again that of the robot's own master."""
        self._serves_nodes = False
        self.removed_at = -math.inf
        self._bring()

    def _own_master(self) -> tuple[PortRange, ...]:
        """Return RVMaster's port if no other master may listen on it."""
        master = self.settings.master
        return () if master is None or self.settings.takes_over() else (PortRange.one(master),)

    def _wanted_rules(self) -> tuple[PacketRule, ...]:
        master = (PortRange.one(self.settings.master),) if self.settings.master and self._serves_nodes else ()
        return isolation_rules(
            self.settings, self.ends, self._routers, tcp=self._tcp, udp=self._udp, master=master,
            restored=self.removed_at > -math.inf,
        )  # fmt: skip

    def watch_rules(self) -> RuleWatch:
        return RuleWatch(subscribe(self._host), frozenset({TABLE, close_ports.TABLE}))

    def put_rules_back(self) -> list[str]:
        """Install the rules again if the kernel lacks some; return the purposes of these. Raises `NetworkError`.

        If those of `rosrv protect` went with them, no operator meant that: they come back as well. While they cannot,
        `unprotected` has the reason, and each call tries again. After an error, the next call does what this one left.
        """
        with self._turn:
            absent = [rule.purpose for rule in self.rules() if not rule.in_force]
            self._missing += [purpose for purpose in absent if purpose not in self._missing]
            if absent:
                self.removed_at = clock.now()
            if absent or (self._rules and self._rules != self._wanted_rules()):
                with installing_again():
                    self._put()
            protection = self._host.run(close_ports.applied_rules) if self._rules else ""
            if self._protection and not protection and (self._missing or self.unprotected):
                self._protect_again()
            else:
                self._protection, self.unprotected = protection, ""
            if self._missing:
                self._forget_tunnels()
            missing, self._missing = self._missing, []
        return missing

    def _protect_again(self) -> None:
        try:
            run_nft(self._host, self._protection)
        except NetworkError as error:
            if not self.unprotected:
                self._missing.append("rosrv protect (NOT in force again)")
            self.unprotected = (
                f"another program removed the rules of `rosrv protect`, and they cannot be installed again: {error}."
                " Other machines can reach the nodes of this one: apply them again (rosrv protect … --apply)"
            )
        else:
            self._missing.append("rosrv protect")
            self.unprotected = ""

    def remember_connections(self) -> None:
        """Note the connections that exist while the rules are in force; call this each second."""
        self._disturbed.remember()

    def end_connections(self) -> int:
        """End what a removal of the rules has disturbed; return the number of connections that began in that time.

        Raises `NetworkError`.
        """
        spans = (*self.settings.ports, *self._tcp)
        forwarded = {port for span in spans for port in range(span.first, span.last + 1)}
        master = self.settings.master if self._serves_nodes else None
        near = [end.appliance for end in self.ends.values()]
        return self._disturbed.end(forwarded, master, near, self.settings.nodes())

    def rules(self) -> tuple[FirewallRule, ...]:
        return statuses(self._rules, self._backend.counters())

    def _bring(self) -> None:
        """Install the wanted rules unless they are installed: an earlier call may have failed at any step."""
        with self._turn:
            if self._rules != self._wanted_rules():
                self._put()
        self._forget_tunnels()

    def _put(self) -> None:
        rules = self._wanted_rules()
        self._backend.install(rules)
        self._rules, self.installed_at = rules, clock.now()
        if self.settings.takes_over():
            vendor_masters.leave_alone(self._host, self.settings.left_alone())

    def _forget_tunnels(self) -> None:
        forget_tracked(self._host, [port.first for port in _TUNNELS])

    def _build(self) -> None:
        settings, inside = self.settings, self.namespace
        inside.create()
        interfaces.set_link(inside, "lo", up=True)
        interfaces.create_veth(self._host, settings.link, inside, INSIDE)
        for family, ends in self.ends.items():
            if family == 6:  # a new interface takes `default`, which hardened machines set
                self._host.sysctl(f"net/ipv6/conf/{settings.link}/disable_ipv6", "0")
                inside.sysctl(f"net/ipv6/conf/{INSIDE}/disable_ipv6", "0")
            interfaces.add_address(self._host, settings.link, f"{ends.host}/{ends.length}")
            interfaces.add_address(inside, INSIDE, f"{ends.appliance}/{ends.length}")
            interfaces.add_near_route(
                self._host, settings.link, ends.appliance, source=ends.host, hop_limit=255
            )
            interfaces.add_route(inside, "default", ends.host)
            if family == 4:  # let packets from 127.0.0.1 leave on this link
                self._host.sysctl(f"net/ipv4/conf/{settings.link}/route_localnet", "1")
        routers = tuple(family for family in self.ends if self._forwarding.before(family))
        self._routers = routers
        self._serves_nodes = settings.holds()
        self._bring()  # before forwarding is enabled
        self._forwarding.enable(tuple(self.ends))
        open_port(self._host)

    def _choose_subnets(self) -> None:
        taken = [ipaddress.ip_network(text) for text in interfaces.networks(self._host)]
        self.ends = {4: _choose(_POOL, 30, taken)}
        if self._forwarding.has_ipv6():
            self.ends[6] = _choose(_POOL6, 64, taken)

    def _refuse_foreign(self) -> None:
        name, link = self.settings.name, self.settings.link
        if self.namespace.exists():
            raise NetworkError(
                f"the network namespace {name} already exists, and this appliance did not create it: "
                f"`sudo ip netns delete {name}` if it is unused, or give the appliance another name"
            )
        if link in interfaces.links(self._host):
            raise NetworkError(
                f"the interface {link} already exists, and this appliance did not create it: `ip link delete {link}`"
            )
        self._refuse_listeners((*self._own_master(), *self.settings.ports))

    def _refuse_listeners(self, ranges: tuple[PortRange, ...]) -> None:
        """Raise `PortsInUseError` if a program of the host listens in `ranges`; it is named by the first of them."""
        if clashes := self._listening_ports(ranges):
            remedy = "stop it, or give the appliance other ports"
            if clashes[0] == self.settings.master:
                remedy = "`sudo rosrv adopt` takes its graph over, or stop it"
            raise PortsInUseError(f"{self._host.run(lambda: describe_holder(clashes))}; {remedy}")

    def _listening_ports(self, ranges: tuple[PortRange, ...]) -> list[int]:
        in_use = sorted(self._host.run(listening_ports))
        return [port for span in ranges for port in in_use if span.first <= port <= span.last]

    def _take_lock(self) -> None:
        if self._lock is not None:
            raise NetworkError(f"isolation {self.settings.name} is already up")
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
        try:
            return f"namespace {json.loads(self._record.read_text(encoding='utf-8'))['namespace']}"
        except (OSError, ValueError, KeyError, TypeError):
            return "still starting"

    def _write_record(self) -> None:
        record = {
            "namespace": self.settings.name,
            "link": self.settings.link,
            "settings": self._forwarding.record(),
        }
        write_whole(self._record, json.dumps(record).encode(), 0o644)

    def _clear_leftovers(self) -> None:
        try:
            record = json.loads(self._record.read_text(encoding="utf-8"))
            name, link = str(record["namespace"]), str(record["link"])
            leftover = self.namespace if name == self.settings.name else Namespace(name)
            settings = {str(key): str(value) for key, value in record["settings"].items()}
        except FileNotFoundError:
            return
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise NetworkError(f"{self._record} cannot be read ({error}): check it and delete it") from error
        self._forwarding.restore(settings)  # first: without ROSRV-FWD the host would route
        self._backend.remove()
        refuse_no_port(self._host)
        interfaces.delete_link(self._host, link)
        end_processes(leftover.processes())
        leftover.delete()
        with contextlib.suppress(FileNotFoundError):
            self._record.unlink()


def isolation_rules(
    settings: IsolationSettings,
    ends: dict[Family, LinkAddresses],
    routers: tuple[Family, ...],
    *,
    tcp: tuple[PortRange, ...] = (),
    udp: tuple[PortRange, ...] = (),
    master: tuple[PortRange, ...] = (),
    restored: bool = False,
) -> tuple[PacketRule, ...]:
    """Return the rules; `restored`: other machines may have begun connections to the robot's own master."""
    inward, outward = Interface(settings.link), Interface(settings.link, other=True)
    forwarded = partial(PacketRule, chain=Chain.FORWARD)
    leaving = partial(PacketRule, chain=Chain.LEAVING, leaves_on=inward)
    rules = [
        PacketRule(
            "the appliance does not reach the host's loopback",
            PacketVerdict.DROP,
            chain=Chain.IN,
            arrives_on=inward,
            destination="127.0.0.0/8",
            new_connection=True,
        ),
        forwarded("forwarded ports", PacketVerdict.RETURN, leaves_on=inward, translated=True),
        forwarded("no other way to the appliance", PacketVerdict.DROP, leaves_on=inward, unknown=True),
        PacketRule(
            "the host's own loopback", PacketVerdict.RETURN, chain=Chain.ARRIVING, arrives_on=LOOPBACK
        ),
        leaving(
            "no packet from elsewhere with an address of the host",
            PacketVerdict.DROP,
            arrives_on=outward,  # local neighbour discovery seems to arrive where it leaves
            local_source=True,
            forwarded=True,
        ),
        leaving("the host's own packets: full TTL", PacketVerdict.FULL_HOPS, forwarded=False),
    ]
    to_master = partial(PacketRule, chain=Chain.IN)
    for ports in master if restored else ():
        rules += [
            to_master(
                "own master: this machine may", PacketVerdict.RETURN, arrives_on=LOOPBACK, tcp_ports=ports
            ),
            to_master(
                "own master: no other machine", PacketVerdict.DROP, arrives_on=outward, tcp_ports=ports
            ),
        ]
    for family, end in ends.items():
        if family not in routers:
            no_router = partial(forwarded, family=family, arrives_on=outward, leaves_on=outward)
            rules.append(no_router(_no_router(family), PacketVerdict.DROP))
        rules += [_loopback(family, inward), *_true_sources(family, end, inward)]
        there, refused = (
            [
                ports
                for ports in (*settings.ports, *tcp, *master)
                if ((family, ports) in settings.refused) is so
            ]
            for so in (False, True)
        )
        rules += [rule for ports in refused for rule in _refusal_rules(family, ports, outward)]
        rules += [_forward("TCP", ports, end, outward) for ports in there if ports not in master]
        # A node's old connection to its own master may be new to the connection tracker: its packets stay there, so
        # that the node sees it end, and not a reset, after which roscpp looks a service up only once.
        rules += [
            replace(_forward("TCP", ports, end, outward), opening=True) for ports in there if ports in master
        ]
        rules += [_forward("UDP", ports, end, outward) for ports in (*settings.datagrams, *udp)]
        masqueraded = partial(PacketRule, chain=Chain.SOURCE_NAT, source=end.network, leaves_on=outward)
        rules.append(masqueraded(f"the appliance's own connections, IPv{family}", PacketVerdict.MASQUERADE))
    return tuple(rules)


def _no_router(family: Family) -> str:
    return f"the host is not an IPv{family} router"


def _true_sources(family: Family, end: LinkAddresses, inward: Interface) -> tuple[PacketRule, ...]:
    elsewhere = partial(PacketRule, chain=Chain.ARRIVING, arrives_on=Interface(inward.name, other=True))
    entering = partial(PacketRule, chain=Chain.KEPT_SOURCE, family=family, leaves_on=inward)
    return (
        elsewhere(
            f"IPv{family} addresses of the appliance's link, from elsewhere",
            PacketVerdict.DROP,
            source=end.network,
        ),
        entering(
            f"to the appliance: no other rule translates IPv{family} sources", PacketVerdict.KEEP_SOURCE
        ),
    )


def _loopback(family: Family, inward: Interface) -> PacketRule:
    """Return the rule for the host's own loopback; ::1 cannot leave a host, so it stays refused."""
    if family == 4:
        local = partial(PacketRule, chain=Chain.KEPT_SOURCE, source="127.0.0.0/8", leaves_on=inward)
        return local("from the host's own loopback", PacketVerdict.MASQUERADE)
    return PacketRule("not from ::1", PacketVerdict.RETURN, chain=Chain.NAT, destination="::1")


def _refusal_rules(family: Family, ports: PortRange, outward: Interface) -> tuple[PacketRule, ...]:
    """Return the rules that refuse connections at once, whichever chain drops what would be forwarded.

    A client with addresses of both families goes on with the other. A program at ::1 is not the appliance's.
    """
    opening = partial(PacketRule, chain=Chain.IN, tcp_ports=ports, opening=True)
    refuse = opening(
        f"TCP {ports}: the appliance does not listen on IPv{family}",
        PacketVerdict.RESET,
        family=family,
        arrives_on=outward,
    )
    own = opening(f"TCP {ports}: ::1 is the host's", PacketVerdict.RETURN, destination="::1")
    return (own, refuse) if family == 6 else (refuse,)


def _forward(
    protocol: Literal["TCP", "UDP"], ports: PortRange, end: LinkAddresses, outward: Interface
) -> PacketRule:
    return PacketRule(
        f"{protocol} {ports} to the appliance, IPv{family_of(end.appliance)}",
        PacketVerdict.DNAT,
        chain=Chain.NAT,
        arrives_on=outward,
        tcp_ports=ports if protocol == "TCP" else None,
        udp_ports=ports if protocol == "UDP" else None,
        local_destination=True,
        to=end.appliance,
    )


_Network = ipaddress.IPv4Network | ipaddress.IPv6Network


def _choose(pool: _Network, length: int, taken: list[_Network]) -> LinkAddresses:
    # A VPN's route around the whole pool serves all but the few addresses of the subnet, which is narrower.
    rivals = [other for other in taken if other.overlaps(pool) and other.prefixlen >= pool.prefixlen]
    for candidate in pool.subnets(new_prefix=length):
        if not any(candidate.overlaps(other) for other in rivals):
            return LinkAddresses(str(candidate), str(candidate[1]), str(candidate[2]))
    raise NetworkError(f"isolation netns: this host has routes to all of {pool}")
