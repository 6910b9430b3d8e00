from pathlib import Path

import pytest

from appliance.supervisor.process_handle import ProcessHandle
from appliance.supervisor.process_slot import FAILING_AFTER, ProcessSlot
from appliance.supervisor.role import Facts, Role
from tests.support.memory_child import MemoryChild

pytestmark = pytest.mark.anyio


def process(*, lived: float) -> ProcessHandle:
    process = MemoryChild().handle
    process.started -= lived
    return process


@pytest.fixture
def slot() -> ProcessSlot:
    return ProcessSlot(Role(name="relay", user="rosrv-relay", part="relay", entry="m:f", indexed=True), 1)


async def test_restarts_of_a_dying_process_wait_up_to_a_second(slot: ProcessSlot) -> None:
    delays = []
    for _ in range(FAILING_AFTER):
        assert not slot.is_failing
        slot.record_death(process(lived=0.1))
        delays.append(slot.delay())
    assert delays == [0.0, 0.2, 0.5, 1.0, 1.0]
    assert slot.is_failing


async def test_restarts_of_an_optional_process_wait_up_to_a_minute() -> None:
    slot = ProcessSlot(
        Role(name="charon", user="rosrv-ipsec", part="ipsec", entry="m:f", dispensable=True), 0
    )
    delays = []
    for _ in range(14):
        slot.record_death(process(lived=0.1))
        delays.append(slot.delay())
    assert delays[FAILING_AFTER - 1 :] == [2.0, 4.0, 8.0, 16.0, 32.0, *[60.0] * 5]
    slot.reason = "it has no device"
    for lived, lasts in ((1.0, False), (60.0, True), (60.0, False)):
        slot.process = process(lived=lived)
        assert slot.recovers() == lasts
    assert (slot.short_runs, slot.reason) == (0, "")


async def test_a_process_that_ran_long_is_restarted_at_once(slot: ProcessSlot) -> None:
    for _ in range(FAILING_AFTER):
        slot.record_death(process(lived=0.1))
    assert slot.record_death(process(lived=60)) == pytest.approx(60, abs=5)
    assert slot.delay() == 0.0
    assert not slot.is_failing


def test_a_plan_has_the_number_of_an_indexed_role_only(slot: ProcessSlot) -> None:
    facts = Facts(state=Path("/state"), config=Path("/state/run/config.json"), rosmaster_port=1)
    assert slot.plan(facts, 3, None).index == 1
    alone = ProcessSlot(Role(name="signer", user="rosrv-signer", part="signer", entry="m:f"), 0)
    assert alone.plan(facts, 3, None).index is None
    assert alone.plan(facts, 3, None).home == "/state/signer"
