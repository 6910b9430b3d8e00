import asyncio
import os
import signal
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from appliance.network import interfaces
from appliance.network.namespaces import Namespace, NetworkError, namespaces
from examples.landshark.lab import Lab, clear_leftovers
from tests.support.processes import runs
from tests.support.requirements import need_root


@pytest.fixture(autouse=True)
def _root() -> None:
    need_root()


def test_hosts_reach_each_other_over_both_families() -> None:
    with Lab("rosrv-lab") as lab:
        robot = lab.host("robot", "10.77.0.10/24", "fd77::10/64")
        operator = lab.host("operator", "10.77.0.11/24", "fd77::11/64")
        for family, address in ((socket.AF_INET, robot.address), (socket.AF_INET6, robot.address6)):
            with robot.entered(), socket.create_server((address, 0), family=family) as server:
                port = server.getsockname()[1]
                with operator.entered(), socket.create_connection((address, port), timeout=10):
                    connection, (peer, *_) = server.accept()
                    connection.close()
            assert peer == (operator.address if family == socket.AF_INET else operator.address6)


def test_popen_runs_the_program_itself_on_the_host() -> None:
    with Lab("rosrv-lab") as lab:
        robot = lab.host("robot", "10.77.0.10/24")
        process = robot.popen(
            ["ip", "-br", "-4", "address", "show", "eth0"], stdout=subprocess.PIPE, text=True
        )
        out, _ = process.communicate(timeout=20)
        assert "10.77.0.10/24" in out
        with pytest.raises(FileNotFoundError):
            robot.popen(["/nonexistent/program"])


def test_a_thread_in_a_namespace_does_not_move_others() -> None:
    before = Path("/proc/thread-self/ns/net").readlink()
    with Lab("rosrv-lab") as lab:
        robot = lab.host("robot", "10.77.0.10/24")
        inside = robot.run(lambda: Path("/proc/thread-self/ns/net").readlink())
        assert inside != before
        with pytest.raises(ZeroDivisionError):
            robot.run(lambda: 1 // 0)
        with pytest.raises(ZeroDivisionError), robot.entered():
            _ = 1 // 0
        assert Path("/proc/thread-self/ns/net").readlink() == before


def test_works_under_a_running_event_loop() -> None:
    async def main() -> list[str]:
        with Lab("rosrv-lab") as lab:
            return interfaces.links(lab.host("robot", "10.77.0.10/24").namespace)

    with ThreadPoolExecutor() as thread:  # this thread may have a loop: that of the tests in a browser
        assert sorted(thread.submit(asyncio.run, main()).result()) == ["eth0", "lo"]


def test_closing_ends_every_process_and_leaves_nothing() -> None:
    stubborn = (
        "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
        "print('up', flush=True); signal.pause()"
    )
    with Lab("rosrv-lab") as lab:
        robot = lab.host("robot", "10.77.0.10/24")
        process = robot.popen([sys.executable, "-c", stubborn], stdout=subprocess.PIPE)
        assert process.stdout is not None
        process.stdout.readline()
    assert process.wait(timeout=10) == -signal.SIGKILL
    process.stdout.close()
    assert [space for space in namespaces("rosrv-lab.") if f".{os.getpid()}." in space.name] == []


def test_leftovers_of_a_crashed_lab_are_removed() -> None:
    program = (
        "import sys; from examples.landshark.lab import Lab\n"
        "lab = Lab('rosrv-labcrash').__enter__()\n"
        "child = lab.host('robot', '10.77.0.10/24').popen(['sleep', '600'])\n"
        "print(child.pid, flush=True); sys.stdin.read()"
    )
    crashed = subprocess.Popen(
        [sys.executable, "-c", program],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[3],
    )
    assert crashed.stdout is not None
    assert crashed.stdin is not None
    orphan = int(crashed.stdout.readline())
    crashed.kill()
    crashed.wait(timeout=10)
    crashed.stdin.close()
    crashed.stdout.close()
    cleared = clear_leftovers("rosrv-labcrash")
    assert sorted(name.rpartition(".")[2] for name in cleared) == ["robot", "switch"]
    assert not runs(orphan)
    assert namespaces("rosrv-labcrash.") == []


def test_an_unplugged_host_is_unreachable() -> None:
    with Lab("rosrv-lab") as lab:
        robot = lab.host("robot", "10.77.0.10/24")
        operator = lab.host("operator", "10.77.0.11/24")
        with robot.entered():
            server = socket.create_server((robot.address, 0))
        with server:
            port = server.getsockname()[1]
            lab.unplug(robot)
            with operator.entered(), pytest.raises(OSError, match=r"timed out|No route"):
                socket.create_connection((robot.address, port), timeout=0.3)
            lab.plug(robot)
            with operator.entered(), socket.create_connection((robot.address, port), timeout=10):
                pass


def test_a_namespace_is_made_once_and_deleted_for_good() -> None:
    space = Namespace(f"rosrv-once.{os.getpid()}")
    space.create()
    try:
        assert space.exists()
        with pytest.raises(NetworkError, match=rf"namespace {space.name} already"):
            space.create()
        assert space.sysctl("net.ipv4.ip_forward", "1") == "1"
        assert space.processes() == []
    finally:
        space.delete()
    space.delete()
    assert not space.exists()
    with pytest.raises(NetworkError, match=r"the network namespace .* does not exist"):
        space.run(lambda: None)
