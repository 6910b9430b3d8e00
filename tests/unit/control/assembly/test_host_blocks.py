from pathlib import Path

import pytest

from appliance.base.age_clock import AgeClock
from appliance.control.assembly.host_blocks import BlockTable
from appliance.policy.model import address_of
from appliance.store.state_file import StateStore
from tests.support.aging import DAY, HISTORIES, HOUR, Machine
from tests.support.engines import InlineDatabase

HOST = address_of("10.0.0.66")
SECONDS = 2 * 24 * 3600.0


class Block:
    def __init__(self, folder: Path, age: AgeClock) -> None:
        store = StateStore(folder, failed=pytest.fail, kind=InlineDatabase)
        self.table = BlockTable(store, age, age.dated)

    def make(self) -> None:
        self.table.read_clock()
        self.table.put(HOST, seconds=SECONDS, who="ann", note="")

    def is_due(self) -> bool:
        self.table.read_clock()
        return self.table.due() == [HOST]


@pytest.mark.parametrize("history", HISTORIES)
def test_a_block_has_its_time_in_the_same_run_whatever_the_clock_does(tmp_path: Path, history: str) -> None:
    machine = Machine(tmp_path, Block)
    for step in HISTORIES[history]:
        machine.take(step)
    machine.keeper.make()
    made, machine.wrong = machine.true, 0
    while not machine.keeper.is_due() and machine.true < made + 9 * DAY:
        machine.take(("run", 2 * HOUR))
    assert abs(machine.true - made - 2 * DAY) <= 4 * HOUR


def test_a_block_of_the_first_day_after_a_long_rest_has_its_time(tmp_path: Path) -> None:
    machine = Machine(tmp_path, Block)
    machine.take(("off", 90 * DAY))
    machine.take(("run", 8 * HOUR))
    machine.keeper.make()
    made = machine.true
    while not machine.keeper.is_due():
        machine.take(("run", HOUR))
    assert abs(machine.true - made - 2 * DAY) <= 2 * HOUR
