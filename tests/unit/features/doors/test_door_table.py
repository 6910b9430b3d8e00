from pathlib import Path

import pytest

from appliance.base import clock
from appliance.control.errors import SenselessError, UnknownThingError
from appliance.features.doors.door_table import DoorTable, DoorTables, TicketRow
from appliance.features.doors.door_visits import DoorTickets, left_by_its_maker, new_ticket
from appliance.features.doors.settings import MAX_DOORS, Doors
from appliance.store.state_file import EndRow, StateStore
from tests.support.ends import ends_of
from tests.support.engines import InlineDatabase
from tests.support.virtual_clock import VirtualClock

WALL = 1_790_000_000.0


def opened(home: Path) -> StateStore:
    return StateStore(home, failed=pytest.fail, kind=InlineDatabase)


def test_a_name_keeps_its_address_and_no_other_name_gets_it(tmp_path: Path) -> None:
    store = opened(tmp_path)
    table = DoorTable(store, Doors())
    for name in ("alice", "bob"):
        table.save(table.plan(name, None, ""))
    alice = table.of("alice")
    table.remove("alice")
    table.closed = ""
    assert [*table.addresses()] == ["door:bob"]
    again = DoorTable(store, Doors())
    new = again.plan("carol", 9091, "10.0.0.7")
    assert new.address not in {alice.address, again.of("bob").address, Doors().gateway}
    assert new.slot == alice.slot
    assert again.plan("alice", None, "").address == alice.address
    assert not again.addresses()  # until the firewall reserves the network
    again.closed = ""
    assert [*again.addresses()] == ["door:bob"]
    moved = DoorTable(store, Doors(network="10.9.0.0/24"))
    moved.closed = ""
    assert "door bob has the address" in moved.problem
    assert not moved.addresses()
    with pytest.raises(SenselessError, match="keeps its earlier address"):
        moved.plan("alice", None, "")
    moved.remove("bob")
    assert moved.problem == ""


@pytest.mark.parametrize(
    ("name", "port", "source", "words"),
    [
        ("Alice", None, "", "not a name"),
        ("a" * 32, None, "", "not a name"),
        ("agent-1", None, "", "already"),
        ("agent_1", None, "", "only in - and _"),
        ("bob", 9091, "", "port of the door agent-1"),
        ("bob", None, "10.0.0.7", "needs --port"),
        ("bob", 9092, "10.0.0.0/33", "not an address or network"),
    ],
)
def test_a_door_that_would_confuse_is_refused(
    tmp_path: Path, name: str, port: int | None, source: str, words: str
) -> None:
    table = DoorTable(opened(tmp_path), Doors())
    table.save(table.plan("agent-1", 9091, ""))
    with pytest.raises(SenselessError, match=words):
        table.plan(name, port, source)
    with pytest.raises(UnknownThingError, match="agent-1"):
        table.of(name if name != "agent-1" else "nobody")


def test_doors_are_bounded(tmp_path: Path) -> None:
    table = DoorTable(opened(tmp_path), Doors())
    for number in range(MAX_DOORS):
        table.save(table.plan(f"d{number}", None, ""))
    assert sorted(row.slot or 0 for row in table.live()) == [*range(MAX_DOORS)]
    with pytest.raises(SenselessError, match="limit"):
        table.plan("more", None, "")


def test_a_ticket_opens_one_door_until_its_end(tmp_path: Path) -> None:
    machine = VirtualClock(wall=WALL)
    with clock.using(machine):
        store = opened(tmp_path)
        tickets = DoorTickets(store, ends_of(store, tmp_path))
        row, text = tickets.make("alice", 3600.0, "first")
        assert tickets.find("alice", text) == row
        other = text[:-1] + ("A" if text[-1] != "A" else "B")
        wrong = (other, row.id, "", text + "A", text.replace(".", "_"))
        assert [tickets.find("alice", one) for one in wrong] == [None] * len(wrong)
        assert tickets.find("bob", text) is None
        assert text.partition(".")[2].encode() not in (tmp_path / "state.db").read_bytes()
        machine.advance(3601.0)
        assert tickets.find("alice", text) is None
        assert tickets.valid() == []
        assert DoorTables(store.database).tickets() == [] and store.ends() == []


def test_a_ticket_of_an_earlier_version_opens_its_door(tmp_path: Path) -> None:
    with clock.using(VirtualClock(wall=WALL)):
        store = opened(tmp_path)
        digest = (
            "0f007385b6f9d4b7eeb2748605afe1a984a0a3bfa3f014d09e2a784ce9e5cd1a"  # of 43 times A, by sha256sum
        )
        row = TicketRow("5c0f3d2b9a11", "alice", bytes.fromhex(digest), WALL, WALL + 60.0, "ann")
        DoorTables(store.database).save_ticket(row)
        store.save_end(EndRow("door ticket", row.id, int((WALL + 60.0) * 1e9), int(WALL * 1e9), 0))
        assert DoorTickets(store, ends_of(store, tmp_path)).find("alice", f"5c0f3d2b9a11.{'A' * 43}") == row


def test_a_ticket_warns_when_its_maker_has_no_token_any_longer() -> None:
    row, _text = new_ticket("alice", 60.0, "ann")
    assert left_by_its_maker(row, {"ann"}) == ""
    assert "rosrv door remove alice" in left_by_its_maker(row, {"bob"})
    by_the_machine, _text = new_ticket("alice", 60.0, "operator")  # on the admin socket
    assert left_by_its_maker(by_the_machine, set()) == ""
