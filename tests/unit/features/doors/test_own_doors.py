from pathlib import Path

import pytest

from appliance.base import clock
from appliance.channel.answers.token_answers import SignedOn
from appliance.features.doors.door_table import DoorTable
from appliance.features.doors.door_visits import DoorVisits
from appliance.features.doors.orders import OwnDoors
from appliance.features.doors.settings import Doors
from appliance.store.state_file import StateStore
from tests.support.ends import ends_in
from tests.support.engines import InlineDatabase
from tests.support.virtual_clock import VirtualClock


def person(name: str, *groups: str) -> SignedOn:
    return SignedOn(name, f"sso:{name}", f"subject of {name}", "", "operator", [*groups], 0.0)


PEOPLE = [person("bob", "Floor 1", "hall", "floor"), person("alice", "hall"), person("agent-1")]


@pytest.mark.parametrize(
    ("who", "door", "reason"),
    [
        ("alice", "alice", ""),
        ("shift", "shift", "rosrv door add shift"),
        ("Alice", "", "name of a door"),
        ("sso:bob", "floor", ""),
        ("sso:alice", "hall", "rosrv door add hall"),
        ("sso:agent-1", "", "sso.doors"),
        ("sso:gone", "", "name of a door"),
    ],
)
def test_a_token_has_the_door_of_its_name_and_a_person_that_of_a_group(
    tmp_path: Path, who: str, door: str, reason: str
) -> None:
    table = DoorTable(StateStore(tmp_path, failed=pytest.fail, kind=InlineDatabase), Doors())
    for name in ("alice", "agent-1", "bob", "floor"):
        table.save(table.plan(name, None, ""))
    found = OwnDoors(table, lambda: PEOPLE).of(who)
    assert found.name == door
    assert reason in found.reason
    assert (found.row is None) is bool(reason)
    assert found.row is None or found.row.name == door


def test_a_visit_is_one_connection_and_ends_with_its_token(tmp_path: Path) -> None:
    """A new token of the same name does not keep it."""
    machine, bearers = VirtualClock(), {"1": "alice"}
    with clock.using(machine):
        visits = DoorVisits(ends_in(tmp_path), lambda: bearers)
        row, text = visits.make("alice", "alice")
        assert visits.find("bob", text) is None
        assert visits.find("alice", text) == row
        visits.opened(row.id)
        assert visits.find("alice", text) is None
        machine.advance(86_400.0)
        assert visits.pop_ended() == []
        bearers.clear()
        bearers["2"] = "alice"
        assert visits.pop_ended() == [(row, False)]
        assert visits.present("alice") == []


def test_an_unused_ticket_is_over_after_a_minute_whatever_the_clock_says(tmp_path: Path) -> None:
    machine = VirtualClock(wall=1_790_000_000.0)
    with clock.using(machine):
        visits = DoorVisits(ends_in(tmp_path), lambda: {"1": "alice"})
        row, text = visits.make("alice", "alice")
        machine.set_wall(1_789_990_000.0)
        machine.advance(61.0)
        assert visits.find("alice", text) is None
        assert visits.pop_ended() == [(row, False)]


def test_visits_of_a_person_are_bounded_and_only_their_door_reports_their_end(tmp_path: Path) -> None:
    with clock.using(VirtualClock()):
        visits = DoorVisits(ends_in(tmp_path), lambda: {"1": "alice"})
        rows = [visits.make("alice", "alice")[0] for _ in range(10)]
        assert visits.pop_ended() == [(row, True) for row in rows[:2]]
        visits.left("bob", rows[2].id)
        visits.left("alice", rows[3].id)
        assert visits.present("alice") == [rows[2], *rows[4:]]
        visits.forget("alice")
        assert visits.present("alice") == []
