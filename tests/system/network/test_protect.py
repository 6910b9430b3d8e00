import contextlib
import json
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from appliance.network import interfaces
from appliance.network.close_ports import LINK
from examples.landshark.lab import Host, Lab
from tests.support.requirements import need_program
from tests.support.translators import TRANSLATORS, guest_behind, load
from tests.system.network.test_isolation import serving, source_seen

COMMAND = (
    "import sys; from appliance.cli.lazy import load_command; from appliance.cli.main import all_verbs; "
    "sys.argv[0] = 'rosrv'; load_command(all_verbs()['protect'], 'protect')()"
)
FEW = "40000-40099"  # a small range, for a quick scan
INSIDE, KEPT, OUTSIDE = 40007, 40022, 39000


@pytest.fixture
def gateway(lab: Lab) -> Host:
    return lab.host("gateway", "10.77.0.2/24", "fd77::2/64")


def protect(host: Host, *arguments: str, status: int = 0, **environment: str) -> str:
    process = host.popen(
        [sys.executable, "-c", COMMAND, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[3]), **environment},
    )
    out, err = process.communicate(timeout=240)
    assert process.returncode == status, (out, err)
    assert "Traceback" not in err
    return str(err if status == 2 and not out else out)


def close(robot: Host, gateway: Host, *more: str) -> None:
    addresses = ("--appliance", gateway.address, "--appliance", gateway.address6)
    protect(robot, *addresses, "--ports", FEW, "--apply", *more)


@contextlib.contextmanager
def listening(host: Host, *ports: int) -> Iterator[None]:
    with contextlib.ExitStack() as stack:
        for port in ports:
            with host.entered():
                stack.enter_context(
                    socket.create_server(("::", port), family=socket.AF_INET6, dualstack_ipv6=True)
                )
        yield


def reaches(host: Host, address: str, port: int) -> bool:
    """Return whether a connection is accepted. A refusal must be explicit; silence raises."""
    with host.entered():
        try:
            socket.create_connection((address, port), timeout=10).close()
        except ConnectionRefusedError:
            return False
    return True


def rules(host: Host) -> str:
    process = host.popen(["nft", "-s", "list", "ruleset"], stdout=subprocess.PIPE, text=True)
    return str(process.communicate(timeout=30)[0])


def test_only_the_appliance_reaches_the_ports(robot: Host, gateway: Host, attacker: Host) -> None:
    with listening(robot, INSIDE, KEPT, OUTSIDE):
        assert reaches(attacker, robot.address, INSIDE)
        close(robot, gateway, "--open", f"tcp/{KEPT}")
        for address in (robot.address, robot.address6):
            assert not reaches(attacker, address, INSIDE)
            assert reaches(gateway, address, INSIDE)
            assert reaches(robot, address, INSIDE)
            assert reaches(attacker, address, KEPT)
            assert reaches(attacker, address, OUTSIDE)
        assert reaches(robot, "127.0.0.1", INSIDE)
        protect(robot, "--remove")
        assert reaches(attacker, robot.address, INSIDE)


def test_the_appliance_of_this_machine_reaches_the_ports_by_each_address(
    lab: Lab, robot: Host, attacker: Host
) -> None:
    """Its next start chooses another one, for example after the route of a VPN."""
    appliance = lab.host("inside", "10.77.0.3/24")
    interfaces.create_veth(robot.namespace, LINK, appliance.namespace, "link")
    for number in (1, 5):
        interfaces.add_address(robot.namespace, LINK, f"10.111.0.{number}/30")
        interfaces.add_address(appliance.namespace, "link", f"10.111.0.{number + 1}/30")
        if number == 1:
            protect(robot, "--appliance", "10.111.0.2", "--ports", FEW, "--apply")
        with listening(robot, INSIDE):
            assert reaches(appliance, f"10.111.0.{number}", INSIDE)
            assert not reaches(appliance, robot.address, INSIDE), "it comes by another interface"
            assert not reaches(attacker, robot.address, INSIDE)


@contextlib.contextmanager
def as_user(number: int) -> Iterator[None]:
    """Run as another user; the thread keeps its namespace."""
    os.setresuid(number, number, 0)
    try:
        yield
    finally:
        os.setresuid(0, 0, 0)


def reached_by(host: Host, user: int, address: str, port: int) -> bool:
    with host.entered(), as_user(user):
        try:
            socket.create_connection((address, port), timeout=10).close()
        except ConnectionRefusedError:
            return False
    return True


def test_strict_rules_keep_other_users_of_the_machine_out(robot: Host, gateway: Host, attacker: Host) -> None:
    """Only the node's own user and the appliance reach its ports: also over the machine's own addresses."""
    node, other = 61_001, 61_002
    with listening(robot, INSIDE, KEPT, OUTSIDE):
        assert reached_by(robot, other, "127.0.0.1", INSIDE)
        close(robot, gateway, "--open", f"tcp/{KEPT}", "--strict", "--user", str(node))
        for address in ("127.0.0.1", "::1", robot.address, robot.address6):
            assert reached_by(robot, node, address, INSIDE), address
            for user in (other, 0):  # root is another user: its rosnode does not reach the nodes
                assert not reached_by(robot, user, address, INSIDE), (address, user)
                assert reached_by(robot, user, address, KEPT)
                assert reached_by(robot, user, address, OUTSIDE)
        assert reaches(gateway, robot.address, INSIDE)
        assert not reaches(attacker, robot.address, INSIDE)
        with robot.entered(), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
            receiver.bind(("127.0.0.1", INSIDE))
            receiver.settimeout(1)
            for user, arrives in ((other, False), (node, True)):
                refused = contextlib.suppress(PermissionError)  # a dropped datagram is an error of the sender
                with as_user(user), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender, refused:
                    sender.sendto(b"x", ("127.0.0.1", INSIDE))
                if arrives:
                    assert receiver.recv(9) == b"x"
                else:
                    with pytest.raises(TimeoutError):
                        receiver.recv(9)
        close(robot, gateway)  # without --strict, the chain is gone again
        assert reached_by(robot, other, "127.0.0.1", INSIDE)


IN_A_GROUP = """
set -e
mount -t cgroup2 none /sys/fs/cgroup
mkdir /sys/fs/cgroup/$3
trap 'rmdir /sys/fs/cgroup/$3' EXIT
"$1" -c "$2" --appliance 10.77.0.2 --ports 40000-40099 --apply --strict --cgroup "$3" >&2
reach="import socket; socket.create_connection(('127.0.0.1', 40007), timeout=10)"
"$1" -c "open('/sys/fs/cgroup/$3/cgroup.procs', 'w').write('0'); $reach; print('the group connects')"
"$1" -c "$reach" 2>/dev/null || echo "another process does not"
"""


def test_strict_rules_know_the_control_group_of_the_nodes(robot: Host) -> None:
    """In a mount namespace of its own: nft looks for the group below /sys/fs/cgroup."""
    need_program("unshare", "util-linux")
    script = [
        "unshare",
        "-m",
        "bash",
        "-c",
        IN_A_GROUP,
        "bash",
        sys.executable,
        COMMAND,
        f"rosrv_{os.getpid()}",
    ]
    with listening(robot, INSIDE):
        process = robot.popen(
            script, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])},
        )  # fmt: skip
        out, err = process.communicate(timeout=120)
    assert (out, process.returncode) == ("the group connects\nanother process does not\n", 0), err


def test_a_container_behind_the_machine_is_not_taken_for_it(
    lab: Lab, robot: Host, gateway: Host, attacker: Host
) -> None:
    need_program("iptables-legacy-restore", "iptables")
    behind = lab.host("container", "10.76.0.2/24")
    interfaces.delete_link(behind.namespace, "eth0")
    guest = guest_behind(robot.namespace, behind.namespace, TRANSLATORS[0])
    interfaces.add_route(gateway.namespace, f"{TRANSLATORS[0].network}.0/24", robot.address)
    with serving(gateway.namespace, 11311) as master, serving(attacker.namespace, 80) as elsewhere:
        assert source_seen(master, guest, gateway.address, 11311) == robot.address
        close(robot, gateway)
        with guest.entered(), pytest.raises(TimeoutError):
            socket.create_connection((gateway.address, 11311), timeout=1)
        assert source_seen(master, robot, gateway.address, 11311) == robot.address
        assert source_seen(master, robot, gateway.address6, 11311) == robot.address6
        assert source_seen(elsewhere, guest, attacker.address, 80) == robot.address, (
            "not concerned by the appliance"
        )
        load(robot.namespace, "iptables-legacy-restore", "*nat\n-F POSTROUTING\nCOMMIT\n")
        assert source_seen(master, guest, gateway.address, 11311) == guest.address, "a router stays a router"


def test_missing_syn_cookies_are_reported(robot: Host, gateway: Host) -> None:
    robot.namespace.sysctl("net.ipv4.tcp_syncookies", "0")
    command = [sys.executable, "-c", COMMAND, "--appliance", gateway.address, "--ports", FEW, "--apply"]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}
    process = robot.popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, env=environment
    )
    assert "sysctl -w net.ipv4.tcp_syncookies=1" in process.communicate(timeout=240)[1]


def test_the_check_from_outside_finds_open_ports(robot: Host, gateway: Host, attacker: Host) -> None:
    arguments = ("--check", robot.address, "--ports", FEW, "--json")
    with listening(robot, INSIDE, KEPT):
        before = json.loads(protect(attacker, *arguments, status=1))
        assert before["state"] == "open"
        assert before["addresses"][0]["open"] == [INSIDE, KEPT]
        close(robot, gateway, "--open", f"tcp/{KEPT}")
        after = json.loads(protect(attacker, *arguments, "--open", f"tcp/{KEPT}"))
        assert (after["state"], after["addresses"][0]["refused"]) == ("closed", 99)
        forgotten = protect(attacker, "--check", robot.address6, "--ports", FEW, status=1)
        assert forgotten == f"{robot.address6}: OPEN: TCP {KEPT} of {FEW}\n"


def test_the_whole_local_port_range_is_closed_and_checked(robot: Host, gateway: Host, attacker: Host) -> None:
    first, last = (int(word) for word in robot.namespace.sysctl("net.ipv4.ip_local_port_range").split())
    with listening(robot, first, last):
        before = json.loads(protect(attacker, "--check", robot.address, "--json", status=1))
        assert before["addresses"][0]["open"] == [first, last]
        protect(robot, "--appliance", gateway.address, "--apply")
        after = json.loads(protect(attacker, "--check", robot.address, "--json"))
        assert after["addresses"][0]["refused"] == last - first + 1


def test_own_connections_of_the_machine_work(robot: Host, gateway: Host, attacker: Host) -> None:
    with robot.entered():
        server = socket.create_server((robot.address, INSIDE))
        node = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        node.bind((robot.address, INSIDE))
    with attacker.entered():
        old = socket.create_connection((robot.address, INSIDE), timeout=10)
        answering = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        answering.bind((attacker.address, 53))
        stray = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    accepted, _ = server.accept()
    with server, node, old, answering, stray, accepted, listening(attacker, 8080):
        for one in (node, answering, accepted, old):
            one.settimeout(10)
        close(robot, gateway)
        accepted.sendall(b"still here")
        assert old.recv(10) == b"still here"
        old.sendall(b"me too")
        assert accepted.recv(6) == b"me too"
        assert reaches(robot, attacker.address, 8080)
        stray.sendto(b"forged", (robot.address, INSIDE))
        node.sendto(b"question", (attacker.address, 53))
        assert answering.recvfrom(100)[0] == b"question"
        answering.sendto(b"answer", (robot.address, INSIDE))
        assert node.recv(100) == b"answer", "the stray packet came first but was dropped"


def test_applying_and_removing_can_be_repeated(robot: Host, gateway: Host) -> None:
    robot.popen(["nft", "add", "table", "inet", "filter"]).wait(timeout=20)
    before = rules(robot)
    close(robot, gateway)
    once = rules(robot)
    close(robot, gateway)
    assert rules(robot) == once
    close(robot, gateway, "--open", "udp/40001")
    assert rules(robot).count("udp dport 40001 accept") == 1
    assert "open again" in protect(robot, "--remove")
    assert rules(robot) == before
    assert "nothing to remove" in protect(robot, "--remove")


def test_removing_names_a_tunnel_that_closes_the_ports_again(robot: Host, gateway: Host) -> None:
    close(robot, gateway)
    robot.popen(["nft", "add", "table", "inet", "rosrv_tunnel"]).wait(timeout=20)
    assert "/etc/rosrv/leave.sh" in protect(robot, "--remove")
    assert "rosrv_protect" not in rules(robot)


def test_the_printed_file_can_be_loaded(robot: Host, gateway: Host, tmp_path: Path) -> None:
    text = protect(robot, "--appliance", gateway.address, "--ports", FEW)
    assert rules(robot) == ""
    file = tmp_path / "rosrv-protect.nft"
    file.write_text(text, encoding="utf-8")
    for _ in range(2):
        assert robot.popen(["nft", "-f", str(file)]).wait(timeout=20) == 0
    loaded = rules(robot)
    protect(robot, "--appliance", gateway.address, "--ports", FEW, "--apply")
    assert rules(robot) == loaded


def test_a_silent_machine_is_not_reported_as_closed(lab: Lab, robot: Host, attacker: Host) -> None:
    lab.unplug(robot)
    arguments = ("--check", robot.address, "--ports", "40000-40010", "--within", "0.2s")
    assert "may be open" in protect(attacker, *arguments, status=2)
    assert json.loads(protect(attacker, *arguments, "--json", status=2))["state"] == "unknown"


@pytest.mark.parametrize("address", ["192.0.2.7", "2001:db8::7"])
def test_an_unroutable_network_is_not_reported_as_open(attacker: Host, address: str) -> None:
    arguments = ("--check", address, "--ports", "40000-40010", "--json")
    report = json.loads(protect(attacker, *arguments, status=2))
    (seen,) = report["addresses"]
    assert (report["state"], seen["open"], seen["untried"]) == ("unknown", [], 11)
    assert seen["obstacle"] == "Network is unreachable"
    words = protect(attacker, *arguments[:-1], status=2)
    assert "11 ports" in words
    assert "could not be tried: Network is unreachable" in words


def test_a_machine_cannot_check_itself(robot: Host) -> None:
    for address in (robot.address, robot.address6, "localhost"):
        assert "run the check on another machine" in protect(robot, "--check", address, status=2)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "--appliance 192.168.1.20"),
        (("--appliance", "robot.local"), "'robot.local' is not the IP address of an appliance"),
        (("--appliance", "127.0.0.1"), "127.0.0.1 cannot be the address of an appliance"),
        (("--appliance", "10.0.0.1", "--open", "tcp/22,ssh"), "--open 'ssh' is not a service"),
        (("--appliance", "10.0.0.1", "--open", "tcp/99999"), "--open 'tcp/99999' is not a service"),
        (("--appliance", "10.0.0.1", "--ports", "9-3"), "9-3 is not a range of ports"),
        (("--apply", "--remove"), "exclude one another"),
        (("--check", "no-such-host.invalid"), "the host 'no-such-host.invalid' is unknown"),
    ],
)
def test_wrong_arguments_are_named(robot: Host, arguments: tuple[str, ...], words: str) -> None:
    assert words in protect(robot, *arguments, status=2)
    assert rules(robot) == ""


def test_without_nft_the_error_names_the_package(robot: Host) -> None:
    words = protect(robot, "--appliance", "10.77.0.2", "--apply", status=2, PATH="/nonexistent")
    assert "sudo apt install nftables" in words


def test_without_root_the_error_says_so(robot: Host) -> None:
    program = (
        "import os; os.setgroups([]); os.setgid(61099); os.setuid(61099)\n"
        "from appliance.network.namespaces import NetworkError\n"
        "from appliance.network import close_ports\n"
        "try: close_ports.apply('table inet x { }')\n"
        "except NetworkError as error: print(error)\n"
    )
    process = robot.popen(
        [sys.executable, "-c", "import appliance.network.close_ports\n" + program],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])},
    )
    assert "run it as root" in process.communicate(timeout=30)[0]
    assert rules(robot) == ""
