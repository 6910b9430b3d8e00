import asyncio
from types import SimpleNamespace
from typing import Any, cast

import pytest

from appliance.base import clock
from appliance.channel import messages
from appliance.channel.channel import ChannelFullError
from appliance.control.core import Core, Links
from appliance.control.links.supervisor_link import ControlLifeline
from appliance.features.doors import door_link, door_processes
from appliance.features.doors.door_processes import DoorProcesses
from appliance.features.doors.door_rows import DoorRow
from appliance.features.doors.door_table import DoorTable
from appliance.features.doors.settings import Doors
from appliance.features.doors.view import DOORS_VIEW, DoorsState
from tests.support.core import FakeTrail
from tests.support.virtual_clock import VirtualClock

ALICE = DoorRow("alice", "198.19.240.2", 1.0, None, 0, None, "")
NEW = door_link.DoorStarted("", 0.0, False)


class Bench:
    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.sent: list[Any] = []
        self.asked: list[Any] = []
        self.trail = FakeTrail()
        self.made: list[int] = []
        self.left: list[tuple[str, str]] = []
        self.full = False
        settings = SimpleNamespace(
            of=lambda _kind: Doors(),
            listen_address=("0.0.0.0", 11311),
            api_address=None,
        )
        self.policy = SimpleNamespace(current=lambda: SimpleNamespace(ports=range(19001, 20001)), revision=7)
        self.links: list[SimpleNamespace] = []
        self.blocks = self.sources = self
        self.reasons: dict[str, str] = {}
        self.rows = [ALICE]
        table = SimpleNamespace(
            problem="",
            live=lambda: self.rows,
            in_slot=lambda number: next((row for row in self.rows if row.slot == number), None),
        )
        monkeypatch.setattr(door_processes, "Link", self._link)
        self.definitions: dict[str, str] = {}
        core = SimpleNamespace(
            settings=settings,
            links=Links(
                cast(ControlLifeline, SimpleNamespace(say=self.asked.append)), lambda _sequence: None
            ),
            policy=self.policy,
            trail=self.trail,
            hosts=self,
            graph=SimpleNamespace(master_port=11311, host_of=lambda _node: None),
            specifications=self,
        )
        self.processes = DoorProcesses(
            cast(Core, core),
            cast(DoorTable, table),
            tickets=lambda _door: ["3f9a0c5d17e2"],
            left=lambda *left: self.left.append(left),
        )
        self.link = cast(Any, self.links[0])
        monkeypatch.setattr(self.processes, "_given", self._given)

    def _link(self, heard: Any, lost: Any) -> SimpleNamespace:
        link = SimpleNamespace(heard=heard, lost=lost, send=self._send, channel=object(), close=self._close)
        self.links.append(link)
        return link

    def _close(self) -> None:
        self.link.channel = None

    def _send(self, message: Any, *_rest: Any, **_more: Any) -> bool:
        if self.full:
            raise ChannelFullError("the process does not read")
        self.sent.append(message)
        return True

    async def _given(self, _slot: Any, row: DoorRow, _request: int, port: int) -> None:
        assert row == ALICE
        self.made.append(port)

    def ends(self) -> None:
        self.link.channel = None
        self.link.lost("")
        self.link.channel = object()

    def hears(self, message: messages.Message) -> None:
        self.link.heard(message)


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(monkeypatch)


@pytest.mark.anyio
async def test_a_door_gets_only_sockets_to_the_appliance_with_its_own_address(bench: Bench) -> None:
    for number, port in enumerate((11311, 19001, 20000, 0, 11312, 8443, 22, 20001, -1, 1 << 20)):
        bench.hears(door_link.SocketWanted(number, port))
    assert [one.number for one in bench.sent] == [4, 5, 6, 7, 8, 9]
    assert {one.reason for one in bench.sent} == {"doors do not connect to this port"}


@pytest.mark.anyio
async def test_a_door_that_asks_for_many_sockets_at_once_waits(bench: Bench) -> None:
    for number in range(70):
        bench.hears(door_link.SocketWanted(number, 11311))
    assert [one.number for one in bench.sent] == [*range(64, 70)]


@pytest.mark.parametrize(
    "message", [door_link.DoorStarted("bob", 1.0, True), door_link.DoorStarted("alice", 0.5, True)]
)
def test_the_process_of_another_door_ends_and_its_successor_serves(
    bench: Bench, message: messages.Message
) -> None:
    bench.hears(message)
    assert [type(one) for one in bench.sent] == [door_link.DoorEnded]
    bench.ends()
    assert (bench.trail.events, bench.asked) == ([], [messages.ProcessWanted("door", 0)])
    bench.hears(NEW)
    assert type(bench.sent[-1]) is door_link.DoorGiven


@pytest.mark.anyio
async def test_the_process_of_a_removed_door_gets_nothing_of_the_next_one(bench: Bench) -> None:
    bench.hears(NEW)
    bench.processes.end(bench.rows.pop())
    bench.rows.append(ALICE._replace(name="bob", added=2.0))
    bench.sent.clear()
    for message in (door_link.SocketWanted(1, 0), NEW, door_link.DoorStarted("bob", 2.0, False)):
        bench.hears(message)
    await asyncio.sleep(0)
    assert (bench.sent, bench.made) == ([], [])
    assert bench.processes.state(bench.rows[0])[1] == "its process is starting"


@pytest.mark.parametrize("loses", ["nothing", "the link", "patience"])
def test_a_process_that_does_not_end_in_time_is_killed_once(bench: Bench, loses: str) -> None:
    machine = VirtualClock()
    killed = [messages.ProcessOverdue("door", 0), messages.ProcessWanted("door", 0)]

    def asked(seconds: float) -> list[Any]:
        machine.advance(seconds)
        before = len(bench.asked)
        bench.processes.end_overdue()
        return bench.asked[before:]

    with clock.using(machine):
        bench.hears(NEW)
        assert asked(1000.0) == []
        if loses == "the link":
            bench.link.channel = None
            bench.link.lost("")
        elif loses == "patience":
            bench.full = True
            bench.policy.revision += 1
            bench.processes.define()
        else:
            bench.hears(door_link.DoorStarted("bob", 1.0, True))
        assert asked(4.0) == []
        assert asked(1.0) == (killed if loses != "nothing" else killed[:1])
        assert asked(60.0) == []


def test_a_process_that_ends_in_time_or_gets_a_new_link_is_not_killed(bench: Bench) -> None:
    with clock.using(machine := VirtualClock()):
        bench.hears(NEW)
        bench.processes.end(bench.rows.pop())
        bench.ends()
        bench.rows.append(ALICE)
        bench.hears(NEW)
        bench.link.channel = None
        bench.link.lost("")
        bench.link.channel = object()  # of the next process, which is loading
        bench.asked.clear()
        machine.advance(5.0)
        bench.processes.end_overdue()
        assert bench.asked == []


def test_a_process_without_a_door_ends(bench: Bench) -> None:
    bench.rows.clear()
    bench.hears(door_link.SocketWanted(1, 11311))
    assert type(bench.sent[-1]) is door_link.DoorEnded


def test_the_death_of_a_process_is_recorded(bench: Bench) -> None:
    bench.hears(NEW)
    bench.link.lost("")
    assert bench.trail.events == ["door failed"]
    assert bench.processes.health(ALICE).restarts_lately == 1
    bench.rows.clear()
    bench.link.lost("")
    assert bench.trail.events == ["door failed"]


def test_a_process_gets_the_definitions_in_force_before_its_door_and_each_change_once(bench: Bench) -> None:
    bench.definitions = {"own/Add.srv": "---"}
    bench.processes.define()
    bench.hears(NEW)
    bench.processes.define()
    bench.definitions = {}
    bench.processes.define()
    assert [getattr(one, "definitions", None) for one in bench.sent] == [{"own/Add.srv": "---"}, None, {}]


def test_a_process_learns_of_another_policy_once(bench: Bench) -> None:
    bench.hears(NEW)
    bench.sent.clear()
    for revision in (7, 8, 8):
        bench.policy.revision = revision
        bench.processes.define()
    assert bench.sent == [door_link.PolicyChanged()]


def test_a_process_gets_the_valid_tickets_and_reports_ended_connections(bench: Bench) -> None:
    bench.hears(door_link.DoorStarted("alice", 1.0, False))
    assert bench.sent[0].tickets == ["3f9a0c5d17e2"]
    bench.hears(door_link.ConnectionsChanged("10.0.0.7", "3f9a0c5d17e2", 1, 0, 0, ""))
    bench.hears(door_link.ConnectionsChanged("10.0.0.7", "3f9a0c5d17e2", 0, 1, 0, ""))
    assert bench.left == [("alice", "3f9a0c5d17e2")]


def test_refusals_are_denials_of_the_peer_and_connections_are_folded(bench: Bench) -> None:
    """So unknown hosts at a door's port are folded as everywhere, and none of them in the door's name."""
    bench.hears(NEW)
    bench.hears(door_link.ConnectionsChanged("10.0.0.66", "", 0, 0, 9, "the agent's address is 10.0.0.7"))
    bench.hears(door_link.ConnectionsChanged("10.0.0.7", "", 2, 1, 0, "the client left"))
    refused, began, ended = bench.trail.rows
    assert (refused["host"], refused["decision"], refused["count"]) == ("10.0.0.66", "deny", 9)
    for one in (began, ended):
        assert (one["host"], one["folds"], one["peer"]) == (ALICE.address, True, "10.0.0.7")


def test_a_full_door_and_one_that_keeps_ending_are_alarms(bench: Bench) -> None:
    machine = VirtualClock()

    def alarms() -> list[str]:
        state = DoorsState([bench.processes.health(ALICE)])
        return [one.kind for one in DOORS_VIEW.states[0].alarms(state)]

    with clock.using(machine):
        for _death in range(3):
            bench.hears(NEW)
            bench.link.lost("")
        assert alarms() == ["doors-restarting"]
        machine.advance(600.0)
        bench.hears(NEW)
        bench.hears(door_link.DoorCounted(connections=32))
        machine.advance(59.0)
        assert alarms() == []
        bench.hears(door_link.DoorCounted(connections=32, received=1))
        machine.advance(1.0)
        assert alarms() == ["doors-full"]
        bench.hears(door_link.DoorCounted(connections=31))
        assert alarms() == []
