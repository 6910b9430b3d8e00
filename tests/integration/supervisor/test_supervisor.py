"""Real processes, killed, stopped and starved: what the supervisor promises about them."""

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

from appliance.supervisor.privileges import SUPERVISORS
from appliance.supervisor.roles import ROSMASTER, ROSOUT
from tests.integration.supervisor.actors import CROWD
from tests.support.processes import Process, ThisMachine
from tests.support.requirements import need_root, needs
from tests.support.waiting import allowed, eventually

ROOT = Path(__file__).parents[3]
PROGRAM = Path(__file__).parent / "program.py"
OURS = ("control", "relay", "signer")
ALL = (*OURS, "rosmaster", "rosout")


class Running:
    """A supervisor with its children."""

    def __init__(self, state: Path, *actors: str) -> None:
        self.state = state
        environment = {"PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
        command = [sys.executable, str(PROGRAM), str(state), *actors]
        self.process = Process(ThisMachine(), command, env=environment, label="supervisor")

    def until_ready(self) -> "Running":
        """Wait until nodes may connect and everything runs."""
        self.process.wait_for(event="ready", timeout=60)
        for role in ALL:
            self.pid(role)
        return self

    def until_confined(self) -> "Running":
        """Wait until everything runs and each process has given up what it must not have: nodes may connect before."""
        self.until_ready()
        for role in ALL:
            pid = self.pid(role)
            # The filter of system calls is the last that it takes upon itself.
            eventually(partial(_is_filtered, pid), f"{role} is confined")
        return self

    def pid(self, role: str, *, restarts: int = 0) -> int:
        """The process id of a role's life after this many restarts."""
        return int(self.process.wait_for(event="process started", role=role, restarts=restarts)["pid"])

    def echo(self) -> int:
        """Connect to the socket that control keeps: the process id of the control that answers."""
        uri = self.process.wait_for(event="ready")["master"]
        with socket.create_connection(("127.0.0.1", int(uri.rsplit(":", 1)[1])), timeout=20) as connection:
            return int(connection.recv(20))

    def children(self) -> list[int]:
        """Every process that the supervisor started and that is still there."""
        started = [event["pid"] for event in self.process.seen(event="process started")]
        return [pid for pid in started if Path(f"/proc/{pid}").exists()]

    def until_childless(self) -> None:
        """Wait until none of the children is there; fails after ten seconds."""
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


@pytest.fixture
def state() -> Iterator[Path]:
    """A state directory that the users of the roles can reach."""
    needs(ROSMASTER.exists() and ROSOUT.exists(), "rosmaster and rosout (run `make setup`)")
    directory = Path(tempfile.mkdtemp(prefix="rosrv-supervisor-"))
    directory.chmod(0o755)
    yield directory / "state"
    shutil.rmtree(directory)


@pytest.fixture
def start(state: Path) -> Iterator[Any]:
    """Start a supervisor; ended with the test."""
    started: list[Running] = []

    def start(*actors: str) -> Running:
        started.append(Running(state, *actors))
        return started[-1]

    yield start
    for running in started:
        running.process.stop(with_signal=signal.SIGTERM)
        running.until_childless()


@pytest.mark.parametrize("role", ALL)
def test_a_killed_process_is_back_within_a_second(start: Any, role: str) -> None:
    """Whatever dies is started again within a second, and control is told the new process."""
    running = start().until_ready()
    killed = time.monotonic()
    os.kill(running.pid(role), signal.SIGKILL)
    new = running.pid(role, restarts=1)
    assert time.monotonic() - killed < allowed(1)
    running.process.wait_for(lambda event: event.get("processes", {}).get(role) == [new, 1], actor="control")
    assert running.echo() == running.pid("control", restarts=1 if role == "control" else 0)


@pytest.mark.parametrize("role", ["control", "rosmaster"])
def test_a_hanging_process_is_replaced(start: Any, role: str) -> None:
    """A process that is there but does not answer is killed after five seconds and started again."""
    running = start().until_ready()
    hanging = running.pid(role)
    os.kill(hanging, signal.SIGSTOP)
    stopped = time.monotonic()
    running.process.wait_for(event="process does not answer and is killed", pid=hanging)
    assert 4 < time.monotonic() - stopped < allowed(9)
    running.pid(role, restarts=1)


def test_a_port_of_control_stays_open_while_control_is_dead(start: Any) -> None:
    """A node that connects while there is no control waits in the queue and is served by the next one."""
    running = start().until_ready()
    old = running.pid("control")
    os.kill(old, signal.SIGKILL)
    answered = running.echo()
    assert answered == running.pid("control", restarts=1) != old
    restored = running.process.wait_for(actor="control", pid=answered, count=2)
    assert restored["restored"] == ["admin", "echo"]


def test_every_port_of_a_large_robot_survives_control(start: Any) -> None:
    """Two ports for each of a thousand nodes are given back to the next control, all of them, at once."""
    running = start("control=crowded").until_ready()
    os.kill(running.pid("control"), signal.SIGKILL)
    began = time.monotonic()
    new = running.pid("control", restarts=1)
    restored = running.process.wait_for(lambda event: "count" in event, actor="control", pid=new)
    assert time.monotonic() - began < allowed(2)
    assert restored["count"] == len(restored["restored"]) == CROWD + 2


def test_the_admin_socket_survives_control(start: Any, state: Path) -> None:
    """The socket in the state directory stays one that control listens on, whichever control it is."""
    running = start().until_ready()
    os.kill(running.pid("control"), signal.SIGKILL)
    with socket.socket(socket.AF_UNIX) as connection:
        connection.connect(str(state / "admin.sock"))
    running.process.wait_for(actor="control", pid=running.pid("control", restarts=1), count=2)


@pytest.mark.parametrize("role", ["relay", "control"])
def test_a_restarted_end_gets_a_fresh_link(start: Any, role: str) -> None:
    """After the death of either end, control and relay can speak to each other again."""
    running = start().until_ready()
    running.process.wait_for(actor="relay", link="control", said="StateBegan")
    mark = running.process.mark()
    os.kill(running.pid(role), signal.SIGKILL)
    relay = running.pid("relay", restarts=1 if role == "relay" else 0)
    running.process.wait_for(actor="relay", pid=relay, link="control", said="StateBegan", since=mark)


@pytest.mark.parametrize("role", ["relay", "control"])
def test_a_process_that_says_what_it_may_not_is_replaced(start: Any, role: str) -> None:
    """A relay cannot have sockets kept, control cannot play supervisor: they are killed for trying."""
    running = start().until_ready()
    running.process.wait_for(actor=role)  # it listens to signals before it says anything
    os.kill(running.pid(role), signal.SIGUSR1)
    running.process.wait_for(event="process is killed", role=role)
    running.pid(role, restarts=1)
    assert running.echo()


def test_nothing_outlives_a_killed_supervisor(start: Any) -> None:
    """SIGKILL of the supervisor ends all its processes, and a new start finds nothing in its way."""
    running = start().until_ready()
    os.kill(running.pid("relay"), signal.SIGSTOP)  # not even a process that cannot see its lifeline end
    os.kill(running.process.pid, signal.SIGKILL)
    running.until_childless()
    again = start().until_ready()
    assert again.echo() == again.pid("control")


def test_a_clean_end_leaves_nothing(start: Any, state: Path) -> None:
    """SIGTERM: exit status 0 in less than five seconds, no process, no socket, no lock, no complaint."""
    running = start().until_ready()
    began = time.monotonic()
    assert running.process.stop(with_signal=signal.SIGTERM) == 0
    assert time.monotonic() - began < allowed(5)
    assert running.children() == []
    left = sorted(path.name for path in state.iterdir())
    assert left == ["control", "ipsec", "lock", "relay", "rosmaster", "rosout", "run", "signer"]
    assert running.process.seen(event="process did not end") == []


def test_an_end_while_the_surroundings_are_made_takes_them_away(start: Any, state: Path) -> None:
    """SIGTERM, Ctrl-C or a terminal that goes away before the first process: an orderly end, nothing is left."""
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
    """Who is impatient (Ctrl-C twice) gets the same end: the surroundings are taken away, exit status 0."""
    running = start("interrupted=remove").until_ready()
    assert running.process.stop(with_signal=signal.SIGTERM) == 0
    assert running.process.seen(event="removed")
    assert (state / "lock").read_text() == ""


def test_control_may_end_the_appliance(start: Any) -> None:
    """The `shutdown` call of the Master API, once granted, ends it as SIGTERM would."""
    running = start().until_ready()
    os.kill(running.pid("control"), signal.SIGUSR2)
    assert running.process.wait() == 0
    assert running.children() == []


def test_a_stubborn_process_does_not_hold_up_the_end(start: Any) -> None:
    """What ends neither when asked nor by SIGTERM is killed; the end still comes within five seconds."""
    running = start("relay=stubborn").until_ready()
    began = time.monotonic()
    assert running.process.stop(with_signal=signal.SIGTERM) == 0
    assert time.monotonic() - began < allowed(5)
    assert running.children() == []


def test_a_second_appliance_on_the_same_state_is_refused(start: Any) -> None:
    """The second start says which process has the state directory, and the first one does not notice."""
    first = start().until_ready()
    second = start()
    assert second.process.wait() == 1
    reason = second.process.wait_for(event="refused")["reason"]
    assert f"process {first.process.pid}" in reason
    assert first.echo()


def test_why_control_cannot_serve_is_what_the_user_reads(start: Any) -> None:
    """Every finding of a wrong policy reaches who started the appliance, and nothing is left running."""
    running = start("control=failing")
    assert running.process.wait() == 1
    reason = running.process.wait_for(event="refused")["reason"]
    assert reason == "policy.ini:3: unknown section [Nods]\npolicy.ini:9: unknown key \\x1b[2J"
    running.until_childless()


def test_what_cannot_serve_later_is_tried_again_and_ends_nothing(start: Any) -> None:
    """Nodes are connected: a control that finds the disk full is started again until it finds room, and why is said."""
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
    """When control dies again and again before nodes could ever connect, the start fails and says so."""
    running = start("control=dying")
    assert running.process.wait() == 1
    assert "control died 5 times (exit status 3)" in running.process.wait_for(event="refused")["reason"]


def test_nothing_is_served_when_others_can_reach_the_hidden_master(start: Any) -> None:
    """When the probe gets through at the start, the start fails, says what is open, and lets no node in."""
    running = start("leaky")
    assert running.process.wait() == 1
    assert running.process.wait_for(event="refused")["reason"] == "ROSMaster can be reached by another user"
    assert running.process.seen(event="process started", role="control") == []


def test_each_process_has_a_user_of_its_own_and_no_privilege(start: Any) -> None:
    """As root: the ids of the design, no groups, no capability in any set, no way to gain one."""
    need_root()
    running = start().until_confined()
    running.process.wait_for_text("subscribed to /rosout")
    users = {"control": "rosrv", "relay": "rosrv-relay", "signer": "rosrv-signer", "rosmaster": "rosmaster"}
    ids = {role: _status(running.pid(role))["Uid"].split() for role in users}
    assert all(len(set(one)) == 1 and one[0] != "0" for one in ids.values())
    assert len({one[0] for one in ids.values()}) == len(users)
    for role in ALL:
        status = _status(running.pid(role))
        assert status["Groups"] == ""
        assert {status[name] for name in ("CapInh", "CapPrm", "CapEff", "CapBnd", "CapAmb")} == {"0" * 16}
        assert status["NoNewPrivs"] == "1"
        assert status["Umask"] == "0077"
        assert status["SigBlk"] == "0" * 16  # it ends when it is asked to


def test_the_supervisor_keeps_few_capabilities(start: Any) -> None:
    """As root: what it has no use for (kernel modules, raw memory, clock …) it cannot do."""
    need_root()
    running = start().until_ready()
    allowed = sum(1 << number for number in SUPERVISORS.values())
    status = _status(running.process.pid)
    for name in ("CapEff", "CapPrm", "CapBnd", "CapInh", "CapAmb"):
        assert int(status[name], 16) & ~allowed == 0


def test_the_signer_has_no_network(start: Any) -> None:
    """As root: the signer is alone in a network namespace of its own."""
    need_root()
    running = start().until_confined()
    own = Path(f"/proc/{os.getpid()}/ns/net").readlink()
    assert Path(f"/proc/{running.pid('signer')}/ns/net").readlink() != own
    assert Path(f"/proc/{running.pid('relay')}/ns/net").readlink() == own


def test_each_part_of_the_state_is_its_owners_only(start: Any, state: Path) -> None:
    """Nobody can look around in the state directory, and each part is closed to the other roles."""
    running = start().until_confined()
    assert stat.S_IMODE(state.stat().st_mode) == 0o711
    for part in ("control", "relay", "signer", "rosmaster"):
        found = (state / part).stat()
        # The audit log is readable for the api's group, which may pass through control's part and not look around.
        assert stat.S_IMODE(found.st_mode) == (0o2710 if part == "control" and os.geteuid() == 0 else 0o700)
        assert str(found.st_uid) == _status(running.pid(part))["Uid"].split()[0]
    assert stat.S_IMODE((state / "admin.sock").stat().st_mode) == 0o600


def test_a_child_has_only_the_files_it_was_given(start: Any) -> None:
    """No descriptor of the supervisor (lock, kept sockets, other lifelines) leaks into a child."""
    running = start().until_confined()
    supervisors, relays = (_open_files(pid) for pid in (running.process.pid, running.pid("relay")))
    assert [
        one for one in supervisors & relays if one.startswith(("socket:", "/")) and one != "/dev/null"
    ] == []


def test_the_hidden_master_listens_on_loopback_only(start: Any, state: Path) -> None:
    """ROSMaster's port is not reachable by any other address of the machine."""
    running = start().until_ready()
    port = json.loads((state / "run" / "config.json").read_text())["rosmaster_port"]
    listening = Path(f"/proc/{running.pid('rosmaster')}/net/tcp").read_text().splitlines()
    addresses = {row.split()[1] for row in listening[1:] if row.split()[3] == "0A"}
    assert f"0100007F:{port:04X}" in addresses
    assert f"00000000:{port:04X}" not in addresses


def _is_filtered(pid: int) -> bool:
    return _status(pid)["Seccomp"] == "2"


def _status(pid: int) -> dict[str, str]:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return {name: value.strip() for name, _, value in (line.partition(":") for line in lines)}


def _open_files(pid: int) -> set[str]:
    return {str(one.readlink()) for one in Path(f"/proc/{pid}/fd").iterdir()}
