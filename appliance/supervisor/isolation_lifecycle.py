"""What surrounds the processes: the namespace they live in, the firewall around ROSMaster, the probe of it.

Built before the first process starts and taken away after the last one ended. All calls block for as
long as the kernel takes (tens of milliseconds; the probe up to some seconds), so a running supervisor
makes them in a thread, one at a time.

Invariants:

1. No process starts before the firewall is in force.
2. A port that another local user can reach, or a probe that cannot be made, counts as open: `probe` says why.
3. Rules that somebody took away are put back, and that is said; so are those that could not be put in force before.
4. What `remove` took away stays away: it waits for a call that is under way, and none puts anything back after it.
"""

import contextlib
import ipaddress
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import msgspec
import structlog

from appliance.channel.answers.status import FirewallState
from appliance.channel.rosout_address import ADDRESS as OWN_NODE_ADDRESS
from appliance.ipsec.leftovers import LeftoversError, clear_leftovers
from appliance.ipsec.strongswan import USER_SPACE_INTERFACE
from appliance.network import interfaces
from appliance.network.close_ports import local_port_range
from appliance.network.esp import Esp, choose_esp, lend_tun
from appliance.network.firewall.firewall import Firewall
from appliance.network.firewall.firewall_rules import FirewallSettings, Forwarder, OwnNode, PortRange
from appliance.network.host_namespace import bridges, is_contained, lives_on_the_machines_network
from appliance.network.isolation import Isolation, IsolationSettings
from appliance.network.namespaces import Namespace, NetworkError
from appliance.network.probe import probe_port
from appliance.network.public_address import Endpoint, only_address
from appliance.supervisor.errors import StartError
from appliance.supervisor.users import account_of

_TUNNELS = "rosrv-ipsec"  # the user of charon
_PATIENCE_SECONDS = 5.0  # of an end with a call that hangs

log = structlog.get_logger()


@dataclass(frozen=True)
class Ports:
    """The ports that the surroundings are about; `inner` and `own` are known when control is ready."""

    master: int
    rosmaster: int
    nodes: range
    own_node: range  # where the appliance's own node serves messages
    inner: int | None = None
    api: int | None = None  # None: there is no REST
    api_networks: tuple[str, ...] = ()  # who may connect to it besides this machine
    own: int | None = None  # control's, for the own node
    syslog: tuple[str, str, int] | None = None  # protocol, address and port of the audit log's receiver


class Enclosure:
    """No isolation: the processes live where the supervisor lives, open to everybody there."""

    kind = "none"
    probes = False

    @contextlib.contextmanager
    def inside(self) -> Iterator[None]:
        """Be where the processes live, for the length of a block that does not await."""
        yield

    def build(self) -> None:
        """Make it. Raises `StartError`; nothing is left behind then."""

    def remove(self) -> None:
        """Take it away."""

    def control_ready(self, inner_port: int, own_port: int) -> None:
        """Control's inner face, and the master for the appliance's own nodes, are at these ports now.

        Raises `NetworkError` when others cannot be kept out.
        """

    def open_tunnels(self, pool: str, address: str) -> Esp:  # noqa: ARG002  the same everywhere
        """Take addresses of `pool` through IPsec only from now on, and have `address`; where ESP runs.

        Raises `NetworkError` when clear text cannot be kept out, or ESP can run nowhere.
        """
        raise NetworkError(
            f"isolation {self.kind} has no firewall that would keep tunnelled addresses from being forged:"
            " use isolation netns or container"
        )

    def route_to(self, host: str) -> str | None:  # noqa: ARG002  the same everywhere
        """The machine's address by which `host` reaches the appliance; None: the one it used."""
        return None

    def endpoint(self) -> Endpoint:
        """Where hosts of other networks reach the appliance. Raises `NetworkError` when that cannot be told."""
        raise NetworkError(f"isolation {self.kind} has no tunnels: use isolation netns or container")

    def report(self) -> FirewallState:
        """How it stands, for `rosrv status`."""
        return FirewallState()

    def probe(self) -> str | None:
        """None when no other user can reach what must be hidden, else what was seen."""
        return None


class Contained(Enclosure):
    """The namespace the supervisor was started in (a container's), with the firewall in force."""

    kind = "container"
    probes = True

    def __init__(
        self, ports: Ports, backend: Literal["auto", "iptables", "nft"], namespace: Namespace | None = None
    ) -> None:
        self._ports = ports
        self._namespace = namespace or Namespace.own()
        self._backend = backend
        self.firewall: Firewall | None = None
        self._tunnels: tuple[str, Esp] | None = None  # the pool of their addresses
        self._own: str | None = None  # the appliance's address in the tunnels
        self._owed = False  # rules that are not in force yet, for the kernel refused them
        self._changing = threading.RLock()
        self._ending = False

    @contextlib.contextmanager
    def _standing(self) -> Iterator[None]:
        """Have the rules to oneself. Raises `NetworkError` once they are taken away."""
        with self._changing:
            self._require_standing()
            yield

    def _require_standing(self) -> None:
        if self._ending:
            raise NetworkError("the firewall is taken away: the appliance ends")

    @contextlib.contextmanager
    def _taking_away(self) -> Iterator[None]:
        """Have the rules to oneself for the last time; a call that hangs is not waited for without end."""
        self._ending = True
        held = self._changing.acquire(timeout=_PATIENCE_SECONDS)
        if not held:
            log.error("a look at the firewall hangs; it is taken away all the same")
        try:
            yield
        finally:
            if held:
                self._changing.release()

    def build(self) -> None:
        """Install the firewall. Raises `StartError`."""
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
                "no SYN cookies: first packets under forged addresses can keep every host out",
                remedy="sysctl -w net.ipv4.tcp_syncookies=1",
            )

    def remove(self) -> None:
        """Take every rule away again, and the address that the tunnels end at."""
        if self.firewall is None:
            return
        with self._taking_away():
            try:
                if self._own is not None:
                    self._end_tunnels(self._own)
                self.firewall.remove()
            except NetworkError as error:
                log.error("rules of the firewall may be left", error=str(error))

    def _end_tunnels(self, own: str) -> None:
        """Take away their address, and what a charon that was killed has left in the kernel."""
        try:
            self._namespace.run(lambda: clear_leftovers(own.partition("/")[0]))
            interfaces.delete_address(self._namespace, "lo", own)
        except (NetworkError, LeftoversError) as error:
            log.error("something of the tunnels may be left", error=str(error))

    def control_ready(self, inner_port: int, own_port: int) -> None:
        """Close them to everybody but rosmaster's user, and rosout's."""
        with self._standing():
            if self.firewall is not None and (inner_port, own_port) != (self._ports.inner, self._ports.own):
                self._ports = replace(self._ports, inner=inner_port, own=own_port)
                self._owed = True
                self.firewall.update(self._settings())
                self._owed = False

    def open_tunnels(self, pool: str, address: str) -> Esp:
        """Close the pool to clear text first; only then it has a way in."""
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

    def endpoint(self) -> Endpoint:
        """The only address here, if there is but one: of several, the right one is known outside only."""
        found = only_address(self._namespace, without=("lo", USER_SPACE_INTERFACE))
        if is_contained() and not lives_on_the_machines_network():
            reason = f"{found.reason}, in a container: from outside its machine it may be another"
            return replace(found, reason=reason)
        return found

    def report(self) -> FirewallState:
        """Back end, rules with counters; rules that are gone are put back first."""
        with self._standing():
            if self.firewall is None:
                return FirewallState()
            report = self.firewall.report()
            if self._owed or not report.intact:
                gone = [rule.purpose for rule in report.rules if not rule.in_force]
                self._require_standing()
                log.critical("rules of the firewall are not in force and are put back", rules=gone)
                self.firewall.install(self._settings())
                self._owed = False
                report = self.firewall.report()
        return FirewallState(report.backend, list(report.not_used), list(report.rules))

    def probe(self) -> str | None:
        """Try to reach ROSMaster and the inner face as another local user."""
        ports = {
            "ROSMaster": self._ports.rosmaster,
            "the inner node face": self._ports.inner,
            "the own nodes' master": self._ports.own,
        }
        found = (self._probe(what, port) for what, port in ports.items() if port is not None)
        return "; ".join(filter(None, found)) or None

    def _probe(self, what: str, port: int) -> str | None:
        try:
            seen = probe_port(self._namespace, port)
        except NetworkError as error:
            return f"whether {what} is hidden cannot be told: {error}"
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
            own_node=OwnNode(
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
            forwarder=self._forwarder(),
            tunnel_interface=USER_SPACE_INTERFACE
            if self._tunnels and self._tunnels[1] == "user space"
            else None,
        )

    def _api_networks(self) -> tuple[str, ...]:
        """Besides those that were configured, the hosts in tunnels: there they renew their certificates."""
        return (*self._ports.api_networks, *([self._tunnels[0]] if self._tunnels else []))

    def _neighbours(self) -> tuple[str, ...]:
        """Addresses that only the machine itself may bear, where the appliance's side can tell."""
        return ()

    def _forwarder(self) -> Forwarder | None:
        if self._ports.syslog is None:
            return None
        protocol, address, port = self._ports.syslog
        return Forwarder(account_of("rosrv-syslog").uid, address, port, datagrams=protocol == "udp")


class InNamespace(Contained):
    """A namespace of its own on a bare host; RVMaster's port, the nodes' and that of REST are forwarded to it."""

    kind = "netns"

    def __init__(
        self, ports: Ports, backend: Literal["auto", "iptables", "nft"], isolation: Isolation | None = None
    ) -> None:
        super().__init__(ports, backend)
        nodes = PortRange(ports.nodes.start, ports.nodes.stop - 1)
        forwarded = [PortRange.one(ports.master), nodes]
        if ports.api is not None:
            forwarded.append(PortRange.one(ports.api))
        self._isolation = isolation or Isolation(Namespace.own(), IsolationSettings(ports=tuple(forwarded)))
        self._namespace = self._isolation.namespace
        self._others: dict[str, list[str]] = {}  # what was said last

    @contextlib.contextmanager
    def inside(self) -> Iterator[None]:
        """Be in the namespace, with the calling thread."""
        with self._namespace.entered():
            yield

    def open_tunnels(self, pool: str, address: str) -> Esp:
        """As in a container; then IKE and ESP are forwarded to the namespace."""
        with self._standing():
            esp = super().open_tunnels(pool, address)
            self._isolation.forward_tunnels()
            return esp

    def build(self) -> None:
        """Make the namespace, its way to the host's networks, and the firewall. Raises `StartError`."""
        try:
            self._isolation.up()
        except NetworkError as error:
            raise StartError(str(error)) from error
        super().build()

    def remove(self) -> None:
        """Take firewall and namespace away and put the host's settings back."""
        with self._taking_away():
            super().remove()
            try:
                self._isolation.down()
            except NetworkError as error:
                log.error("the namespace may be left; the next start clears it", error=str(error))

    def _api_networks(self) -> tuple[str, ...]:
        # The host's own loopback arrives under the address of its end of the link.
        return (*self._neighbours(), *super()._api_networks())

    def _neighbours(self) -> tuple[str, ...]:
        return tuple(ends.host for ends in self._isolation.ends.values())

    def route_to(self, host: str) -> str | None:
        """The host's address by which the peer reaches it; a peer in a tunnel reaches the appliance itself."""
        # Control says what it was told; only an address goes on from here.
        address = ipaddress.ip_address(host)
        if self._tunnels is not None and address in ipaddress.ip_network(self._tunnels[0]):
            return None
        return self._isolation.host_address_for(host)

    def endpoint(self) -> Endpoint:
        """The machine's address towards its default route, else its only one."""
        return self._isolation.endpoint()

    def report(self) -> FirewallState:
        """As in a container, and the rules on the host; those that are gone are put back, too."""
        with self._standing():
            rules = self._isolation.rules()
            gone = [rule.purpose for rule in rules if not rule.in_force]
            if gone:
                self._require_standing()
                log.critical("rules on the host were taken away and are put back", rules=gone)
                self._isolation.put_rules_back()
                rules = self._isolation.rules()
            return msgspec.structs.replace(super().report(), forwarding=list(rules), **self._look_at_others())

    def _look_at_others(self) -> dict[str, list[str]]:
        """What programs such as Docker do to forwarded packets on the host; it is said when it changes."""
        try:
            found = {
                "translations": list(self._isolation.translations()),
                "obstacles": list(self._isolation.obstacles()),
            }
        except NetworkError as error:
            found = {"translations": [], "obstacles": [f"the host's other rules cannot be read: {error}"]}
        if found != self._others:
            self._others = found
            if found["translations"]:
                log.info(
                    "others translate addresses on this host; the appliance sees their hosts as they are",
                    chains=found["translations"],
                )
            for obstacle in found["obstacles"]:
                log.warning("connections from the network may not reach the appliance", reason=obstacle)
        return found


def enclosure_of(isolation: str, ports: Ports, backend: Literal["auto", "iptables", "nft"]) -> Enclosure:
    """The surroundings that a configuration asks for; nothing is built yet."""
    if isolation == "container":
        return Contained(ports, backend)
    return InNamespace(ports, backend) if isolation == "netns" else Enclosure()


def _require_own_network() -> None:
    """Raise `StartError` in a container that shares the machine's network: the firewall would be the machine's."""
    shared = lives_on_the_machines_network()
    if is_contained() and (shared or bridges()):
        raise StartError(
            "isolation container: this container shares the machine's network (network_mode: host, hostNetwork), so "
            "the firewall would be everybody's there. Give it a network of its own, as compose.host.yaml does for a "
            "robot whose nodes run on the machine itself; or run rosrv without a container, with isolation netns"
        )
    if shared:
        log.warning(
            "isolation container, and no container: the firewall is this machine's. That is right where it is the "
            "appliance's alone (a virtual machine); else use --isolation netns"
        )
