import asyncio

import pytest

from appliance.channel.messages import Stop
from appliance.supervisor import shutdown
from appliance.supervisor.process_handle import ProcessCallbacks, ProcessHandle
from appliance.supervisor.process_slot import ProcessSlot
from appliance.supervisor.role import Role
from tests.support.memory_child import MemoryChild

pytestmark = pytest.mark.anyio


class Crowd:
    """Processes that end by the message or signal that each of them is given, and the order of what came."""

    def __init__(self) -> None:
        self.slots: list[ProcessSlot] = []
        self.died = asyncio.Event()
        self.done: list[tuple[str, str]] = []

    def add(self, name: str, ends_by: str, *, is_program: bool = False, last: bool = False) -> MemoryChild:
        slot = ProcessSlot(Role(name=name, user="rosrv", part=name, outlives_control=last), 0)

        def died(process: ProcessHandle, _code: int) -> None:
            slot.record_death(process)
            self.died.set()

        reports = ProcessCallbacks(lambda *_: None, lambda *_: None, died)
        child = MemoryChild(
            name, reports, is_program=is_program, ends_by=ends_by,
            hears=lambda what: self.done.append((name, what)),
        )  # fmt: skip
        slot.process = child.handle
        self.slots.append(slot)
        return child

    async def end(self, *, failed: bool = False) -> list[tuple[str, str]]:
        await shutdown.end_all(self.slots, self.died, failed=failed)
        return self.done


@pytest.fixture
def crowd() -> Crowd:
    return Crowd()


async def test_each_is_asked_first_and_rosmaster_last(crowd: Crowd) -> None:
    """Our processes get a message, and programs SIGTERM. Processes that must outlive control come last."""
    crowd.add("rosmaster", "SIGTERM", is_program=True, last=True)
    crowd.add("control", "Stop")
    crowd.add("rosout", "SIGTERM", is_program=True)
    *earlier, latest = await crowd.end()
    assert sorted(earlier) == [("control", "Stop"), ("rosout", "SIGTERM")]
    assert latest == ("rosmaster", "SIGTERM")


async def test_a_process_that_does_not_end_is_killed(crowd: Crowd) -> None:
    crowd.add("relay", "SIGKILL")
    crowd.add("api", "SIGTERM")
    crowd.add("control", "Stop")
    assert await crowd.end() == [
        *((name, "Stop") for name in ("relay", "api", "control")),
        *((name, "SIGTERM") for name in ("relay", "api")),
        ("relay", "SIGKILL"),
    ]
    assert all(slot.process is None for slot in crowd.slots)


async def test_an_unkillable_process_does_not_delay_the_end(crowd: Crowd) -> None:
    crowd.add("control", "never")
    crowd.add("rosmaster", "Stop", last=True)
    done = await crowd.end()
    assert ("control", "SIGKILL") in done
    assert done.index(("rosmaster", "Stop")) > done.index(("control", "SIGKILL"))


async def test_each_process_learns_of_a_failure(crowd: Crowd) -> None:
    fleet = crowd.add("fleet", "Stop")
    await crowd.end(failed=True)
    assert fleet.told == [Stop(failed=True)]


async def test_a_pending_restart_is_cancelled(crowd: Crowd) -> None:
    crowd.add("relay", "Stop")
    slot = crowd.slots[0]
    slot.process = None
    slot.due = asyncio.get_running_loop().call_later(60, lambda: None)
    await crowd.end()
    assert slot.due.cancelled()
