import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from appliance.base import clock
from appliance.network import interfaces
from appliance.network.firewall.firewall_rules import PortRange
from appliance.network.isolation import INSIDE, Isolation, IsolationSettings
from appliance.network.listening_sockets import listening_ports
from appliance.network.namespaces import Namespace, NetworkError
from appliance.network.port_holders import PortsInUseError
from examples.landshark.lab import Host, Lab
from tests.support.processes import runs
from tests.support.virtual_clock import VirtualClock

MASTER, FIRST, LAST = 11311, 20000, 20009


@pytest.fixture
def bare(lab: Lab) -> Host:
    return lab.host("bare", "10.77.0.2/24", "fd77::2/64")


@pytest.fixture
def node(lab: Lab) -> Host:
    return lab.host("node", "10.77.0.30/24", "fd77::30/64")


def settings(tmp_path: Path, name: str | None = None) -> IsolationSettings:
    return IsolationSettings(
        ports=(PortRange.one(MASTER), PortRange(FIRST, LAST)),
        name=name or f"riso{os.getpid()}",
        directory=tmp_path,
    )


@contextlib.contextmanager
def isolated(bare: Host, tmp_path: Path) -> Iterator[Isolation]:
    isolation = Isolation(bare.namespace, settings(tmp_path))
    isolation.up()
    try:
        yield isolation
    finally:
        isolation.down()


@contextlib.contextmanager
def serving(namespace: Namespace, port: int) -> Iterator[socket.socket]:
    with namespace.inside():
        server = socket.create_server(("::", port), family=socket.AF_INET6, dualstack_ipv6=True)
    server.settimeout(10)
    with server:
        yield server


def beside(function: Callable[[], Any], main_in: Namespace) -> Any:
    """Return what a thread finds that began before the main thread entered a namespace."""
    found: list[Any] = []
    entered = threading.Event()

    def work() -> None:
        entered.wait(10)
        found.append(function())

    thread = threading.Thread(target=work)
    thread.start()
    with main_in.inside():
        entered.set()
        thread.join()
    return found[0]


def source_seen(server: socket.socket, host: Host, address: str, port: int) -> str:
    with host.entered(), socket.create_connection((address, port), timeout=10) as client:
        peer, (seen, *_) = server.accept()
        with peer:
            peer.sendall(b"!")
            assert client.recv(1) == b"!"
    return str(seen).removeprefix("::ffff:")


def state(host: Host) -> tuple[str, ...]:
    process = host.popen(["nft", "-s", "list", "ruleset"], stdout=subprocess.PIPE, text=True)
    rules, _ = process.communicate(timeout=30)
    keys = ["net/ipv4/ip_forward", "net/ipv6/conf/all/forwarding"]
    for name in ("eth0", "lo", "default"):
        keys += [f"net/ipv4/conf/{name}/forwarding", f"net/ipv6/conf/{name}/forwarding"]
        keys += [f"net/ipv6/conf/{name}/accept_ra", f"net/ipv4/conf/{name}/route_localnet"]
    return (
        rules,
        *(f"{key}={host.namespace.sysctl(key)}" for key in keys),
        *interfaces.links(host.namespace),
        *(text for text in interfaces.networks(host.namespace) if "." in text),
    )


def test_source_addresses_are_preserved_in_the_namespace(bare: Host, node: Host, tmp_path: Path) -> None:
    with isolated(bare, tmp_path) as isolation, serving(isolation.namespace, MASTER) as server:
        assert source_seen(server, node, bare.address, MASTER) == node.address
        assert source_seen(server, node, bare.address6, MASTER) == node.address6
        assert isolation.host_address_for(node.address) == bare.address
        assert isolation.host_address_for(node.address6) == bare.address6
        with serving(isolation.namespace, LAST) as last:
            assert source_seen(last, node, bare.address, LAST) == node.address
        assert all(rule.in_force for rule in isolation.rules())
        assert bare.popen(["nft", "flush", "ruleset"]).wait(timeout=20) == 0
        assert not any(rule.in_force for rule in isolation.rules())
        isolation.put_rules_back()
        assert source_seen(server, node, bare.address, MASTER) == node.address


def test_threads_work_on_the_host_while_the_main_thread_starts_a_process(bare: Host, tmp_path: Path) -> None:
    with bare.entered():
        own = Namespace.own()
        isolation = Isolation(own, replace(settings(tmp_path), master=MASTER + 1))
        isolation.up()
    link = ["readlink", "/proc/self/ns/net"]
    uses: dict[str, Callable[[], Any]] = {
        "run": lambda: own.run(lambda: Path("/proc/thread-self/ns/net").readlink()),
        "popen": lambda: own.popen(link, stdout=subprocess.PIPE).communicate()[0],
        "sysctl": lambda: own.sysctl(f"net/ipv4/conf/{isolation.settings.link}/route_localnet"),
        "processes": own.processes,
        "interfaces": lambda: interfaces.links(own),
        "machine_addresses": isolation.machine_addresses,
        "host_address_for": lambda: isolation.host_address_for("10.77.0.30"),
        "obstacles": isolation.obstacles,
        "translations": isolation.translations,
        "forward_master": isolation.forward_master,
        "put_rules_back": isolation.put_rules_back,
        "rules": lambda: {rule.purpose for rule in isolation.rules() if rule.in_force},
        "end_connections": isolation.end_connections,
    }
    try:
        with bare.entered(), serving(isolation.namespace, MASTER + 1):
            assert own == Namespace.own()
            expected = {name: use() for name, use in uses.items()}
            found = {name: beside(use, isolation.namespace) for name, use in uses.items()}
            assert found == expected
            with isolation.namespace.inside():
                assert own != Namespace.own()
                assert {name: use() for name, use in uses.items()} == expected
    finally:
        isolation.down()


@pytest.mark.parametrize("scope", ["default", "all"])
def test_a_machine_that_disables_ipv6_gets_an_appliance(
    scope: str, bare: Host, node: Host, tmp_path: Path
) -> None:
    bare.namespace.sysctl(f"net/ipv6/conf/{scope}/disable_ipv6", "1")
    with isolated(bare, tmp_path) as isolation, serving(isolation.namespace, MASTER) as server:
        assert source_seen(server, node, bare.address, MASTER) == node.address
        assert [*isolation.ends] == ([4] if scope == "all" else [4, 6])


def test_a_namespace_stays_in_use_without_its_name(bare: Host, tmp_path: Path) -> None:
    with isolated(bare, tmp_path) as isolation:
        subprocess.run(["ip", "netns", "delete", isolation.namespace.name], check=True)
        assert not isolation.namespace.exists()
        assert INSIDE in interfaces.links(isolation.namespace)
        with serving(isolation.namespace, MASTER) as server:
            assert source_seen(server, bare, bare.address, MASTER) == bare.address
    with pytest.raises(NetworkError, match="does not exist"):
        isolation.namespace.open()


def test_the_master_is_forwarded_only_when_it_answers_and_no_other_listens(
    bare: Host, node: Host, tmp_path: Path
) -> None:
    late = replace(settings(tmp_path), ports=(PortRange(FIRST, LAST),), master=MASTER)
    isolation = Isolation(bare.namespace, late)
    with (
        serving(bare.namespace, MASTER),
        pytest.raises(PortsInUseError, match=rf"pytest.* holds TCP {MASTER}; `sudo rosrv adopt`"),
    ):
        isolation.up()
    isolation.up()
    try:
        with serving(isolation.namespace, MASTER) as server:
            with node.entered(), pytest.raises(ConnectionRefusedError):
                socket.create_connection((bare.address, MASTER), timeout=10)
            with serving(bare.namespace, MASTER), pytest.raises(PortsInUseError):
                isolation.forward_master()
            isolation.forward_master()
            assert source_seen(server, node, bare.address, MASTER) == node.address
            isolation.forward_also((PortRange.one(LAST + 1),))
            assert source_seen(server, node, bare.address, MASTER) == node.address
    finally:
        isolation.down()


@pytest.mark.parametrize("wildcard", ["0.0.0.0", "::"])
def test_a_continuous_tunnel_follows_the_rules(bare: Host, node: Host, tmp_path: Path, wildcard: str) -> None:
    """When the appliance starts or stops, it lets the connection tracker forget the destination of UDP packets."""
    family = socket.AF_INET6 if ":" in wildcard else socket.AF_INET
    target = (bare.address6 if ":" in wildcard else bare.address, 4500)
    # a NAT rule such as a container engine's: the connection tracker then remembers every conversation
    rules = (
        "add table inet other; add chain inet other in { type nat hook prerouting priority -90; };"
        " add rule inet other in udp dport 9 redirect to :10"
    )
    assert bare.popen(["nft", rules]).wait(timeout=20) == 0
    with bare.entered():
        own = socket.socket(family, socket.SOCK_DGRAM)
        own.bind((wildcard, 4500))
    with node.entered():
        tunnel = socket.socket(family, socket.SOCK_DGRAM)
    with own, tunnel:
        own.settimeout(10)
        tunnel.sendto(b"before", target)
        assert own.recv(9) == b"before"
        own.close()  # as when the host's strongSwan is stopped
        with isolated(bare, tmp_path) as isolation:
            isolation.forward_tunnels()
            with isolation.namespace.inside():
                charon = socket.socket(family, socket.SOCK_DGRAM)
            with charon:
                charon.bind((wildcard, 4500))
                charon.settimeout(10)
                tunnel.sendto(b"during", target)
                assert charon.recv(9) == b"during"
        with bare.entered():
            again = socket.socket(family, socket.SOCK_DGRAM)
        with again:
            again.bind((wildcard, 4500))
            again.settimeout(10)
            tunnel.sendto(b"after", target)
            assert again.recv(9) == b"after"


def test_the_appliance_reaches_nodes(bare: Host, node: Host, tmp_path: Path) -> None:
    with isolated(bare, tmp_path) as isolation, serving(bare.namespace, 34567) as local:
        inside = Host("inside", isolation.namespace, "", (isolation.ends[4].appliance + "/30",))
        assert source_seen(local, inside, bare.address, 34567) == isolation.ends[4].appliance
        assert source_seen(local, inside, bare.address6, 34567) == isolation.ends[6].appliance
        with serving(node.namespace, 34568) as remote:
            assert source_seen(remote, inside, node.address, 34568) == bare.address
            assert source_seen(remote, inside, node.address6, 34568) == bare.address6


def test_obstacles_that_appear_later_are_named(lab: Lab, bare: Host, node: Host, tmp_path: Path) -> None:
    """Obstacles: a listener in the forwarded ports, a program that routes, and a program that ends forwarding."""
    far = lab.host("far", "10.99.0.1/24", gateway="10.99.0.2")
    interfaces.add_address(bare.namespace, "eth0", "10.99.0.2/24")
    with isolated(bare, tmp_path) as isolation:
        assert (isolation.obstacles(), isolation.forward_again()) == ((), ())
        with serving(bare.namespace, LAST):
            assert f"holds TCP {LAST}, which leads to the appliance" in isolation.obstacles()[0]
        interfaces.add_route(node.namespace, "10.99.0.0/24", bare.address)
        with node.entered(), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
            one.sendto(b"?", (far.address, 9))
        assert "`net.ipv4.ip_forward = 1` into /etc/sysctl.d" in isolation.obstacles()[0]
        with clock.using(VirtualClock(now=clock.now() + 3600)):
            assert isolation.obstacles() == ()
        bare.namespace.sysctl("net.ipv4.ip_forward", "0")
        assert isolation.forward_again() == (4,)
        with serving(isolation.namespace, MASTER) as server:
            assert source_seen(server, node, bare.address, MASTER) == node.address


def test_the_hosts_own_processes_reach_the_appliance(bare: Host, tmp_path: Path) -> None:
    with isolated(bare, tmp_path) as isolation, serving(isolation.namespace, MASTER) as server:
        assert source_seen(server, bare, bare.address, MASTER) == bare.address
        assert source_seen(server, bare, bare.address6, MASTER) == bare.address6
        assert source_seen(server, bare, "127.0.0.1", MASTER) == isolation.ends[4].host
        with bare.entered(), pytest.raises(ConnectionRefusedError):  # at once, so that clients try 127.0.0.1
            socket.create_connection(("::1", MASTER), timeout=10)
        assert isolation.host_address_for(bare.address) == bare.address
        assert source_seen(server, bare, isolation.ends[4].appliance, MASTER) == isolation.ends[4].host


def test_the_host_forwards_nothing_else(lab: Lab, bare: Host, node: Host, tmp_path: Path) -> None:
    far = lab.host("far", "10.99.0.1/24", gateway="10.99.0.2")
    interfaces.add_address(bare.namespace, "eth0", "10.99.0.2/24")
    with isolated(bare, tmp_path) as isolation:
        appliance = isolation.ends[4].appliance
        interfaces.add_route(node.namespace, f"{appliance}/32", bare.address)
        interfaces.add_route(node.namespace, "10.99.0.0/24", bare.address)
        with (
            serving(isolation.namespace, 9999),
            serving(isolation.namespace, MASTER),
            serving(far.namespace, 9999),
        ):
            for target in ((appliance, 9999), (appliance, MASTER), (far.address, 9999)):
                with node.entered(), pytest.raises(TimeoutError):
                    socket.create_connection(target, timeout=1)


def test_the_appliance_does_not_reach_the_hosts_loopback(bare: Host, tmp_path: Path) -> None:
    with isolated(bare, tmp_path) as isolation, serving(bare.namespace, 34567):
        inside = isolation.namespace
        inside.sysctl("net.ipv4.conf.eth0.route_localnet", "1")
        ends = isolation.ends[4]
        for command in (
            "ip route del table local 127.0.0.1 dev lo",
            "ip route del table local 127.0.0.0/8 dev lo",
            f"ip route add 127.0.0.1 via {ends.host} dev eth0 src {ends.appliance}",
        ):
            assert inside.popen(command.split()).wait(timeout=20) == 0
        with inside.inside(), pytest.raises(TimeoutError):
            socket.create_connection(("127.0.0.1", 34567), timeout=1)
        dropped = next(
            rule for rule in isolation.rules() if "loopback" in rule.purpose and rule.chain == "ROSRV-IN"
        )
        assert dropped.packets > 0


def test_the_end_restores_everything(bare: Host, tmp_path: Path) -> None:
    bare.popen(["nft", "add", "table", "inet", "foreign"]).wait(timeout=20)
    bare.namespace.sysctl("net/ipv4/conf/eth0/forwarding", "1")
    before = state(bare)
    with isolated(bare, tmp_path) as isolation:
        name = isolation.namespace
        assert bare.namespace.sysctl("net.ipv4.ip_forward") == "1"
        assert bare.namespace.sysctl("net.ipv6.conf.eth0.accept_ra") == "2"
        assert state(bare) != before
    assert state(bare) == before
    assert not name.exists()
    isolation.down()


def test_a_router_stays_a_router(lab: Lab, bare: Host, node: Host, tmp_path: Path) -> None:
    far = lab.host("far", "10.99.0.1/24", gateway="10.99.0.2")
    interfaces.add_address(bare.namespace, "eth0", "10.99.0.2/24")
    interfaces.add_route(node.namespace, "10.99.0.0/24", bare.address)
    bare.namespace.sysctl("net.ipv4.ip_forward", "1")
    with serving(far.namespace, 9999) as server:
        with isolated(bare, tmp_path):
            assert source_seen(server, node, far.address, 9999) == node.address
        assert source_seen(server, node, far.address, 9999) == node.address


CRASHER = """
import signal, sys
from pathlib import Path
from appliance.network.firewall.firewall_rules import PortRange
from appliance.network.isolation import INSIDE, Isolation, IsolationSettings
from appliance.network.namespaces import Namespace
isolation = Isolation(Namespace(sys.argv[1]), IsolationSettings(
    ports=(PortRange(11311, 11311), PortRange(20000, 20009)), name=sys.argv[2], directory=Path(sys.argv[3])))
isolation.up()
print(isolation.namespace.popen(["sleep", "600"]).pid, flush=True)
signal.pause()
"""


def test_a_crash_leaves_one_set_after_the_next_start(bare: Host, node: Host, tmp_path: Path) -> None:
    before = state(bare)
    wanted = settings(tmp_path)
    crashed = subprocess.Popen(
        [sys.executable, "-c", CRASHER, bare.namespace.name, wanted.name, str(tmp_path)],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert crashed.stdout is not None
    with crashed.stdout:
        orphan = int(crashed.stdout.readline())
        with pytest.raises(NetworkError, match=f"another appliance .*namespace {wanted.name}"):
            Isolation(bare.namespace, replace(wanted, name="second")).up()
        crashed.send_signal(signal.SIGKILL)
        crashed.wait(timeout=20)
    during = state(bare)
    assert during != before
    with isolated(bare, tmp_path) as isolation, serving(isolation.namespace, MASTER) as server:
        assert source_seen(server, node, bare.address, MASTER) == node.address
        assert state(bare)[0] == during[0], "one set of rules"
        assert not runs(orphan)
    assert state(bare) == before


def test_the_subnet_conflicts_with_no_route(bare: Host, tmp_path: Path) -> None:
    interfaces.add_address(bare.namespace, "eth0", "10.111.0.9/26")
    with isolated(bare, tmp_path) as isolation:
        assert isolation.ends[4].network == "10.111.0.64/30"


def test_a_foreign_namespace_or_interface_is_not_taken(bare: Host, tmp_path: Path) -> None:
    wanted = settings(tmp_path)
    foreign = Namespace(wanted.name).create()
    try:
        with pytest.raises(NetworkError, match=rf"ip netns delete {wanted.name}"):
            Isolation(bare.namespace, wanted).up()
        assert foreign.exists()
    finally:
        foreign.delete()
    interfaces.create_bridge(bare.namespace, wanted.link)
    before = state(bare)
    with pytest.raises(NetworkError, match=f"interface {wanted.link}"):
        Isolation(bare.namespace, wanted).up()
    assert state(bare) == before


def test_a_port_in_use_on_the_host_is_named(bare: Host, tmp_path: Path) -> None:
    before = state(bare)
    with (
        serving(bare.namespace, MASTER),
        pytest.raises(NetworkError, match=r"pytest.* holds TCP 11311; stop it"),
    ):
        Isolation(bare.namespace, settings(tmp_path)).up()
    assert state(bare) == before
    assert bare.run(listening_ports) == set()


def test_a_chain_that_would_drop_forwarded_packets_is_named(bare: Host, tmp_path: Path) -> None:
    with isolated(bare, tmp_path) as isolation:
        assert isolation.obstacles() == ()
        run_in = ["nft", "add table ip engine; add chain ip engine FORWARD"]
        run_in[1] += " { type filter hook forward priority 0; policy drop; }"
        assert bare.popen(run_in).wait(timeout=20) == 0
        (obstacle,) = isolation.obstacles()
        assert "chain ip engine FORWARD" in obstacle
        assert isolation.settings.link in obstacle


def test_a_host_behind_a_router_reaches_the_appliance_unless_an_obstacle_is_named(
    lab: Lab, bare: Host, node: Host, tmp_path: Path
) -> None:
    """A plain server is reached by each: its answers have the host's address, for which `ip rule` has a table."""
    router = lab.host("router", "10.77.0.1/24", "10.78.0.1/24")
    far = lab.host("far", "10.78.0.5/24", gateway="10.78.0.1")
    router.namespace.sysctl("net.ipv4.ip_forward", "1")
    interfaces.add_route(bare.namespace, "10.78.0.0/24", "10.77.0.1")

    def reaches(host: Host) -> bool:
        return host.run(lambda: _error("10.77.0.2")) is None

    def ip(*words: str) -> None:
        assert bare.popen(["ip", *words]).wait(timeout=20) == 0

    with isolated(bare, tmp_path) as isolation, serving(isolation.namespace, MASTER):
        assert (reaches(node), reaches(far), isolation.obstacles()) == (True, True, ())
        ip("route", "replace", "blackhole", "10.78.0.0/24")
        ip("route", "add", "10.78.0.0/24", "via", "10.77.0.1", "dev", "eth0", "table", "100")
        ip("rule", "add", "from", "10.77.0.2", "lookup", "100")
        (obstacle,) = isolation.obstacles()
        assert (reaches(node), reaches(far)) == (True, False)
        remedy = obstacle.split("`")[1]
        assert remedy == f"ip rule add iif {isolation.settings.link} lookup 100"
        ip(*remedy.split()[1:])
        assert (reaches(node), reaches(far), isolation.obstacles()) == (True, True, ())


def test_a_family_without_a_listener_is_refused_whatever_others_drop(
    bare: Host, node: Host, tmp_path: Path
) -> None:
    """rospy tries IPv6 first, without a time limit, and goes on with IPv4 after a refusal."""
    wanted = settings(tmp_path)
    wanted = replace(wanted, refused=tuple((6, ports) for ports in wanted.ports))

    def errors() -> list[type[Exception] | None]:
        return [node.run(partial(_error, address)) for address in (bare.address, bare.address6)]

    isolation = Isolation(bare.namespace, wanted)
    isolation.up()
    try:
        with serving(isolation.namespace, MASTER):
            assert errors() == [None, ConnectionRefusedError]
            run_in = ["nft", "add table ip6 engine; add chain ip6 engine FORWARD"]
            run_in[1] += " { type filter hook forward priority 0; policy drop; }"
            assert bare.popen(run_in).wait(timeout=20) == 0
            assert errors() == [None, ConnectionRefusedError]
    finally:
        isolation.down()


def _error(address: str) -> type[Exception] | None:
    try:
        socket.create_connection((address, MASTER), timeout=1).close()
    except OSError as error:
        return type(error)
    return None


def test_an_unreadable_record_is_named(bare: Host, tmp_path: Path) -> None:
    wanted = settings(tmp_path)
    record = tmp_path / "isolation.json"
    record.write_text(json.dumps({"link": "eth0"}), encoding="utf-8")
    with pytest.raises(NetworkError, match=record.name):
        Isolation(bare.namespace, wanted).up()
