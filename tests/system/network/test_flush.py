"""Remove the firewall's rules while an adopted robot moves, and another machine waits for that moment.

ROSRV_FLUSHES is the number of removals of each kind.
"""

import os
import signal
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest

from appliance.network.close_ports import LocalCallers, protection
from appliance.network.cut import end_connections, run_nft
from appliance.network.firewall.firewall_rules import PortRange
from appliance.network.isolation import Isolation, IsolationSettings
from appliance.network.listening_sockets import TcpSocket, tcp_sockets
from examples.landshark.lab import Host, Lab
from tests.support.adopted_robot import Robot, rosrv, until_taken
from tests.support.appliance import OPEN_POLICY, Appliance
from tests.support.nodes import RosSession, need_ros
from tests.support.processes import Process
from tests.support.requirements import need_program
from tests.support.rosmaster import PlainMaster
from tests.support.waiting import eventually

FLUSHES = int(os.environ.get("ROSRV_FLUSHES", "20"))
TOPIC = "/cmd_vel"
POLICY = f"""\
[Nodes]
default = *
[Publishers]
{TOPIC} = robot
default = *
[Subscribers]
default = *
[Commands]
default = *
"""
IMPOSTOR = Path(__file__).parents[2] / "support" / "impostor.py"
RELOADED = """\
flush ruleset
table inet filter { chain input { type filter hook input priority filter; policy accept; tcp dport 22 accept; }; }
"""
FIREWALLD = """\
table inet firewalld
delete table inet firewalld
table inet firewalld { chain nat_PREROUTING { type nat hook prerouting priority dstnat + 10; policy accept; }; }
"""
RESTORED = (
    "*nat\n:PREROUTING ACCEPT\n:DOCKER -\n-A PREROUTING -j DOCKER\nCOMMIT\n*filter\n:INPUT ACCEPT\nCOMMIT\n"
)
REMOVALS = {
    "nft flush ruleset": (["nft", "flush", "ruleset"], ""),
    "systemctl reload nftables": (["nft", "-f", "-"], RELOADED),
    "nft delete table": (["nft", "delete", "table", "inet", "rosrv"], ""),
    "one rule less": (["nft", "flush", "chain", "inet", "rosrv", "ROSRV-NAT"], ""),
    "firewalld": (["nft", "-f", "-"], FIREWALLD),
    "iptables-restore, Docker, ufw": (["iptables-nft-restore"], RESTORED),
    "iptables-legacy": (["iptables-legacy-restore"], RESTORED),
}

PROGRAM = """
import socket, sys, threading
server = socket.create_server(("0.0.0.0", int(sys.argv[1])))
print("ready", flush=True)
def answer(client):
    while data := client.recv(99):
        client.sendall(data)
while True:
    threading.Thread(target=answer, args=(server.accept()[0],), daemon=True).start()
"""


@pytest.fixture
def isolation(lab: Lab, tmp_path: Path) -> Iterator[Isolation]:
    host = lab.host("robot", "10.77.0.10/24")
    ports = (PortRange.one(11311), PortRange(20000, 20009))
    isolation = Isolation(
        host.namespace, IsolationSettings(ports=ports, name=f"rflu{os.getpid()}", directory=tmp_path)
    )
    isolation.up()
    try:
        yield isolation
    finally:
        isolation.down()


@pytest.mark.nightly
def test_only_what_began_without_the_rules_ends(lab: Lab, isolation: Isolation) -> None:
    """And only of nodes, or of programs on the appliance's ports. A half-open connection also ends."""
    robot, stranger = lab.hosts["robot"], lab.host("stranger", "10.77.0.66/24")
    node, other, listener = 40001, 40002, 20001
    programs = []
    for port, env in ((node, {"ROS_MASTER_URI": "x"}), (other, {}), (listener, {})):
        command = [sys.executable, "-c", PROGRAM, str(port)]
        programs.append(robot.popen(command, env=env, stdout=subprocess.PIPE, text=True))
        output = programs[-1].stdout
        assert output is not None
        assert output.readline() == "ready\n"

    def connect(port: int) -> socket.socket:
        with stranger.entered():
            return socket.create_connection((robot.address, port), timeout=10)

    def lives(client: socket.socket) -> bool:
        try:
            client.sendall(b"?")
            return client.recv(1) == b"?"
        except ConnectionError:
            return False

    try:
        with connect(node) as before:
            assert lives(before)
            isolation.remember_connections()
            isolation.remember_connections()
            assert robot.popen(["nft", "flush", "ruleset"]).wait(timeout=20) == 0
            with connect(node) as late, connect(other) as others, connect(listener) as impostor:
                assert all(map(lives, (late, others, impostor)))
                answers = "tcp flags & (syn | ack) == (syn | ack) drop"
                hook = "type filter hook input priority 0"
                run_nft(
                    stranger.namespace,
                    f"add table ip t; add chain ip t c {{ {hook}; }}; add rule ip t c {answers}",
                )
                with stranger.entered(), socket.socket() as opening:
                    opening.setblocking(False)
                    assert opening.connect_ex((robot.address, node)) != 0
                    eventually(lambda: half_open(robot), "no half-open connection")
                    assert isolation.put_rules_back()
                    assert isolation.end_connections() == 3
                    assert not half_open(robot)
                assert [lives(one) for one in (before, late, others, impostor)] == [True, False, True, False]
    finally:
        for program in programs:
            program.kill()
            program.communicate(timeout=20)


@pytest.mark.real
def test_a_connection_that_ends_first_leaves_its_listener_alone(lab: Lab) -> None:
    """For such a connection the kernel offers the listener, so a hasty caller made the robot's master deaf."""
    robot = lab.host("robot", "10.77.0.10/24")
    with robot.entered(), socket.create_server((robot.address, 0)) as listener:
        port = int(listener.getsockname()[1])
        caller = socket.create_connection((robot.address, port))
        accepted, _ = listener.accept()
        caller.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))

        def ends_first(tcp_socket: TcpSocket) -> bool:
            caller.close()
            accepted.close()
            return tcp_socket.port == port

        assert end_connections(robot.namespace, ends_first) == 0
        socket.create_connection((robot.address, port), timeout=5).close()


def half_open(host: Host) -> list[int]:
    return [one.port for one in host.run(tcp_sockets) if one.half_open]


@pytest.mark.nightly
def test_closed_ports_of_the_machine_come_back_after_a_flush_and_not_after_their_removal(
    lab: Lab, isolation: Isolation
) -> None:
    robot = lab.hosts["robot"]

    def closed() -> bool:
        shown = robot.popen(["nft", "list", "tables"], stdout=subprocess.PIPE, text=True)
        return "rosrv_protect" in shown.communicate(timeout=20)[0]

    strict = LocalCallers(users=("root",))
    run_nft(robot.namespace, protection([robot.address], PortRange(32768, 60999), (), strict=strict))
    assert isolation.put_rules_back() == []
    assert robot.popen(["nft", "flush", "ruleset"]).wait(timeout=20) == 0
    assert "rosrv protect" in isolation.put_rules_back()
    assert closed()
    run_nft(robot.namespace, "delete table inet rosrv_protect")
    assert isolation.put_rules_back() == []
    assert robot.popen(["nft", "flush", "ruleset"]).wait(timeout=20) == 0
    assert isolation.put_rules_back()
    assert not closed()


@pytest.fixture
def robot(lab: Lab, tmp_path: Path) -> Iterator[Robot]:
    need_ros()
    host = lab.host("robot", "10.77.0.10/24")
    with PlainMaster(tmp_path, host), RosSession("http://localhost:11311", tmp_path, host) as ros:
        ros.talker("rospy", TOPIC, "--rate", "50", name="driver")
        bases = {client: ros.listener(client, TOPIC, name=f"{client}_base") for client in ("rospy", "roscpp")}
        yield Robot(host, ros, bases, {})


@pytest.fixture
def appliance(robot: Robot) -> Iterator[Appliance]:
    appliance = Appliance(robot.host, isolation="netns", policy=POLICY)
    try:
        rosrv(robot, appliance, "adopt")
        appliance.start()
        until_taken(robot, appliance)
        yield appliance
    finally:
        appliance.stop()
        appliance.close()


@pytest.fixture
def impostor(lab: Lab, robot: Robot, appliance: Appliance) -> Iterator[Process]:
    host = lab.host("stranger", "10.77.0.66/24")
    command = [sys.executable, str(IMPOSTOR), robot.host.address, "11311", host.address, TOPIC]
    process = Process(host, command, env={}, label="impostor")
    try:
        process.wait_for(event="ready")
        yield process
    finally:
        process.stop()


def has_rules(host: Host) -> bool:
    shown = host.popen(
        ["nft", "list", "chain", "inet", "rosrv", "ROSRV-NAT"],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    return "tcp dport 11311" in shown.communicate(timeout=20)[0]


def remove(host: Host, command: list[str], text: str) -> None:
    done = host.popen(command, stdin=subprocess.PIPE, text=True)
    done.communicate(text, timeout=20)
    assert done.returncode == 0
    eventually(lambda: has_rules(host), "the rules do not come back")


def commanded(base: Process, since: int = 0) -> list[str]:
    heard = [event["data"] for event in base.seen(event="received")[since:]]
    return [text for text in heard if text.startswith("evil")]


@pytest.mark.nightly
@pytest.mark.parametrize("kind", REMOVALS)
def test_no_machine_commands_the_base_after_the_rules_are_back(
    robot: Robot, appliance: Appliance, impostor: Process, kind: str
) -> None:
    command, text = REMOVALS[kind]
    need_program(command[0], "nftables" if command[0] == "nft" else "iptables")
    graph = robot.graph()
    for _ in range(FLUSHES):
        remove(robot.host, command, text)
        back = {name: len(base.seen(event="received")) for name, base in robot.listeners.items()}
        robot.hears()
        assert not any(commanded(base, back[name]) for name, base in robot.listeners.items())
    during = sum(len(commanded(base)) for base in robot.listeners.values())
    ours = kind.startswith(("nft", "systemctl", "one"))
    if ours:
        appliance.recorded(event="firewall restored", count=FLUSHES)
    gaps = [record["detail"]["seconds"] for record in appliance.audit(event="firewall restored")]
    registered = len(impostor.seen(event="registered"))
    print(f"{kind}: {during} commands, {registered} registrations, without rules: {sorted(gaps)}")  # noqa: T201  shown by pytest -s
    if ours:
        assert len(gaps) == FLUSHES
        assert "rules of the firewall" in appliance.rosrv("status", check=False).stdout
    else:
        assert not gaps, "their tables are not the appliance's"
    print(robot.losses())  # noqa: T201  shown by pytest -s
    assert robot.graph() == graph
    impostor.stop()  # from the release on, the robot's own master is open again
    rosrv(robot, appliance, "release")
    assert robot.graph() == graph
    robot.hears()


@pytest.mark.nightly
def test_nothing_that_reached_a_closed_port_without_the_rules_stays_connected(lab: Lab) -> None:
    """In a container: another machine, and another account of this one, also as a door, at each port that is closed."""
    box, stranger = lab.host("box", "10.77.0.2/24"), lab.host("stranger", "10.77.0.66/24")
    door = "198.19.240.2"
    places = ((stranger, box.address, ""), (box, "127.0.0.1", ""), (box, door, ""), (box, box.address, door))

    def reached(host: Host, address: str, own: str, ports: set[int]) -> dict[int, socket.socket]:
        found = {}
        with host.entered():
            for port in ports:
                with suppress(OSError):
                    found[port] = socket.create_connection((address, port), 2, (own, 0) if own else None)
        return found

    with Appliance(box, policy=OPEN_POLICY) as appliance, ExitStack() as running:
        appliance.rosrv("door", "add", "agent", "--port", "9091", "--from", stranger.address)
        eventually(lambda: not appliance.row("door", "list")["trouble"], "the door serves")
        listening = {one.port for one in box.run(tcp_sockets) if one.listens}
        closed = []
        for place in places:
            opened = reached(*place, listening)
            for client in opened.values():
                client.close()
            closed.append(listening - opened.keys())
        assert all(closed)
        (supervisor,), addresses = appliance.pids("supervisor"), set[str]()
        began: dict[int, int] = {}  # the port that was reached, by the client's own
        for number in range(1, FLUSHES + 1):
            os.kill(supervisor, signal.SIGSTOP)  # else the rules are back within milliseconds
            try:
                assert box.popen(["nft", "flush", "ruleset"]).wait(timeout=20) == 0
                for place, ports in zip(places, closed, strict=True):
                    for port, client in reached(*place, ports).items():
                        running.enter_context(client)
                        addresses.add(client.getsockname()[0])
                        began[client.getsockname()[1]] = port
            finally:
                os.kill(supervisor, signal.SIGCONT)
            appliance.recorded(event="firewall restored", count=number)

        def left() -> list[TcpSocket]:
            found = box.run(tcp_sockets)
            return [one for one in found if one.established and began.get(one.peer_port) == one.port]

        print(f"closed: {closed}; {len(began)} connections without the rules")  # noqa: T201  shown by pytest -s
        assert addresses >= {door, "127.0.0.1", stranger.address}
        eventually(lambda: not left(), lambda: str(left()), seconds=10)
