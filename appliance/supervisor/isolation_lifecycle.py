"""Build, check and remove the isolation of the processes: their network namespace and the firewall.

All calls block, the probe for seconds, so a running supervisor makes them in a thread, one at a time.

1. No process starts before the firewall is in force.
2. A hidden port counts as open if another local user can reach it, or if it cannot be probed.
3. Missing rules are installed again and logged, but none after `remove`: it waits for a running call; later calls
   fail. `restore` waits for no other work, and does nothing after `remove`.
"""

import contextlib
import ipaddress
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import msgspec
import structlog

from appliance.base import clock
from appliance.channel.answers.status import FirewallState
from appliance.channel.rosout_address import ADDRESS as OWN_NODE_ADDRESS
from appliance.ipsec.leftovers import LeftoversError, clear_leftovers
from appliance.ipsec.strongswan import USER_SPACE_INTERFACE
from appliance.network import interfaces
from appliance.network.close_ports import local_port_range
from appliance.network.cut import NO_INODE, end_connections
from appliance.network.esp import Esp, choose_esp, lend_tun
from appliance.network.firewall.firewall import Firewall
from appliance.network.firewall.firewall_rules import (
    MAX_PORT,
    Family,
    FirewallSettings,
    ForwarderAccess,
    OwnNetworkAccess,
    OwnNodeAccess,
    PeerAccess,
    PortRange,
    appliance_rules,
)
from appliance.network.firewall.rule_watch import RuleWatch, subscribe
from appliance.network.isolation import Isolation, IsolationSettings
from appliance.network.listening_sockets import TcpSocket, listening_ports, tcp_inodes
from appliance.network.machine_addresses import machine_addresses
from appliance.network.namespaces import (
    Namespace,
    NetworkError,
    is_contained,
    lives_on_the_machines_network,
    shared_network,
)
from appliance.network.port_holders import PortsInUseError
from appliance.network.probe import probe_port
from appliance.network.public_address import PublicAddress, only_address
from appliance.supervisor.errors import PortInUseError, StartError
from appliance.supervisor.machine_work import Found, MachineWork, NoMachineWork, Terms
from appliance.supervisor.role import RemoteReceiver
from appliance.supervisor.users import account_of

_TUNNELS = "rosrv-ipsec"  # the user of charon
_FIRST_FREE_PORT = 1024
_PATIENCE_SECONDS = 5.0  # longest wait of `remove` for a call that hangs

log = structlog.get_logger()


@dataclass(frozen=True)
class AppliancePorts:
    """The ports of the appliance; `inner` and `own` are known only when control is ready."""

    master: int
    rosmaster: int
    nodes: range
    own_node: range  # for messages of the appliance's own node
    inner: int | None = None
    unserved: tuple[Family, ...] = ()  # families in which RVMaster and the nodes' ports do not listen
    api: int | None = None  # None: there is no REST
    api_networks: tuple[str, ...] = ()  # networks that may connect to REST; this machine always may
    own: int | None = None  # the port of the own node's master
    peer: PeerAccess | None = None  # on one of two appliances
    receivers: tuple[tuple[str, RemoteReceiver], ...] = ()  # of features' roles, by user


class RestoredRules(NamedTuple):
    """The purposes of rules that were missing, and the time at which all were in force."""

    rules: list[str]
    at: float


class NoIsolation:
    """The processes share the supervisor's namespace, without a firewall."""

    kind = "none"
    probes = False
    link = ""  # the interface of the host that leads to the appliance
    trusted_machine: tuple[str, ...] = ()  # addresses of the machine; foreign packets with them are dropped
    lapse = ""  # why the robot's own programs may have started without the appliance

    @property
    def unprotected(self) -> str:
        """Return why the rules of `rosrv protect`, which another program removed, are not in force again, or ""."""
        return ""

    @contextlib.contextmanager
    def inside(self) -> Iterator[None]:
        yield

    def awaits_graph(self) -> bool:
        """Return whether the robot's own master still has its port, and its graph is to be taken over."""
        return False

    def is_released(self) -> bool:
        """Return whether the robot's own master has its port, and keeps its graph."""
        return False

    def build(self) -> None:
        """Build the isolation. Raises `StartError`, after removing everything that was built."""

    def remove(self) -> None: ...

    def control_ready(self, inner_port: int, own_port: int) -> None:
        """Close both ports to other users, and let nodes reach RVMaster. Raises `NetworkError`."""

    def open_tunnels(self, pool: str, address: str) -> Esp:  # noqa: ARG002  the same everywhere
        """Accept addresses of `pool` through IPsec only. Raises `NetworkError`."""
        raise NetworkError(
            f"isolation {self.kind} has no firewall that would keep tunnelled addresses from being forged:"
            " use isolation netns or container"
        )

    def open_own_network(self, network: str, ports: list[int]) -> None:  # noqa: ARG002  the same everywhere
        """Let only the appliance use these addresses, and open these TCP ports. Raises `NetworkError`."""
        raise NetworkError(
            f"isolation {self.kind} has no namespace of its own, so any program of this machine could use the address"
            " of a door: use isolation netns or container"
        )

    def clear_tunnels(self) -> None:
        """Remove the IPsec states and policies of an ended charon. Raises `NetworkError`, `LeftoversError`."""

    def machine_addresses(self) -> tuple[str, ...]:
        """Return the addresses whose packets, if they reach the appliance, were made on the robot's machine."""
        return ()

    def trust_machine(self, addresses: tuple[str, ...]) -> None:
        """Drop packets with these addresses that were not made on the machine. Raises `NetworkError`."""

    def route_to(self, host: str) -> str | None:  # noqa: ARG002  the same everywhere
        return None

    def endpoint(self) -> PublicAddress:
        """Return the address at which other networks reach the appliance. Raises `NetworkError` if it is unknown."""
        raise NetworkError(f"isolation {self.kind} has no tunnels: use isolation netns or container")

    def carry_out(self, work: MachineWork, name: str, terms: Terms) -> Found:  # noqa: ARG002  the same everywhere
        """Carry out a feature's work on the robot's side of the isolation. Raises `NetworkError`, `ValueError`."""
        raise NetworkError(f"isolation {self.kind} has no robot's side: use isolation netns")

    def watch_rules(self) -> list[RuleWatch]:
        """Return watches of the namespaces that have rules. Raises `OSError`."""
        return []

    def restore(self) -> RestoredRules:
        """Install rules again that another program removed. Raises `NetworkError`."""
        return RestoredRules([], clock.now())

    def remember_connections(self) -> None:
        """Note the connections that exist while the rules are in force."""

    def end_connections(self) -> int:
        """End what a removal of the rules has disturbed; return the number of connections that began in that time.

        Raises `NetworkError`.
        """
        return 0

    def report(self) -> FirewallState:
        return FirewallState()

    def probe(self) -> str | None:
        return None


class ContainerIsolation(NoIsolation):
    """Uses the supervisor's own namespace, with the firewall."""

    kind = "container"
    probes = True

    def __init__(
        self,
        ports: AppliancePorts,
        backend: Literal["auto", "iptables", "nft"],
        namespace: Namespace | None = None,
    ) -> None:
        self._ports = ports
        self._namespace = namespace or Namespace.own()
        self._backend = backend
        self.firewall: Firewall | None = None
        self._tunnels: tuple[str, Esp] | None = None  # the pool, and where ESP runs
        self._own: str | None = None  # the appliance's address in the tunnels
        self._own_network: str | None = None
        self._own_ports: tuple[PortRange, ...] = ()  # of doors
        self._found: list[str] = []  # rules that `report` has installed again, for the next `restore`
        self._owed = False  # whether the kernel rejected the last rules, so they must be installed again
        self._changing = threading.RLock()
        self._ending = False
        self._before = self._last = frozenset[str]()  # sockets at the last look but one, and at the last

    @contextlib.contextmanager
    def _standing(self) -> Iterator[None]:
        with self._changing:
            self._require_standing()
            yield

    def _require_standing(self) -> None:
        if self._ending:
            raise NetworkError("the appliance stops: removing the firewall")

    @contextlib.contextmanager
    def _taking_away(self) -> Iterator[None]:
        self._ending = True
        held = self._changing.acquire(timeout=_PATIENCE_SECONDS)
        if not held:
            log.error("a firewall check hangs; removing the firewall anyway")
        try:
            yield
        finally:
            if held:
                self._changing.release()

    def build(self) -> None:
        self._ending = False
        if self._namespace == Namespace.own():
            _require_own_network()
        try:
            self.firewall = Firewall(self._namespace, self._backend)
            chosen = self.firewall.install(self._settings())
        except NetworkError as error:
            self.remove()
            raise StartError(str(error)) from error
        log.info("firewall is in force", backend=chosen, isolation=self.kind)
        if self._namespace.lacks_syn_cookies():
            log.warning(
                "no SYN cookies: SYN packets from forged addresses can lock every host out",
                remedy="sysctl -w net.ipv4.tcp_syncookies=1",
            )

    def remove(self) -> None:
        if self.firewall is None:
            return
        with self._taking_away():
            try:
                if self._own is not None:
                    self._end_tunnels(self._own)
                if self._own_network is not None:
                    interfaces.delete_local_route(self._namespace, self._own_network)
                self.firewall.remove()
            except NetworkError as error:
                log.error(
                    "firewall rules may remain: start the appliance again, or see `nft list ruleset`",
                    error=str(error),
                )

    def _end_tunnels(self, own: str) -> None:
        try:
            self._namespace.run(lambda: clear_leftovers(own.partition("/")[0]))
            interfaces.delete_address(self._namespace, "lo", own)
        except (NetworkError, LeftoversError) as error:
            log.error("tunnel state may remain", error=str(error))

    def control_ready(self, inner_port: int, own_port: int) -> None:
        with self._standing():
            if self.firewall is not None and (inner_port, own_port) != (self._ports.inner, self._ports.own):
                self._ports = replace(self._ports, inner=inner_port, own=own_port)
                self._owed = True
                self.firewall.update(self._settings())
                self._owed = False

    def open_tunnels(self, pool: str, address: str) -> Esp:
        """Close the pool to clear text before it becomes reachable."""
        with self._standing():
            if self.firewall is None:
                raise NetworkError("the firewall is not in force")
            esp = choose_esp(self._namespace)
            if esp == "user space":
                account = account_of(_TUNNELS)
                lend_tun(account.uid, account.gid)
            before, self._tunnels = self._tunnels, (str(ipaddress.ip_network(pool)), esp)
            if self._tunnels != before:
                try:
                    self.firewall.update(self._settings())
                except NetworkError:
                    self._tunnels = before
                    raise
            own = f"{ipaddress.IPv4Address(address)}/32"
            if own not in interfaces.addresses(self._namespace):
                interfaces.add_address(self._namespace, "lo", own)
            self._own = own
            return esp

    def open_own_network(self, network: str, ports: list[int]) -> None:
        """Close the network to other machines before its addresses become the appliance's."""
        # Control is not trusted: accept only a network that was not in use before, and ports without a privilege.
        wanted, opened = str(ipaddress.IPv4Network(network)), tuple(map(PortRange.one, sorted(set(ports))))
        if any(port.first < _FIRST_FREE_PORT for port in opened):
            raise NetworkError(f"the ports of doors are {_FIRST_FREE_PORT} to {MAX_PORT}")
        with self._standing():
            if self.firewall is None:
                raise NetworkError("the firewall is not in force")
            if self._own_network not in (None, wanted):
                raise NetworkError(f"the network of doors is {self._own_network} until the next start")
            self._require_unused(ipaddress.IPv4Network(wanted))
            before, self._own_network, self._own_ports = self._own_ports, wanted, opened
            try:
                self.firewall.update(self._settings())
                interfaces.add_local_route(self._namespace, wanted)
            except NetworkError:
                self._own_ports = before
                raise

    def _require_unused(self, network: ipaddress.IPv4Network) -> None:
        for text in interfaces.addresses(self._namespace):
            held = ipaddress.ip_interface(text).network
            if held.version == 4 and held.overlaps(network):
                raise NetworkError(
                    f"doors.network {network} overlaps {text} of this machine: set another network"
                )

    def clear_tunnels(self) -> None:
        with self._standing():
            if self._own is not None:
                address = self._own.partition("/")[0]
                self._namespace.run(lambda: clear_leftovers(address))

    def endpoint(self) -> PublicAddress:
        """Return the only address; if there are several, it is unknown which of them other hosts reach."""
        address = only_address(self._namespace, without=("lo", USER_SPACE_INTERFACE))
        if is_contained() and not lives_on_the_machines_network():
            reason = f"{address.reason}, in a container: outside the machine the address may differ"
            return replace(address, reason=reason)
        return address

    def watch_rules(self) -> list[RuleWatch]:
        return [RuleWatch(subscribe(self._namespace))]

    def restore(self) -> RestoredRules:
        found = [] if self.firewall is None else self.firewall.restore()
        found, self._found = self._found + found, []
        return RestoredRules(found, clock.now())

    def remember_connections(self) -> None:
        self._before, self._last = self._last, self._namespace.run(tcp_inodes) - {NO_INODE}

    def end_connections(self) -> int:
        """End those that began without the rules, and that one of them refuses: permitted programs connect again.

        The rules refuse only new connections, so these would last.
        """
        rules, before = appliance_rules(self._settings()), self._before
        listening, own = self._namespace.run(lambda: (listening_ports(), machine_addresses()))

        def is_refused(socket: TcpSocket) -> bool:
            peer, accepted = socket.peer_address, socket.port in listening
            near = peer in own or peer == socket.local_address or ipaddress.ip_address(peer).is_loopback
            return any(rule.refuses(socket, accepted=accepted, near=near) for rule in rules)

        return end_connections(self._namespace, lambda one: one.inode not in before and is_refused(one))

    def report(self) -> FirewallState:
        with self._standing():
            if self.firewall is None:
                return FirewallState()
            report = self.firewall.report()
            if self._owed or not report.intact:
                gone = [rule.purpose for rule in report.rules if not rule.in_force]
                self._require_standing()
                log.critical("firewall rules were missing and are installed again", rules=gone)
                self._found += gone
                self.firewall.install(self._settings())
                self._owed = False
                report = self.firewall.report()
        return FirewallState(
            report.backend, list(report.not_used), list(report.rules), hold_lapsed=self.lapse or None
        )

    def probe(self) -> str | None:
        ports = {
            "ROSMaster": self._ports.rosmaster,
            "the master-side proxy endpoint": self._ports.inner,
            "the own nodes' master": self._ports.own,
        }
        found = (self._probe(what, port) for what, port in ports.items() if port is not None)
        return "; ".join(filter(None, found)) or None

    def _probe(self, what: str, port: int) -> str | None:
        try:
            seen = probe_port(self._namespace, port)
        except NetworkError as error:
            return f"whether {what} is hidden is unknown: {error}"
        if not seen.closed:
            return f"{what} can be reached by another user of this machine ({seen.describe()})"
        if seen.listening_outside:
            return f"{what} listens on {', '.join(seen.listening_outside)}, not on loopback only"
        return None

    def _settings(self) -> FirewallSettings:
        nodes = self._ports.nodes
        return FirewallSettings(
            control_uid=account_of("rosrv").uid,
            rosmaster_uid=account_of("rosmaster").uid,
            rosmaster_port=self._ports.rosmaster,
            inner_port=self._ports.inner,
            own_node=OwnNodeAccess(
                uid=account_of("rosrv-rosout").uid,
                relay_uid=account_of("rosrv-relay").uid,
                address=OWN_NODE_ADDRESS,
                ports=PortRange(self._ports.own_node.start, self._ports.own_node.stop - 1),
                master_port=self._ports.own,
            ),
            master_port=self._ports.master,
            node_ports=PortRange(nodes.start, nodes.stop - 1),
            client_ports=self._namespace.run(local_port_range),
            api_port=self._ports.api,
            api_networks=self._api_networks(),
            neighbours=self._neighbours(),
            tunnel_only=(self._tunnels[0],) if self._tunnels else (),
            forwarders=self._forwarders(),
            peer=self._ports.peer,
            own_network=None
            if self._own_network is None
            else OwnNetworkAccess(self._own_network, account_of("rosrv-relay").uid),
            own_ports=self._own_ports,
            tunnel_interface=USER_SPACE_INTERFACE
            if self._tunnels and self._tunnels[1] == "user space"
            else None,
        )

    def _api_networks(self) -> tuple[str, ...]:
        return (*self._ports.api_networks, *([self._tunnels[0]] if self._tunnels else []))

    def _neighbours(self) -> tuple[str, ...]:
        return ()

    def _forwarders(self) -> tuple[ForwarderAccess, ...]:
        return tuple(
            ForwarderAccess(
                account_of(user).uid,
                receiver.address,
                receiver.port,
                datagrams=receiver.protocol == "udp",
                name=receiver.client,
            )
            for user, receiver in self._ports.receivers
        )


class NetnsIsolation(ContainerIsolation):
    """Uses a separate namespace on a bare host, with forwarded ports for RVMaster, nodes and REST."""

    kind = "netns"

    def __init__(
        self,
        ports: AppliancePorts,
        backend: Literal["auto", "iptables", "nft"],
        isolation: Isolation | None = None,
        work: MachineWork | None = None,
    ) -> None:
        super().__init__(ports, backend)
        work = work or NoMachineWork()
        nodes = PortRange(ports.nodes.start, ports.nodes.stop - 1)
        forwarded = [nodes]
        if ports.api is not None:
            forwarded.append(PortRange.one(ports.api))
        datagrams: tuple[PortRange, ...] = ()
        if ports.peer is not None:
            datagrams = (PortRange.one(ports.peer.port),)
            forwarded += datagrams
        self._isolation = isolation or Isolation(
            Namespace.own(),
            IsolationSettings(
                ports=tuple(forwarded),
                master=ports.master,
                datagrams=datagrams,
                refused=tuple(
                    (family, span)
                    for family in ports.unserved
                    for span in (PortRange.one(ports.master), nodes)
                ),
                takes_over=work.takes_over,
                holds=work.holds,
                wants=work.wants,
                left_alone=work.left_alone,
                nodes=work.nodes,
            ),
        )
        self._namespace = self._isolation.namespace
        self.link = self._isolation.settings.link
        self._others: dict[str, list[str]] = {}  # the last logged rules of other programs

    def carry_out(self, work: MachineWork, name: str, terms: Terms) -> Found:
        with self._standing():
            return work.carry_out(self._isolation, name, terms)

    @contextlib.contextmanager
    def inside(self) -> Iterator[None]:
        with self._namespace.inside():
            yield

    def open_tunnels(self, pool: str, address: str) -> Esp:
        with self._standing():
            esp = super().open_tunnels(pool, address)
            self._isolation.forward_tunnels()
            return esp

    def open_own_network(self, network: str, ports: list[int]) -> None:
        with self._standing():
            self._isolation.require_free(ports)
            super().open_own_network(network, ports)
            self._isolation.forward_also(self._own_ports)

    def control_ready(self, inner_port: int, own_port: int) -> None:
        with self._standing():
            super().control_ready(inner_port, own_port)
            if not self._isolation.settings.takes_over():  # else control orders it, with the graph taken over
                self._isolation.forward_master()

    def awaits_graph(self) -> bool:
        return self._isolation.awaits_graph

    def is_released(self) -> bool:
        return self._isolation.is_released

    def build(self) -> None:
        try:
            self._isolation.up()
        except PortsInUseError as error:
            raise PortInUseError(str(error)) from error
        except NetworkError as error:
            raise StartError(str(error)) from error
        self.trusted_machine = self.machine_addresses()
        super().build()

    def remove(self) -> None:
        with self._taking_away():
            super().remove()
            try:
                self._isolation.down()
            except NetworkError as error:
                log.error("the namespace may remain; the next start removes it", error=str(error))

    def machine_addresses(self) -> tuple[str, ...]:
        return () if self._ports.peer is not None else self._isolation.machine_addresses()

    def trust_machine(self, addresses: tuple[str, ...]) -> None:
        with self._standing():
            wanted = tuple(sorted({*addresses}))
            if self.firewall is not None and wanted != self.trusted_machine:
                before, self.trusted_machine = self.trusted_machine, wanted
                try:
                    self.firewall.update(self._settings())
                except NetworkError:
                    self.trusted_machine = before
                    raise

    def _api_networks(self) -> tuple[str, ...]:
        # Connections from the host's loopback arrive with the address of the host's end of the link.
        return (*self._link_ends(), *super()._api_networks())

    def _link_ends(self) -> tuple[str, ...]:
        return tuple(ends.host for ends in self._isolation.ends.values())

    def _neighbours(self) -> tuple[str, ...]:
        return (*self._link_ends(), *self.trusted_machine)

    def route_to(self, host: str) -> str | None:
        # `host` comes from control, which is not trusted: accept only an address.
        address = ipaddress.ip_address(host)
        if self._tunnels is not None and address in ipaddress.ip_network(self._tunnels[0]):
            return None
        return self._isolation.host_address_for(host)

    def endpoint(self) -> PublicAddress:
        return self._isolation.endpoint()

    @property
    def unprotected(self) -> str:
        return self._isolation.unprotected

    def watch_rules(self) -> list[RuleWatch]:
        return [self._isolation.watch_rules(), *super().watch_rules()]

    def restore(self) -> RestoredRules:
        there = self._isolation.put_rules_back()
        self._found += there  # for the next call, if this one fails
        found = super().restore()
        return found._replace(at=self._isolation.installed_at) if there and there == found.rules else found

    def remember_connections(self) -> None:
        self._isolation.remember_connections()

    def end_connections(self) -> int:
        return self._isolation.end_connections()

    def report(self) -> FirewallState:
        with self._standing():
            gone = self._isolation.put_rules_back()
            if gone:
                log.critical("rules on the host were missing and are installed again", rules=gone)
                self._found += gone
            if ended := self._isolation.forward_again():
                log.critical("another program had ended IP forwarding, now enabled again", families=ended)
            rules = self._isolation.rules()
            return msgspec.structs.replace(super().report(), forwarding=list(rules), **self._look_at_others())

    def _look_at_others(self) -> dict[str, list[str]]:
        """Log changes of other programs' rules for forwarded packets, such as Docker's."""
        try:
            found = {
                "translations": list(self._isolation.translations()),
                "obstacles": list(self._isolation.obstacles()),
            }
        except NetworkError as error:
            found = {"translations": [], "obstacles": [f"cannot read the host's other rules: {error}"]}
        if found != self._others:
            self._others = found
            if found["translations"]:
                log.info(
                    "other rules translate addresses on this host; the appliance sees the translated addresses",
                    chains=found["translations"],
                )
            for obstacle in found["obstacles"]:
                log.warning("connections from the network may fail to reach the appliance", reason=obstacle)
        return found


def isolation_for(
    isolation: str,
    ports: AppliancePorts,
    backend: Literal["auto", "iptables", "nft"],
    work: MachineWork | None = None,
) -> NoIsolation:
    if isolation == "container":
        return ContainerIsolation(ports, backend)
    return NetnsIsolation(ports, backend, work=work) if isolation == "netns" else NoIsolation()


def _require_own_network() -> None:
    if reason := shared_network():
        raise StartError(reason)
    if lives_on_the_machines_network():
        log.warning(
            "isolation container, and no container: the firewall is this machine's. That is right where it is the "
            "appliance's alone (a virtual machine); else use --isolation netns"
        )
