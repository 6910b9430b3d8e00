import socket
import subprocess
import sys
import threading
import time

import pytest

from appliance.network.firewall.firewall import BackendChoice, Firewall
from appliance.network.firewall.firewall_rules import FirewallSettings, PortRange
from examples.landshark.lab import Host
from tests.support.forged_syns import flood_command
from tests.support.requirements import need_program
from tests.support.translators import load
from tests.system.network.test_protect import close

BACKENDS: tuple[BackendChoice, ...] = ("nft", "iptables")
PER_SECOND, SECONDS = 3000, 3.0
_SILENT = """table inet own {
    chain input {
        type filter hook input priority 0; policy accept;
        tcp flags & (syn | ack) == (syn | ack) ct state != established drop
    }
}
"""
MASTER, NODE, REST = 11311, 20000, 8443


@pytest.fixture(autouse=True)
def _machine() -> None:
    need_program("iptables-legacy", "iptables")


def calls_during(flood: "subprocess.Popen[str]", robot: Host, server: socket.socket) -> list[bool]:
    """Return, for each call, whether the flood delayed it: it was slow and has sent a packet again."""
    address, pause = server.getsockname()[:2], threading.Event()
    delayed = []
    while flood.poll() is None:
        begun = time.monotonic()
        with robot.entered(), socket.create_connection(address, timeout=10) as client:
            client.sendall(b"?")
            with accepted(server, client.getsockname()[1]) as peer:
                assert peer.recv(1) == b"?"
                peer.sendall(b"!")
            assert client.recv(1) == b"!"
            delayed.append(time.monotonic() - begun >= 0.5 and repeated_packets(client) > 0)
        pause.wait(0.003)  # a robot's pace: some hundred calls a second, which is below the limit of a host
    return delayed


def repeated_packets(connection: socket.socket) -> int:
    """Return `tcpi_total_retrans` of `struct tcp_info` (linux/tcp.h)."""
    return int.from_bytes(
        connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 104)[100:], sys.byteorder
    )


def accepted(server: socket.socket, port: int) -> socket.socket:
    """Accept the connection from this port. A repeated SYN cookie makes another connection, which is closed."""
    for _ in range(100):
        peer, (_, seen, *_) = server.accept()
        if seen == port:
            peer.settimeout(10)
            return peer
        peer.close()
    raise AssertionError("a hundred connections came from other hosts")


def unharmed(robot: Host, attacker: Host, protected: Host, ports: tuple[int, ...], backlog: int) -> None:
    """Flood each port under the robot's address, on both families, and check that the robot is answered at once.

    If the robot then happens to use the port of a forged half-open connection, its call is delayed by a second. Up to
    a hundredth of the calls may be delayed in this way.
    """
    for target, named in ((protected.address, robot.address), (protected.address6, robot.address6)):
        for port in ports:
            family = socket.AF_INET6 if ":" in target else socket.AF_INET
            command = flood_command(named, target, port, per_second=PER_SECOND, seconds=SECONDS)
            with protected.entered():
                server = socket.create_server((target, port), family=family, backlog=backlog)
            with server, attacker.popen(command, stdout=subprocess.PIPE, text=True) as flood:
                server.settimeout(10)
                delayed = calls_during(flood, robot, server)
                sent = int(flood.communicate(timeout=30)[0])
            assert sent > PER_SECOND * SECONDS / 2, "there was no flood"
            assert len(delayed) > 30
            assert sum(delayed) <= 1 + len(delayed) // 100, (
                f"{target} port {port}: {sum(delayed)} of {len(delayed)}"
            )


@pytest.fixture(params=[False, True], ids=["resets", "silent"])
def silent(request: pytest.FixtureRequest, robot: Host) -> bool:
    """Let the robot's own firewall drop unexpected answers, so that forged connections stay half-open."""
    if request.param:
        load(robot.namespace, "nft", _SILENT)
    return bool(request.param)


@pytest.mark.usefixtures("silent")
@pytest.mark.parametrize("backend", BACKENDS)
def test_the_named_host_is_served(
    protected: Host, robot: Host, attacker: Host, backend: BackendChoice
) -> None:
    Firewall(protected.namespace, backend).install(
        FirewallSettings(
            control_uid=61011,
            rosmaster_uid=61012,
            master_port=MASTER,
            node_ports=PortRange(NODE, NODE + 9),
            api_port=REST,
            api_networks=("10.77.0.0/24", "fd77::/64"),
        )
    )
    unharmed(robot, attacker, protected, (MASTER, NODE, REST), backlog=128)


@pytest.mark.usefixtures("silent")
def test_the_appliance_reaches_protected_ports(protected: Host, robot: Host, attacker: Host) -> None:
    close(protected, robot)
    unharmed(robot, attacker, protected, (40007,), backlog=5)
