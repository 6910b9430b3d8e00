import asyncio
import errno
import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Never

import msgspec
import pytest
from structlog.testing import capture_logs

from appliance.channel.messages import (
    Announced,
    CompilerWanted,
    EndAgreed,
    NodeSilent,
    ProcessDied,
    ProcessOverdue,
    ProcessWanted,
    Ready,
    RouteWanted,
)
from appliance.network.namespaces import NetworkError
from appliance.supervisor import supervisor as module
from appliance.supervisor.errors import StartError
from appliance.supervisor.isolation_lifecycle import NoIsolation
from appliance.supervisor.machine_work import NoMachineWork
from appliance.supervisor.process_slot import FAILING_AFTER, ProcessSlot
from appliance.supervisor.role import Facts, Role
from appliance.supervisor.roles import ROLES
from appliance.supervisor.supervisor import ControlReady, Supervisor
from tests.support.memory_child import MemoryChild

pytestmark = [pytest.mark.anyio, pytest.mark.usefixtures("guard_in_loop")]

READY = ControlReady("http://127.0.0.1:11311", 1, "http://127.0.0.1:2", 3, 4, "secret")
CONTROL = Role(name="control", user="rosrv", part="control", entry="m:f")
ROSMASTER = Role(name="rosmaster", user="rosmaster", part="rosmaster", entry="m:f", asks=True)


Make = Callable[..., Supervisor]


@pytest.fixture
def made(tmp_path: Path, local_sockets: None) -> Iterator[Make]:
    with ExitStack() as closing:

        def made(*roles: Role, ready: Callable[[ControlReady], None] = lambda _said: None) -> Supervisor:
            admin = socket.create_server(("127.0.0.1", 0))
            facts = Facts(state=tmp_path, config=tmp_path / "config.json", rosmaster_port=1)
            supervisor = Supervisor(roles, facts, admin=admin, ready=ready)
            closing.callback(supervisor.kept.close)
            return supervisor

        yield made


def child_in(slot: ProcessSlot, supervisor: Supervisor) -> MemoryChild:
    child = MemoryChild(slot.role.name, supervisor.reports)
    slot.process = child.handle
    return child


async def test_a_master_that_dies_during_a_check_is_checked_again(
    made: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    supervisor = made(ROSMASTER)
    [slot] = supervisor.slots
    masters: list[MemoryChild] = []

    async def answers(_seconds: float) -> bool:
        if len(masters) == 1:  # it died during the check
            masters.append(child_in(slot, supervisor))
        return True

    monkeypatch.setattr(supervisor, "answers", answers)
    masters.append(child_in(slot, supervisor))
    await supervisor.until_answering(slot)
    assert [master.handle.answered is not None for master in masters] == [False, True]


async def test_a_first_token_that_cannot_be_saved_ends_the_start(made: Make) -> None:
    """Control gets no confirmation, so the next start creates another token; no ready line is printed."""

    def ready(_said: ControlReady) -> None:
        raise StartError("the first access token cannot be written")

    supervisor, control = made(CONTROL, ready=ready), MemoryChild()
    await supervisor.control_ready(control.handle, READY)
    assert supervisor.failure == "the first access token cannot be written"
    assert not supervisor.is_ready
    assert Announced() not in control.told


STEPS: dict[str, tuple[object, str]] = {
    "socket": (socket, "socketpair"),
    "inputs": (module, "lend_inputs"),
    "isolation": (NoIsolation, "inside"),
    "plan": (ProcessSlot, "plan"),
    "spawn": (module, "ChildProcess"),
    "lifeline": (module, "Channel"),
    "handle": (module, "ProcessHandle"),
}


@pytest.mark.parametrize(
    "error", [OSError(errno.EAGAIN, "no process can be made"), NetworkError("no namespace"), KeyError("role")]
)
@pytest.mark.parametrize("step", STEPS)
async def test_a_start_that_fails_is_repeated_without_a_tight_loop(
    step: str, error: Exception, made: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_arguments: object) -> Never:
        raise error

    supervisor = made(CONTROL)
    monkeypatch.setattr(module, "ChildProcess", lambda *_arguments: None)
    monkeypatch.setattr(*STEPS[step], fails)
    (slot,), loop = supervisor.slots, asyncio.get_running_loop()
    for delay in (0.0, 0.2, 0.5, 1.0, 1.0):
        supervisor.start(slot)
        assert slot.due is not None
        assert slot.due.when() == loop.time() + delay
        slot.due.cancel()


async def test_a_control_that_asks_for_too_much_at_once_is_replaced(made: Make) -> None:
    supervisor, control, asked = made(CONTROL), MemoryChild(), 0
    while not control.is_killed and asked < 10_000:
        supervisor.control_said(control.handle, RouteWanted(f"10.0.0.{asked}"), ())
        asked += 1
    assert control.is_killed
    assert 1000 < asked < 5000
    await supervisor.end()


async def test_a_slow_start_is_waited_for_and_reported(made: Make) -> None:
    supervisor = made(CONTROL)
    slow = child_in(supervisor.slots[0], supervisor)
    with capture_logs() as said:
        waiting = asyncio.create_task(supervisor.until_ready())
        await asyncio.sleep(200)
        assert supervisor.failure is None
        slow.stalled = 1000.0
        await waiting
    assert said[-1] == {
        "event": "still starting", "waits_for": "control", "seconds": 190, "log_level": "info",
    }  # fmt: skip
    assert "still waiting for control" in str(supervisor.failure)


async def test_control_may_have_only_a_process_on_demand_killed(made: Make) -> None:
    supervisor = made(ROSMASTER)
    master = child_in(supervisor.slots[0], supervisor)
    supervisor.control_said(MemoryChild().handle, ProcessOverdue("rosmaster", 0), ())
    assert not master.is_killed


async def test_control_may_only_call_a_node_silent_that_the_supervisor_cannot_ask(made: Make) -> None:
    supervisor = made(*(role for role in ROLES if not role.indexed))
    children = {slot.role.name: child_in(slot, supervisor) for slot in supervisor.slots}
    for name in children:
        supervisor.control_said(MemoryChild().handle, NodeSilent(name), ())
    assert [name for name, child in children.items() if child.is_killed] == ["rosout"]
    assert children["rosout"].handle.reason == "the supervisor killed it, because it did not answer"


@pytest.mark.parametrize("wanted", [False, True])
async def test_the_slot_of_an_overdue_process_is_free_for_the_next_one(
    made: Make, monkeypatch: pytest.MonkeyPatch, wanted: bool
) -> None:
    role = Role(
        name="door", user="rosrv-doors", part="doors", entry="m:f", indexed=True, most=2, on_demand=True
    )
    supervisor = made(role)
    filled: list[int] = []
    monkeypatch.setattr(supervisor, "start", lambda slot: filled.append(slot.index))
    doors = [child_in(slot, supervisor) for slot in supervisor.slots]
    control = MemoryChild().handle
    if wanted:
        supervisor.control_said(control, ProcessWanted("door", 1), ())
    supervisor.control_said(control, ProcessOverdue("door", 1), ())
    assert [door.is_killed for door in doors] == [False, True]
    doors[1].end(-9)
    assert supervisor.slots[1].is_free and filled == [1] * wanted
    doors[0].end(-9)
    assert supervisor.slots[0].due is not None  # control did not ask for this end
    supervisor.slots[0].due.cancel()


@pytest.mark.parametrize("wanted", [False, True])
async def test_a_process_on_demand_may_end(made: Make, monkeypatch: pytest.MonkeyPatch, wanted: bool) -> None:
    role = Role(name="compiler", user="rosrv-compiler", part="compiler", entry="m:f", on_demand=True)
    supervisor = made(role)
    [slot] = supervisor.slots
    filled: list[int] = []
    monkeypatch.setattr(supervisor, "start", lambda slot: filled.append(slot.starts))
    control = MemoryChild().handle
    supervisor.control_said(control, CompilerWanted(), ())
    assert filled == [0]
    compiler, slot.starts = child_in(slot, supervisor), 1
    if wanted:
        supervisor.control_said(control, CompilerWanted(), ())
    compiler.end(0)
    assert filled == [0] + [0] * wanted
    assert slot.is_free
    assert slot.starts == 0
    compiler, slot.starts = child_in(slot, supervisor), 1
    compiler.end(-9)
    assert slot.due is not None  # each death is followed by a new start
    slot.due.cancel()


@pytest.mark.parametrize(("end", "failed"), [("order", False), ("failure", True), ("defect", True)], ids=str)
async def test_the_processes_learn_whether_the_appliance_is_stopped_by_order(
    made: Make, monkeypatch: pytest.MonkeyPatch, end: str, failed: bool
) -> None:
    """Only then the pusher reports to the collector that the robot is switched off."""
    found: list[bool] = []

    async def end_all(*_processes: object, failed: bool) -> None:
        found.append(failed)

    monkeypatch.setattr(module, "end_all", end_all)
    supervisor = made(CONTROL)
    if end != "defect":
        supervisor.stop("no master" if end == "failure" else None)
    await supervisor.end()
    assert found == [failed]


async def test_control_gets_each_unexpected_end_once_while_it_serves(made: Make) -> None:
    supervisor = made(ROSMASTER, CONTROL)
    supervisor.is_ready = True
    master, control = supervisor.slots

    def begin(slot: ProcessSlot) -> MemoryChild:
        slot.starts += 1
        return child_in(slot, supervisor)

    def deaths_told(process: MemoryChild) -> list[ProcessDied]:
        return [message for message in process.told if isinstance(message, ProcessDied)]

    ready = Ready(msgspec.to_builtins(READY))
    first, failed = begin(control), begin(master)
    failed.end(1)
    assert deaths_told(first) == []
    supervisor.reports.received(first.handle, ready, ())
    [death] = deaths_told(first)
    assert (death.role, death.end, death.reason) == (
        "rosmaster",
        "exit status 1",
        "it ended with exit status 1",
    )
    supervisor.reports.violated(first.handle, "sent Stop, which it may not send")
    first.end(-9)
    second = begin(control)
    supervisor.reports.received(second.handle, ready, ())
    [death] = deaths_told(second)
    assert (death.role, death.end, death.restarts) == ("control", "signal SIGKILL", 0)
    assert death.reason == "the supervisor killed it, because it sent Stop, which it may not send"
    for _time in range(2 * FAILING_AFTER):
        begin(master).end(-9)
    assert (
        len(deaths_told(second)) == FAILING_AFTER
    )  # with the first one; `process failing` covers the others
    for slot in supervisor.slots:
        slot.process = None
    await supervisor.end()


@pytest.mark.parametrize(
    ("ready", "agreed", "holds", "printed"),
    [
        (False, False, False, False),
        (False, False, True, True),
        (True, True, False, False),
        (True, True, True, True),
        (True, False, False, True),
        (True, False, True, True),
    ],
)
async def test_an_ordered_end_that_does_not_give_a_graph_back_prints_the_command(
    made: Make, monkeypatch: pytest.MonkeyPatch, *, ready: bool, agreed: bool, holds: bool, printed: bool
) -> None:
    monkeypatch.setattr(NoMachineWork, "takes_over", lambda _work: True)
    monkeypatch.setattr(NoMachineWork, "holds", lambda _work: holds)
    supervisor, control = made(CONTROL), MemoryChild()
    supervisor.is_ready = ready
    if agreed:
        supervisor.control_said(control.handle, EndAgreed(), ())
    with capture_logs() as logs:
        await supervisor._announce_end()
    assert any("sudo rosrv release --dead" in line["event"] for line in logs) is printed
