import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import tempfile
import time
import xmlrpc.client
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from appliance.supervisor.roles import ROSMASTER, ROSOUT
from examples.landshark.lab import Host, Lab
from tests.support.command import ROSRV, rosrv
from tests.support.own_namespace import own_namespace
from tests.support.processes import LIMIT, Process, ThisMachine
from tests.support.requirements import need_root, needs
from tests.support.waiting import allowed, eventually

PLACE = ("--listen", "127.0.0.1:0", "--rosmaster-port", "0", "--isolation", "none")
POLICY = (
    "[Nodes]\ndefault = *\n[Publishers]\ndefault = *\n[Subscribers]\ndefault = *\n[Commands]\ndefault = *\n"
    "[Services]\ndefault = *\n[Clients]\ndefault = *\n[Parameters]\nread /** = *\nwrite /** = *\n"
)
ENVIRONMENT = {"PATH": os.environ["PATH"], "PYTHONUNBUFFERED": "1"}


@pytest.fixture
def directory() -> Iterator[Path]:
    needs(ROSMASTER.exists() and ROSOUT.exists(), "rosmaster and rosout (run `make setup`)")
    made = Path(tempfile.mkdtemp(prefix="rosrv-up-"))
    made.chmod(0o755)
    (made / "policy.ini").write_text(POLICY)
    yield made
    shutil.rmtree(made)


def command(directory: Path, *more: str) -> list[str]:
    fixed = ["--state", str(directory / "state"), "--policy", str(directory / "policy.ini")]
    return [ROSRV, "up", *fixed, *PLACE, *more]  # if a flag is repeated, the second value counts


@contextlib.contextmanager
def up(directory: Path, *more: str) -> Iterator[Process]:
    process = Process(ThisMachine(), command(directory, *more), env=ENVIRONMENT, label="rosrv up")
    try:
        yield process
    finally:
        process.stop(with_signal=signal.SIGTERM)


def refusal(directory: Path, *more: str, before: tuple[str, ...] = ()) -> str:
    """Return the error of a start that fails without other output. `before` is a command that runs it."""
    done = subprocess.run(
        [*before, *command(directory, *more)],
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        timeout=2 * LIMIT,
        check=False,
    )
    assert done.returncode == 1
    assert done.stdout == ""
    assert "Traceback" not in done.stderr
    return done.stderr


def pid_of_master(uri: str) -> str:
    with xmlrpc.client.ServerProxy(uri) as master:
        return str(master.getPid("/tester"))


@pytest.mark.real
def test_it_says_when_nodes_may_connect_and_ends_cleanly_in_time(directory: Path) -> None:
    def end(running: Process, number: signal.Signals) -> None:
        began = time.monotonic()
        assert running.stop(with_signal=number) == 0
        assert time.monotonic() - began < allowed(5)

    with up(directory, "--json") as running:
        ready = running.wait_for(event="ready", timeout=2 * LIMIT)
        changing = {"master": "-", "api": "-", "token": "-"}
        assert ready | changing == {"event": "ready", "revision": 1} | changing
        assert ready["api"].startswith("https://127.0.0.1:")
        assert ready["token"].startswith("rosrv_")
        assert pid_of_master(ready["master"]).startswith("[1, ")
        end(running, signal.SIGINT)
    assert running.events == [ready]
    with up(directory) as running:
        line = running.wait_for_text("Nodes may connect", timeout=2 * LIMIT)
        end(running, signal.SIGTERM)
    assert "ROS_MASTER_URI=http://127.0.0.1:" in line
    assert str(directory / "state") in line


def test_a_signal_before_it_is_ready_ends_it_as_well(directory: Path) -> None:
    with up(directory, "--json") as running:
        running.wait_for_error("process started")
        began = time.monotonic()
        assert running.stop(with_signal=signal.SIGINT) == 0
        assert time.monotonic() - began < allowed(5)


def test_a_port_in_use_is_reported_with_its_owner(directory: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        for flags in (("--listen", f"127.0.0.1:{port}"), ("--rosmaster-port", str(port))):
            said = refusal(directory, *flags)
            assert f"port {port} (127.0.0.1) is in use by process {os.getpid()}" in said


def test_a_service_waits_for_a_held_port_and_says_so(directory: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd, contextlib.ExitStack() as held:
        systemd.bind(str(directory / "notify"))
        systemd.settimeout(LIMIT)
        port = held.enter_context(socket.create_server(("127.0.0.1", 0))).getsockname()[1]
        flags = ("--json", "--listen", f"127.0.0.1:{port}")
        environment = ENVIRONMENT | {"NOTIFY_SOCKET": str(directory / "notify")}
        running = Process(ThisMachine(), command(directory, *flags), env=environment, label="rosrv up")
        try:
            waits = f"waits: port {port} (127.0.0.1) is in use by process {os.getpid()}"
            while waits not in systemd.recv(4096).decode():
                pass
            running.wait_for_error(waits)
            answered = rosrv("status", "--state", str(directory / "state"))
            assert (answered.returncode, waits in answered.stderr) == (1, True)
            held.close()
            running.wait_for(event="ready", timeout=2 * LIMIT)
        finally:
            assert running.stop(with_signal=signal.SIGTERM) == 0


def test_a_service_that_waits_for_a_port_ends_at_a_signal(directory: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        flags = ("--listen", f"127.0.0.1:{taken.getsockname()[1]}")
        environment = ENVIRONMENT | {"NOTIFY_SOCKET": str(directory / "nobody")}
        running = Process(ThisMachine(), command(directory, *flags), env=environment, label="rosrv up")
        running.wait_for_error("waits: ")
        assert running.stop(with_signal=signal.SIGTERM) == 0
    assert not (directory / "state/admin.sock").exists()


def test_invalid_configuration_is_reported_before_the_start(directory: Path) -> None:
    said = refusal(directory, "--isolation", "vm", "--listen", "nowhere")
    assert "--isolation: " in said
    assert "--listen: " in said
    assert not (directory / "state").exists()


def test_an_unreachable_state_directory_is_reported(directory: Path) -> None:
    need_root()
    directory.chmod(0o700)
    said = refusal(directory, before=("setpriv", "--bounding-set=-sys_admin"))
    assert "cannot be used by user" in said
    assert str(directory / "state") in said


def test_isolation_is_in_force_from_the_start_to_the_end(directory: Path) -> None:
    need_root()
    with Lab("rosrv-up") as lab:
        host = lab.host("appliance", "10.80.0.2/24")

        def rules() -> list[str]:
            listed = host.popen(["nft", "-j", "list", "ruleset"], stdout=subprocess.PIPE, text=True)
            entries = json.loads(listed.communicate()[0])["nftables"]
            return [entry["rule"]["chain"] for entry in entries if "rule" in entry]

        flags = ("--json", "--isolation", "container", "--listen", "10.80.0.2:11311")
        lives = []
        for number in (signal.SIGKILL, signal.SIGTERM):
            running = Process(host, command(directory, *flags), env=ENVIRONMENT, label="rosrv up")
            try:
                running.wait_for(event="ready", timeout=2 * LIMIT)
                lives.append(sorted(rules()))
            finally:
                running.stop(with_signal=number)
        assert lives[0] == lives[1] != []
        assert rules() == []


def test_in_a_namespace_of_its_own_it_is_reached_through_the_host(directory: Path) -> None:
    need_root()
    with own_namespace(), Lab("rosrv-up") as lab:
        host, robot = lab.host("machine", "10.81.0.2/24"), lab.host("robot", "10.81.0.10/24")
        flags = ("--json", "--isolation", "netns", "--listen", "0.0.0.0:11311")
        running = Process(host, command(directory, *flags), env=ENVIRONMENT, label="rosrv up")
        try:
            running.wait_for(event="ready", timeout=2 * LIMIT)
            assert robot.run(partial(pid_of_master, "http://10.81.0.2:11311")).startswith("[1, ")
            started = [json.loads(line) for line in running.errors if '"process started"' in line]
            spaces = {one["role"]: os.readlink(f"/proc/{one['pid']}/ns/net") for one in started}  # noqa: PTH115  pathlib would resolve what is only a name
            assert spaces["control"] == spaces["relay"] == spaces["rosmaster"]
            assert spaces["control"] != os.readlink(f"/proc/{running.pid}/ns/net")  # noqa: PTH115  pathlib would resolve what is only a name
        finally:
            assert running.stop(with_signal=signal.SIGTERM) == 0
        assert not Path("/run/netns/rosrv").exists()


@pytest.mark.parametrize(
    ("policy", "monitors", "said"),
    [
        (None, None, ["the policy cannot be read: No such file or directory"]),
        ("[Nods]\na = b\n[Commands]\nnosuchcall = *\n", None, ["policy.ini:1:", "policy.ini:4:"]),
        ("\xff", None, ["not UTF-8"]),
        (POLICY, "missing", ["the folder of specifications does not exist"]),
    ],
    ids=["no policy", "wrong policy", "no text", "no folder"],
)
def test_input_files_are_checked_before_the_state_is_made(
    directory: Path, policy: str | None, monitors: str | None, said: list[str]
) -> None:
    (directory / "policy.ini").unlink()
    if policy is not None:
        (directory / "policy.ini").write_bytes(policy.encode("latin-1"))
    more = () if monitors is None else ("--monitors", str(directory / monitors))
    refused = refusal(directory, *more)
    assert {one: refused.count(one) for one in said} == dict.fromkeys(said, 1)
    assert not (directory / "state").exists()


@pytest.mark.real
def test_a_policy_that_was_loaded_outlasts_its_file(directory: Path) -> None:
    state = str(directory / "state")
    with up(directory, "--json") as running:
        running.wait_for(event="ready", timeout=2 * LIMIT)
        assert rosrv("policy", "rollback", "1", "--state", state).returncode == 0
    (directory / "policy.ini").unlink()
    with up(directory, "--json") as running:
        assert running.wait_for(event="ready", timeout=2 * LIMIT)["revision"] == 2
        (directory / "policy.ini").write_text(POLICY)
        assert rosrv("policy", "reload", "--state", state).returncode == 0
    (directory / "policy.ini").unlink()
    with up(directory, "--json") as running:
        assert running.wait_for(event="ready", timeout=2 * LIMIT)["revision"] == 3
    shutil.rmtree(state)
    assert "the policy cannot be read" in refusal(directory)


def test_the_machines_own_addresses_are_the_robot_as_they_come_and_go(directory: Path) -> None:
    (directory / "policy.ini").write_text("[Commands]\ndefault = robot\n")
    need_root()
    with own_namespace(), Lab("rosrv-up") as lab:
        host, other = lab.host("machine", "10.81.0.2/24"), lab.host("robot", "10.81.0.10/24")

        def allows(caller: Host, address: str) -> bool:
            try:
                return caller.run(partial(pid_of_master, f"http://{address}:11311")).startswith("[1, ")
            except xmlrpc.client.Fault:
                return False

        flags = ("--json", "--isolation", "netns", "--listen", "0.0.0.0:11311")
        running = Process(host, command(directory, *flags), env=ENVIRONMENT, label="rosrv up")
        try:
            running.wait_for(event="ready", timeout=2 * LIMIT)
            assert allows(host, "127.0.0.1")
            assert allows(host, "10.81.0.2")
            assert not allows(other, "10.81.0.2")
            assert host.popen(["ip", "address", "add", "10.81.0.3/24", "dev", "eth0"]).wait() == 0
            eventually(lambda: allows(host, "10.81.0.3"), running.story)
            assert not allows(other, "10.81.0.3")
        finally:
            assert running.stop(with_signal=signal.SIGTERM) == 0
