"""Control's side of the processes of doors."""

from types import SimpleNamespace
from typing import Any, cast

import pytest

from appliance.channel import messages
from appliance.control.assembly.foundation import Foundation
from appliance.features.doors import door_link, door_processes
from appliance.features.doors.control_part import DoorOrders
from appliance.features.doors.door_processes import DoorProcesses
from appliance.features.doors.door_table import DoorTable
from appliance.features.doors.settings import Doors
from appliance.store.door_tables import DoorRow

ALICE = DoorRow("alice", "198.19.240.2", 1.0, None, 0, None, "")
NEW = door_link.DoorStarted("", 0.0, False, [])


class Bench:
    """The processes, with the messages that they get and the records that they cause."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.sent: list[Any] = []
        self.asked: list[Any] = []
        self.records: list[str] = []
        self.made: list[int] = []
        settings = SimpleNamespace(
            of=lambda _kind: Doors(),
            listen_address=("0.0.0.0", 11311),
            api_address=None,
        )
        base = SimpleNamespace(
            settings=settings,
            port=lambda _name: 11311,
            policies=SimpleNamespace(current=SimpleNamespace(ports=range(19001, 20001))),
            lifeline=SimpleNamespace(say=self.asked.append),
            trail=SimpleNamespace(happened=lambda event, *_words, **_more: self.records.append(event)),
        )
        self.rows = [ALICE]
        table = SimpleNamespace(
            problem="",
            live=lambda: self.rows,
            in_slot=lambda number: next((row for row in self.rows if row.slot == number), None),
        )
        monkeypatch.setattr(door_processes, "Link", self._link)
        self.definitions: dict[str, str] = {}
        self.processes = DoorProcesses(
            cast(Foundation, base), cast(DoorTable, table), lambda: self.definitions
        )
        self.link = cast(Any, self.processes.links()["door"][0])
        monkeypatch.setattr(self.processes, "_given", self._given)

    def _link(self, heard: Any, lost: Any) -> SimpleNamespace:
        return SimpleNamespace(heard=heard, lost=lost, send=self._send, channel=object())

    def _send(self, message: Any, *_rest: Any, **_more: Any) -> bool:
        self.sent.append(message)
        return True

    async def _given(self, _slot: Any, row: DoorRow, _request: int, port: int) -> None:
        assert row == ALICE
        self.made.append(port)

    def hears(self, message: messages.Message) -> None:
        """Receive a message of the process."""
        self.link.heard(message)


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(monkeypatch)


@pytest.mark.anyio
async def test_a_door_gets_only_sockets_to_the_appliance_with_its_own_address(bench: Bench) -> None:
    """RVMaster's port and the ports of the policy's range, and no other port of the machine."""
    for number, port in enumerate((11311, 19001, 20000, 0, 11312, 8443, 22, 20001, -1, 1 << 20)):
        bench.hears(door_link.SocketWanted(number, port))
    assert [one.number for one in bench.sent] == [4, 5, 6, 7, 8, 9]
    assert {one.reason for one in bench.sent} == {"doors do not connect to this port"}


@pytest.mark.anyio
async def test_a_door_that_asks_for_many_sockets_at_once_waits(bench: Bench) -> None:
    for number in range(70):
        bench.hears(door_link.SocketWanted(number, 11311))
    assert [one.number for one in bench.sent] == [*range(64, 70)]


def test_the_process_of_a_removed_or_replaced_door_ends(bench: Bench) -> None:
    """It ends when it links up again, and another one starts for the new door of the slot, also of the same name."""
    bench.hears(NEW)
    assert [type(one) for one in bench.sent] == [door_link.DoorGiven]
    for name, added in (("bob", 1.0), ("alice", 0.5)):
        bench.hears(door_link.DoorStarted(name, added, True, []))
        assert type(bench.sent[-1]) is door_link.DoorEnded
        assert bench.asked.pop() == messages.ProcessWanted("door", 0)
    bench.rows.clear()
    bench.hears(door_link.SocketWanted(1, 11311))
    assert type(bench.sent[-1]) is door_link.DoorEnded


def test_the_connections_of_a_ticket_end_although_control_was_restarted(bench: Bench) -> None:
    """The process outlives control, and names the tickets with which earlier controls passed connections on."""
    bench.hears(door_link.DoorStarted("alice", 1.0, False, ["earlier", "valid"]))
    assert bench.processes.pass_on(ALICE, 0, "10.0.0.9", "new")
    assert bench.processes.tickets(ALICE) == {"earlier", "valid", "new"}
    tickets = SimpleNamespace(ended=lambda ticket: ticket != "valid")
    table = SimpleNamespace(live=lambda: bench.rows)
    orders = DoorOrders(*cast(Any, (None, None, table, tickets, bench.processes)))
    orders.end_tickets()
    ended = {one.ticket for one in bench.sent if isinstance(one, door_link.TicketEnded)}
    assert ended == {"earlier", "new"}
    assert bench.processes.tickets(ALICE) == {"valid"}


def test_the_death_of_a_process_is_recorded(bench: Bench) -> None:
    """Not that of a door which was removed."""
    bench.hears(NEW)
    bench.link.lost("")
    assert bench.records == ["door failed"]
    bench.rows.clear()
    bench.link.lost("")
    assert bench.records == ["door failed"]


def test_a_process_gets_the_definitions_in_force_before_its_door_and_each_change_once(bench: Bench) -> None:
    bench.definitions = {"own/Add.srv": "---"}
    bench.processes.define()
    bench.hears(door_link.DoorStarted("", None))
    bench.processes.define()
    bench.definitions = {}
    bench.processes.define()
    assert [getattr(one, "definitions", None) for one in bench.sent] == [{"own/Add.srv": "---"}, None, {}]
