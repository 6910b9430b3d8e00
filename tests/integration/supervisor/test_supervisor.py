import contextlib
import json
import os
import select
import shutil
import signal
import socket
import stat
import sys
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from appliance.supervisor.privileges import SUPERVISOR_CAPABILITIES
from appliance.supervisor.roles import ROSMASTER, ROSOUT
from tests.integration.supervisor.actors import CROWD
from tests.support.processes import LIMIT, Process, ThisMachine
from tests.support.requirements import need_root, needs
from tests.support.waiting import allowed, eventually

ROOT = Path(__file__).parents[3]
PROGRAM = Path(__file__).parent / "program.py"
OURS = ("control", "relay", "signer")
ALL = (*OURS, "rosmaster", "rosout")


class Running:
    def __init__(self, state: Path, *actors: str) -> None:
        self.state = state
        environment = {"PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
        command = [sys.executable, str(PROGRAM), str(state), *actors]
        self.process = Process(ThisMachine(), command, env=environment, label="supervisor")

    def until_ready(self) -> "Running":
        self.process.wait_for(event="ready", timeout=2 * LIMIT)
        for role in ALL:
            self.pid(role)
        return self

    def pid(self, role: str, *, restarts: int = 0) -> int:
        return int(self.process.wait_for(event="process started", role=role, restarts=restarts)["pid"])

    def restarts(self, role: str) -> int:
        return len(self.process.seen(event="process started", role=role)) - 1

    def next_pid(self, role: str, pid: int) -> int:
        starts = [event["pid"] for event in self.process.seen(event="process started", role=role)]
        return self.pid(role, restarts=starts.index(pid) + 1)

    def living(self, role: str) -> int:
        pid = self.pid(role, restarts=self.restarts(role))
        # The system call filter is the last step.
        eventually(partial(_is_filtered, pid), f"{role} is in its sandbox")
        if role in {"control", "relay"}:
            self.process.wait_for(actor=role, pid=pid)
        if role == "rosout":
            events = self.process.events
            began = next(at for at, event in enumerate(events) if event.get("pid") == pid)
            self.process.wait_for(event="subscribed to /rosout", since=began)
        return pid

    def echo(self) -> int:
        uri = self.process.wait_for(event="ready")["master"]
        with socket.create_connection(("127.0.0.1", int(uri.rsplit(":", 1)[1])), timeout=20) as connection:
            return int(connection.recv(20))

    def children(self) -> list[int]:
        started = [event["pid"] for event in self.process.seen(event="process started")]
        return [pid for pid in started if Path(f"/proc/{pid}").exists()]

    def until_childless(self) -> None:
        for pid in self.children():
            with _pidfd(pid) as descriptor:
                if descriptor is not None:
                    assert _wait(descriptor, 10), f"process {pid} is still there\n{self.process.story()}"


class _pidfd:  # noqa: N801  reads as a function
    def __init__(self, pid: int) -> None:
        try:
            self.descriptor: int | None = os.pidfd_open(pid)
        except ProcessLookupError:
            self.descriptor = None

    def __enter__(self) -> int | None:
        return self.descriptor

    def __exit__(self, *exc: object) -> None:
        if self.descriptor is not None:
            os.close(self.descriptor)


def _wait(descriptor: int, seconds: float) -> bool:
    return bool(select.select([descriptor], [], [], seconds)[0])


@contextlib.contextmanager
def state_directory() -> Iterator[Path]:
    needs(ROSMASTER.exists() and ROSOUT.exists(), "rosmaster and rosout (run `make setup`)")
    directory = Path(tempfile.mkdtemp(prefix="rosrv-supervisor-"))
    directory.chmod(0o755)
    yield directory / "state"
    shutil.rmtree(directory)


@pytest.fixture
def state() -> Iterator[Path]:
    with state_directory() as state:
        yield state


@pytest.fixture
def start(state: Path) -> Iterator[Any]:
    started: list[Running] = []

    def start(*actors: str) -> Running:
        started.append(Running(state, *actors))
        return started[-1]

    yield start
    for running in started:
        running.process.stop(with_signal=signal.SIGTERM)
        running.until_childless()


@pytest.fixture(scope="module")
def common() -> Iterator[Running]:
    with state_directory() as state:
        running = Running(state)
        yield running.until_ready()
        running.process.stop(with_signal=signal.SIGTERM)
        running.until_childless()


@pytest.mark.parametrize("role", ALL)
def test_a_killed_process_is_back_within_a_second(common: Running, role: str) -> None:
    old, restarts = common.living(role), common.restarts(role)
    killed = time.monotonic()
    os.kill(old, signal.SIGKILL)
    new = common.next_pid(role, old)
    assert time.monotonic() - killed < allowed(1 + restarts)
    common.process.wait_for(
        lambda event: event.get("processes", {}).get(role) == [new, restarts + 1], actor="control"
    )
    assert common.echo() == common.living("control")
    common.process.wait_for(actor="control", died=role, died_pid=old, end="signal SIGKILL")


@pytest.mark.parametrize("role", ["control", "rosmaster"])
def test_a_hanging_process_is_replaced(common: Running, role: str) -> None:
    hanging = common.living(role)
    os.kill(hanging, signal.SIGSTOP)
    stopped = time.monotonic()
    common.process.wait_for(event="process does not answer and is killed", pid=hanging)
    assert (
        5 - allowed(1) < time.monotonic() - stopped < allowed(9)
    )  # since the last answer, of which one is due
    common.next_pid(role, hanging)


def test_a_port_of_control_stays_open_while_control_is_dead(common: Running) -> None:
    old = common.living("control")
    os.kill(old, signal.SIGKILL)
    answered = common.echo()
    assert answered == common.next_pid("control", old) != old
    restored = common.process.wait_for(actor="control", pid=answered, count=2)
    assert restored["restored"] == ["admin", "echo"]


def test_every_port_of_a_large_robot_survives_control(start: Any) -> None:
    running = start("control=crowded").until_ready()
    os.kill(running.pid("control"), signal.SIGKILL)
    began = time.monotonic()
    new = running.pid("control", restarts=1)
    restored = running.process.wait_for(lambda event: "count" in event, actor="control", pid=new)
    assert time.monotonic() - began < allowed(2)
    assert restored["count"] == len(restored["restored"]) == CROWD + 2


def test_the_admin_socket_survives_control(common: Running) -> None:
    old = common.living("control")
    os.kill(old, signal.SIGKILL)
    with socket.socket(socket.AF_UNIX) as connection:
        connection.connect(str(common.state / "admin.sock"))
    common.process.wait_for(actor="control", pid=common.next_pid("control", old), count=2)


@pytest.mark.parametrize("role", ["relay", "control"])
def test_a_restarted_end_gets_a_fresh_link(common: Running, role: str) -> None:
    old, relay = common.living(role), common.living("relay")
    common.process.wait_for(actor="relay", pid=relay, link="control", said="StateBegan")
    mark = common.process.mark()
    os.kill(old, signal.SIGKILL)
    if role == "relay":
        relay = common.next_pid(role, old)
    common.process.wait_for(actor="relay", pid=relay, link="control", said="StateBegan", since=mark)


@pytest.mark.parametrize("role", ["relay", "control"])
def test_a_process_with_a_forbidden_message_is_replaced(common: Running, role: str) -> None:
    old = common.living(role)  # control handles signals before its first message
    os.kill(old, signal.SIGUSR1)
    common.process.wait_for(event="process is killed", role=role, pid=old)
    common.next_pid(role, old)
    assert common.echo()


def test_nothing_outlives_a_killed_supervisor(start: Any) -> None:
    running = start().until_ready()
    os.kill(running.living("relay"), signal.SIGSTOP)  # not even a process that cannot see its lifeline end
    os.kill(running.process.pid, signal.SIGKILL)
    running.until_childless()
    again = start().until_ready()
    assert again.echo() == again.pid("control")


def test_a_clean_end_leaves_nothing(start: Any, state: Path) -> None:
    running = start().until_ready()
    began = time.monotonic()
    assert running.process.stop(with_signal=signal.SIGTERM) == 0
    assert time.monotonic() - began < allowed(5)
    assert running.children() == []
    parts = {
        "compiler",
        "control",
        "doors",
        "ipsec",
        "monitors",
        "relay",
        "rosmaster",
        "rosout",
        "run",
        "signer",
    }
    assert {path.name for path in state.iterdir()} == {"lock", *parts}
    assert running.process.seen(event="process did not stop") == []


def test_an_end_during_the_build_removes_the_surroundings(start: Any, state: Path) -> None:
    running = start("interrupted=build")
    assert running.process.wait() == 0
    assert [one["event"] for one in running.process.seen() if one.get("event") in {"built", "removed"}] == [
        "built",
        "removed",
    ]
    assert running.process.seen(event="ready") == []
    assert (state / "lock").read_text() == ""
    running.until_childless()


def test_a_second_end_does_not_interrupt_the_first(start: Any, state: Path) -> None:
    running = start("interrupted=remove").until_ready()
    assert running.process.stop(with_signal=signal.SIGTERM) == 0
    assert running.process.seen(event="removed")
    assert (state / "lock").read_text() == ""


def test_control_may_end_the_appliance(start: Any) -> None:
    running = start().until_ready()
    os.kill(running.pid("control"), signal.SIGUSR2)
    assert running.process.wait() == 0
    assert running.children() == []


def test_a_stubborn_process_does_not_hold_up_the_end(start: Any) -> None:
    running = start("relay=stubborn").until_ready()
    began = time.monotonic()
    assert running.process.stop(with_signal=signal.SIGTERM) == 0
    assert time.monotonic() - began < allowed(5)
    assert running.children() == []


def test_a_second_appliance_on_the_same_state_is_refused(common: Running) -> None:
    second = Running(common.state)
    assert second.process.wait() == 1
    reason = second.process.wait_for(event="refused")["reason"]
    second.process.stop()
    assert f"process {common.process.pid}" in reason
    assert common.echo()


def test_the_user_sees_why_control_cannot_serve(start: Any) -> None:
    running = start("control=failing")
    assert running.process.wait() == 1
    reason = running.process.wait_for(event="refused")["reason"]
    assert reason == "policy.ini:3: unknown section [Nods]\npolicy.ini:9: unknown key \\x1b[2J"
    running.until_childless()


def test_a_control_that_fails_later_is_retried(start: Any) -> None:
    running = start("control=failing_again").until_ready()
    os.kill(running.pid("control"), signal.SIGKILL)
    for restarts in (1, 2, 3):
        pid = running.pid("control", restarts=restarts)
        said = running.process.wait_for(event="process cannot serve", role="control")
        assert said["reason"].startswith("policy.ini:3: unknown section [Nods]")
        running.process.wait_for(event="process died", pid=pid)
    assert running.echo() == running.pid("control", restarts=4)
    assert running.process.stop(with_signal=signal.SIGTERM) == 0


def test_a_control_that_never_lives_is_an_error(start: Any) -> None:
    running = start("control=dying")
    assert running.process.wait() == 1
    assert "control died 5 times (exit status 3)" in running.process.wait_for(event="refused")["reason"]


def test_no_service_while_the_hidden_master_is_reachable(start: Any) -> None:
    running = start("leaky")
    assert running.process.wait() == 1
    assert running.process.wait_for(event="refused")["reason"] == "ROSMaster can be reached by another user"
    assert running.process.seen(event="process started", role="control") == []


def test_each_process_has_a_user_of_its_own_and_no_privilege(common: Running) -> None:
    need_root()
    users = {"control": "rosrv", "relay": "rosrv-relay", "signer": "rosrv-signer", "rosmaster": "rosmaster"}
    ids = {role: _status(common.living(role))["Uid"].split() for role in users}
    assert all(len(set(one)) == 1 and one[0] != "0" for one in ids.values())
    assert len({one[0] for one in ids.values()}) == len(users)
    for role in ALL:
        status = _status(common.living(role))
        assert status["Groups"] == ""
        assert {status[name] for name in ("CapInh", "CapPrm", "CapEff", "CapBnd", "CapAmb")} == {"0" * 16}
        assert status["NoNewPrivs"] == "1"
        assert status["Umask"] == "0077"
        assert status["SigBlk"] == "0" * 16  # the process ends on request


def test_the_supervisor_keeps_few_capabilities(common: Running) -> None:
    need_root()
    allowed = sum(1 << number for number in SUPERVISOR_CAPABILITIES.values())
    status = _status(common.process.pid)
    for name in ("CapEff", "CapPrm", "CapBnd", "CapInh", "CapAmb"):
        assert int(status[name], 16) & ~allowed == 0


def test_the_signer_has_no_network(common: Running) -> None:
    need_root()
    own = Path(f"/proc/{os.getpid()}/ns/net").readlink()
    assert Path(f"/proc/{common.living('signer')}/ns/net").readlink() != own
    assert Path(f"/proc/{common.living('relay')}/ns/net").readlink() == own


def test_each_part_of_the_state_is_private(common: Running) -> None:
    assert stat.S_IMODE(common.state.stat().st_mode) == 0o711
    for part in ("control", "relay", "signer", "rosmaster"):
        found = (common.state / part).stat()
        # The api's group may read the audit log; it may traverse control's part but not list it.
        assert stat.S_IMODE(found.st_mode) == (0o2710 if part == "control" and os.geteuid() == 0 else 0o700)
        assert str(found.st_uid) == _status(common.living(part))["Uid"].split()[0]
    assert stat.S_IMODE((common.state / "admin.sock").stat().st_mode) == 0o600


def test_a_child_has_only_the_files_it_was_given(common: Running) -> None:
    states = [str(path) for path in (common.state / "monitors").glob("*/relay-0")]
    memory = ["/memfd:rosrv-heartbeat (deleted)", *states]
    supervisors = _open_files(common.process.pid)
    relays = supervisors & _open_files(common.living("relay")) - {"/dev/null"}
    assert sorted(file for file in relays if file.startswith(("socket:", "/"))) == memory
    assert [role for role in ALL if set(memory) & _open_files(common.living(role))] == ["relay"]


def test_the_hidden_master_listens_on_loopback_only(common: Running) -> None:
    port = json.loads((common.state / "run" / "config.json").read_text())["rosmaster_port"]
    listening = Path(f"/proc/{common.living('rosmaster')}/net/tcp").read_text().splitlines()
    addresses = {row.split()[1] for row in listening[1:] if row.split()[3] == "0A"}
    assert f"0100007F:{port:04X}" in addresses
    assert f"00000000:{port:04X}" not in addresses


def _is_filtered(pid: int) -> bool:
    return _status(pid)["Seccomp"] == "2"


def _status(pid: int) -> dict[str, str]:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return {name: value.strip() for name, _, value in (line.partition(":") for line in lines)}


def _open_files(pid: int) -> set[str]:
    found = set()
    for one in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # it is closed by now
            found.add(str(one.readlink()))
    return found
