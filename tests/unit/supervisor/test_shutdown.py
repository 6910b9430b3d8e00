import asyncio
import signal
from typing import cast

import pytest

from appliance.channel.messages import Stop
from appliance.supervisor import shutdown
from appliance.supervisor.process_handle import ProcessHandle
from appliance.supervisor.process_slot import ProcessSlot
from appliance.supervisor.role import Role
from tests.support import autojump

pytestmark = pytest.mark.anyio


class Crowd:
    def __init__(self) -> None:
        self.slots: list[ProcessSlot] = []
        self.died = asyncio.Event()
        self.done: list[tuple[str, str]] = []
        self.messages: list[object] = []

    def add(self, name: str, ends_by: str, *, is_program: bool = False, last: bool = False) -> None:
        role = Role(name=name, user="rosrv", part=name, outlives_control=last)
        slot = ProcessSlot(role, 0)
        slot.process = cast(ProcessHandle, Process(self, slot, ends_by, is_program=is_program))
        self.slots.append(slot)

    def end(self) -> list[tuple[str, str]]:
        autojump.run(shutdown.end_all(self.slots, self.died))
        return self.done


class Process:
    pid = 1

    def __init__(self, crowd: Crowd, slot: ProcessSlot, ends_by: str, *, is_program: bool) -> None:
        self.crowd, self.slot, self.ends_by, self.is_program = crowd, slot, ends_by, is_program

    def send(self, message: object) -> None:
        self.crowd.messages.append(message)
        self._suffer(type(message).__name__)

    def kill(self, number: signal.Signals = signal.SIGKILL) -> None:
        self._suffer(number.name)

    def _suffer(self, what: str) -> None:
        self.crowd.done.append((self.slot.role.name, what))
        if what == self.ends_by:
            self.slot.process = None
            self.crowd.died.set()


@pytest.fixture
def crowd(monkeypatch: pytest.MonkeyPatch) -> Crowd:
    for name in ("_STOP_SECONDS", "_TERMINATE_SECONDS", "_LAST_SECONDS"):
        monkeypatch.setattr(shutdown, name, 0.05)
    return Crowd()


def test_each_is_asked_first_and_rosmaster_last(crowd: Crowd) -> None:
    """Our processes get a message, and programs SIGTERM. Processes that must outlive control come last."""
    crowd.add("rosmaster", "SIGTERM", is_program=True, last=True)
    crowd.add("control", "Stop")
    crowd.add("rosout", "SIGTERM", is_program=True)
    assert crowd.end() == [("control", "Stop"), ("rosout", "SIGTERM"), ("rosmaster", "SIGTERM")]


def test_a_process_that_does_not_end_is_killed(crowd: Crowd) -> None:
    crowd.add("relay", "SIGKILL")
    crowd.add("api", "SIGTERM")
    crowd.add("control", "Stop")
    assert crowd.end() == [
        *((name, "Stop") for name in ("relay", "api", "control")),
        *((name, "SIGTERM") for name in ("relay", "api")),
        ("relay", "SIGKILL"),
    ]
    assert all(slot.process is None for slot in crowd.slots)


def test_an_unkillable_process_does_not_delay_the_end(crowd: Crowd) -> None:
    crowd.add("control", "never")
    crowd.add("rosmaster", "Stop", last=True)
    done = crowd.end()
    assert ("control", "SIGKILL") in done
    assert done.index(("rosmaster", "Stop")) > done.index(("control", "SIGKILL"))


def test_each_process_learns_of_a_failure(crowd: Crowd) -> None:
    crowd.add("fleet", "Stop")
    autojump.run(shutdown.end_all(crowd.slots, crowd.died, failed=True))
    assert crowd.messages == [Stop(failed=True)]


async def test_a_pending_restart_is_cancelled(crowd: Crowd) -> None:
    crowd.add("relay", "Stop")
    slot = crowd.slots[0]
    slot.process = None
    slot.due = asyncio.get_running_loop().call_later(60, lambda: None)
    await shutdown.end_all(crowd.slots, crowd.died)
    assert slot.due.cancelled()
