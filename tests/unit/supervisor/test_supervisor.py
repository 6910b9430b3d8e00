import asyncio
import errno
import signal
import socket
from collections.abc import Callable
from pathlib import Path
from typing import cast

import msgspec
import pytest
from structlog.testing import capture_logs

from appliance.base import clock
from appliance.channel.messages import (
    CompilerWanted,
    ProcessDied,
    ProcessOverdue,
    ProcessWanted,
    Ready,
    RouteWanted,
)
from appliance.supervisor import supervisor as module
from appliance.supervisor.errors import StartError
from appliance.supervisor.process_handle import ProcessHandle
from appliance.supervisor.process_slot import FAILING_AFTER, ProcessSlot
from appliance.supervisor.role import Facts, Role
from appliance.supervisor.supervisor import ControlReady, Supervisor

pytestmark = [pytest.mark.anyio, pytest.mark.nightly]

READY = ControlReady("http://127.0.0.1:11311", 1, "http://127.0.0.1:2", 3, 4, "secret")
CONTROL = Role(name="control", user="rosrv", part="control", entry="m:f")
ROSMASTER = Role(name="rosmaster", user="rosmaster", part="rosmaster", entry="m:f", asks=True)


class StandIn:
    alive = True
    role = "control"

    def __init__(self) -> None:
        self.heard_of = 0
        self.told: list[str] = []
        self.deaths: list[ProcessDied] = []
        self.killed = False
        self.signals: list[signal.Signals] = []
        self.pid = 1
        self.started = 0.0
        self.sandbox_state = "", list[str]()
        self.congestion = ""
        self.since = ""
        self.reason = ""
        self.output: tuple[str, ...] = ()
        self.ready = False
        self.stalled_seconds = 0.0

    def kill(self, number: signal.Signals = signal.SIGKILL) -> None:
        self.killed = number is signal.SIGKILL
        self.signals.append(number)

    def discount_pause(self, _seconds: float) -> None: ...

    def send(self, message: object, _descriptors: tuple[int, ...] = ()) -> None:
        self.told.append(type(message).__name__)
        if isinstance(message, ProcessDied):
            self.deaths.append(message)

    def note_answer(self) -> None:
        self.heard_of += 1


def handle(process: StandIn) -> ProcessHandle:
    return cast(ProcessHandle, process)


def made(
    tmp_path: Path, *roles: Role, ready: Callable[[ControlReady], None] = lambda _said: None
) -> Supervisor:
    admin = socket.create_server(("127.0.0.1", 0))
    facts = Facts(state=tmp_path, config=tmp_path / "config.json", rosmaster_port=1)
    return Supervisor(roles, facts, admin=admin, ready=ready)


async def test_a_master_that_dies_during_a_check_is_checked_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    supervisor = made(tmp_path, ROSMASTER)
    slot = supervisor.slots[0]
    first, second = StandIn(), StandIn()
    asked = asyncio.Event()

    async def answers(_seconds: float) -> bool:
        if not asked.is_set():
            slot.process = None  # the process died during the check
            asked.set()
        return True

    monkeypatch.setattr(supervisor, "answers", answers)
    slot.process = handle(first)
    waiting = asyncio.create_task(supervisor.until_answering(slot))
    async with asyncio.timeout(20):
        await asked.wait()
        slot.process = handle(second)
        await waiting
    assert (first.heard_of, second.heard_of) == (0, 1)


async def test_a_first_token_that_cannot_be_saved_ends_the_start(tmp_path: Path) -> None:
    """Control gets no confirmation, so the next start creates another token; no ready line is printed."""

    def ready(_said: ControlReady) -> None:
        raise StartError("the first access token cannot be written")

    supervisor, control = made(tmp_path, CONTROL, ready=ready), StandIn()
    await supervisor.control_ready(handle(control), READY)
    assert supervisor.failure == "the first access token cannot be written"
    assert not supervisor.is_ready
    assert "Announced" not in control.told


async def test_a_machine_without_processes_causes_no_tight_loop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def none_left(*_arguments: object) -> ProcessHandle:
        raise OSError(errno.EAGAIN, "no process can be made")

    supervisor = made(tmp_path, CONTROL)
    monkeypatch.setattr(module, "ProcessHandle", none_left)
    (slot,), loop = supervisor.slots, asyncio.get_running_loop()
    for delay in (0.0, 0.2, 0.5, 1.0, 1.0):
        before = loop.time()
        supervisor.start(slot)
        assert slot.due is not None
        assert before + delay <= slot.due.when() <= loop.time() + delay
        slot.due.cancel()


def test_a_control_that_asks_for_too_much_at_once_is_replaced(tmp_path: Path) -> None:
    async def scene() -> tuple[StandIn, int]:
        supervisor, control = made(tmp_path, CONTROL), StandIn()
        for number in range(10_000):
            supervisor.control_said(handle(control), RouteWanted(f"10.0.0.{number}"), ())
            if control.killed:
                return control, number
        return control, -1

    control, asked = asyncio.run(scene())
    assert control.killed
    assert 1000 < asked < 5000


async def test_a_slow_start_is_waited_for_and_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_START_SECONDS", 0.0)
    monkeypatch.setattr(module, "_LOOK_SECONDS", 0.01)
    supervisor, slow, reasons = made(tmp_path, CONTROL), StandIn(), list[str]()
    supervisor.slots[0].process = handle(slow)

    def stop(reason: str) -> None:
        reasons.append(reason)
        supervisor.stopping.set()

    monkeypatch.setattr(supervisor, "stop", stop)
    with capture_logs() as said:
        waiting = asyncio.create_task(supervisor.until_ready())
        async with asyncio.timeout(20):
            while len(said) < 2:
                await asyncio.sleep(0)
            assert reasons == []
            slow.stalled_seconds = 1000.0
            await waiting
    assert {**said[0], "seconds": 0} == {
        "event": "still starting", "waits_for": "control", "seconds": 0, "log_level": "info",
    }  # fmt: skip
    (reason,) = reasons
    assert "still waiting for control" in reason


def test_control_may_have_only_a_process_on_demand_killed(tmp_path: Path) -> None:
    supervisor = made(tmp_path, ROSMASTER)
    [slot] = supervisor.slots
    master = StandIn()
    slot.process = handle(master)
    supervisor.control_said(handle(StandIn()), ProcessOverdue("rosmaster", 0), ())
    assert not master.killed
    supervisor.kept.close()


@pytest.mark.parametrize("wanted", [False, True])
async def test_the_slot_of_an_overdue_process_is_free_for_the_next_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wanted: bool
) -> None:
    role = Role(
        name="door", user="rosrv-doors", part="doors", entry="m:f", indexed=True, most=2, on_demand=True
    )
    supervisor = made(tmp_path, role)
    filled: list[int] = []
    monkeypatch.setattr(supervisor, "start", lambda slot: filled.append(slot.index))
    processes = [StandIn(), StandIn()]
    for slot, process in zip(supervisor.slots, processes, strict=True):
        slot.process = handle(process)
    control = handle(StandIn())
    if wanted:
        supervisor.control_said(control, ProcessWanted("door", 1), ())
    supervisor.control_said(control, ProcessOverdue("door", 1), ())
    assert [process.killed for process in processes] == [False, True]
    supervisor.died(handle(processes[1]), -9)
    assert supervisor.slots[1].is_free and filled == [1] * wanted
    supervisor.died(handle(processes[0]), -9)
    assert supervisor.slots[0].due is not None  # control did not ask for this end
    supervisor.slots[0].due.cancel()
    supervisor.kept.close()


@pytest.mark.parametrize("wanted", [False, True])
def test_a_process_on_demand_may_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wanted: bool) -> None:
    role = Role(name="compiler", user="rosrv-compiler", part="compiler", entry="m:f", on_demand=True)
    asyncio.run(_end_by_themselves(made(tmp_path, role), monkeypatch, wanted))


async def _end_by_themselves(supervisor: Supervisor, monkeypatch: pytest.MonkeyPatch, wanted: bool) -> None:
    [slot] = supervisor.slots
    filled: list[int] = []
    monkeypatch.setattr(supervisor, "start", lambda slot: filled.append(slot.starts))
    control = handle(StandIn())
    supervisor.control_said(control, CompilerWanted(), ())
    assert filled == [0]
    slot.process, slot.starts = handle(StandIn()), 1
    slot.process.started = 0.0
    if wanted:
        supervisor.control_said(control, CompilerWanted(), ())
    supervisor.died(slot.process, 0)
    assert filled == [0] + [0] * wanted
    assert slot.is_free
    assert slot.starts == 0
    slot.process, slot.starts = handle(StandIn()), 1
    slot.process.started = 0.0
    supervisor.died(slot.process, -9)
    assert slot.due is not None  # each death is followed by a new start
    slot.due.cancel()
    supervisor.kept.close()


@pytest.mark.parametrize(("end", "failed"), [("order", False), ("failure", True), ("defect", True)], ids=str)
async def test_the_processes_learn_whether_the_appliance_is_stopped_by_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, end: str, failed: bool
) -> None:
    """Only then the pusher reports to the collector that the robot is switched off."""
    found: list[bool] = []

    async def end_all(*_processes: object, failed: bool) -> None:
        found.append(failed)

    monkeypatch.setattr(module, "end_all", end_all)
    supervisor = made(tmp_path, CONTROL)
    if end != "defect":
        supervisor.stop("no master" if end == "failure" else None)
    await supervisor.end()
    assert found == [failed]


async def test_control_gets_each_unexpected_end_once_while_it_serves(tmp_path: Path) -> None:
    supervisor = made(tmp_path, ROSMASTER, CONTROL)
    supervisor.is_ready = True
    master, control = supervisor.slots

    def begin(slot: ProcessSlot) -> StandIn:
        process = StandIn()
        process.role, process.started = slot.role.name, clock.now()
        slot.process, slot.starts = handle(process), slot.starts + 1
        return process

    def die(process: StandIn, code: int = -9) -> None:
        supervisor.died(handle(process), code)

    def serves(process: StandIn) -> None:
        ready = Ready(msgspec.to_builtins(READY))
        supervisor.reports.received(handle(process), ready, ())

    first, failed = begin(control), begin(master)
    die(failed, 1)
    assert first.deaths == []
    serves(first)
    [death] = first.deaths
    assert (death.role, death.end, death.reason) == (
        "rosmaster",
        "exit status 1",
        "it ended with exit status 1",
    )
    supervisor.reports.violated(handle(first), "sent Stop, which it may not send")
    die(first)
    second = begin(control)
    serves(second)
    [death] = second.deaths
    assert (death.role, death.end, death.restarts) == ("control", "signal SIGKILL", 0)
    assert death.reason == "the supervisor killed it, because it sent Stop, which it may not send"
    for _time in range(2 * FAILING_AFTER):
        die(begin(master))
    assert len(second.deaths) == FAILING_AFTER  # with the first one; `process failing` covers the others
    for slot in supervisor.slots:
        slot.process = None
    await supervisor.end()
    supervisor.kept.close()
