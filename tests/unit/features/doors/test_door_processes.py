from pathlib import Path

import pytest

from appliance.channel import messages
from appliance.features.doors import door_link
from appliance.features.doors.view import DOORS_VIEW, DoorsState
from tests.support.virtual_clock import let_time_pass
from tests.unit.features.doors.door_site import ALICE, DoorSite, settled

pytestmark = pytest.mark.anyio
NEW = door_link.DoorStarted("", 0.0, False)


@pytest.fixture
async def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> DoorSite:
    site = DoorSite(tmp_path, monkeypatch)
    site.connect()
    return site


async def test_a_door_gets_only_sockets_to_the_appliance_with_its_own_address(site: DoorSite) -> None:
    for number, port in enumerate((11311, 19001, 20000, 0, 11312, 8443, 22, 20001, -1, 1 << 20)):
        await site.hears(door_link.SocketWanted(number, port))
    assert site.made == [11311, 19001, 20000, 0]
    assert [one.number for one in site.sent] == [4, 5, 6, 7, 8, 9]
    assert {one.reason for one in site.sent} == {"doors do not connect to this port"}


async def test_a_door_that_asks_for_many_sockets_at_once_waits(site: DoorSite) -> None:
    await site.hears(*(door_link.SocketWanted(number, 11311) for number in range(70)))
    assert [one.number for one in site.sent] == [*range(64, 70)]


@pytest.mark.parametrize(
    "message", [door_link.DoorStarted("bob", 1.0, True), door_link.DoorStarted("alice", 0.5, True)]
)
async def test_the_process_of_another_door_ends_and_its_successor_serves(
    site: DoorSite, message: messages.Message
) -> None:
    await site.hears(message)
    assert [type(one) for one in site.sent] == [door_link.DoorEnded]
    await site.ends()
    assert (site.trail.events, site.asked) == ([], [messages.ProcessWanted("door", 0)])
    await site.hears(NEW)
    assert type(site.sent[-1]) is door_link.DoorGiven


async def test_the_process_of_a_removed_door_gets_nothing_of_the_next_one(site: DoorSite) -> None:
    await site.hears(NEW)
    site.processes.end(site.table.remove("alice"))
    bob = ALICE._replace(name="bob", address="198.19.240.3", added=2.0)
    site.table.save(bob)
    await settled()
    site.sent.clear()
    await site.hears(door_link.SocketWanted(1, 0), NEW, door_link.DoorStarted("bob", 2.0, False))
    assert (site.sent, site.made) == ([], [])
    assert site.processes.state(bob)[1] == "its process is starting"


@pytest.mark.parametrize("loses", ["nothing", "the link", "patience"])
async def test_a_process_that_does_not_end_in_time_is_killed_once(site: DoorSite, loses: str) -> None:
    killed = [messages.ProcessOverdue("door", 0), messages.ProcessWanted("door", 0)]

    def asked(seconds: float) -> list[messages.Message]:
        let_time_pass(seconds)
        before = len(site.asked)
        site.processes.end_overdue()
        return site.asked[before:]

    await site.hears(NEW)
    assert asked(1000.0) == []
    if loses == "the link":
        await site.loses()
    elif loses == "patience":
        site.fill()
        site.change_rights()
    else:
        await site.hears(door_link.DoorStarted("bob", 1.0, True))
    assert asked(4.0) == []
    assert asked(1.0) == (killed if loses != "nothing" else killed[:1])
    assert asked(60.0) == []


async def test_a_process_that_ends_in_time_or_gets_a_new_link_is_not_killed(site: DoorSite) -> None:
    await site.hears(NEW)
    site.processes.end(site.table.remove("alice"))
    await site.ends()
    site.table.save(ALICE)
    await site.hears(NEW)
    await site.ends()  # the next process is loading
    site.asked.clear()
    let_time_pass(5.0)
    site.processes.end_overdue()
    assert site.asked == []


async def test_a_process_without_a_door_ends(site: DoorSite) -> None:
    site.table.remove("alice")
    await site.hears(door_link.SocketWanted(1, 11311))
    assert type(site.sent[-1]) is door_link.DoorEnded


async def test_the_death_of_a_process_is_recorded(site: DoorSite) -> None:
    await site.hears(NEW)
    await site.ends()
    assert site.trail.events == ["door failed"]
    assert site.processes.health(ALICE).restarts_lately == 1
    site.table.remove("alice")
    await site.loses()
    assert site.trail.events == ["door failed"]


async def test_a_process_gets_the_definitions_in_force_before_its_door_and_each_change_once(
    site: DoorSite,
) -> None:
    site.define(**{"own/Add.srv": "---"})
    await site.hears(NEW)
    site.define(**{"own/Add.srv": "---"})
    site.define()
    await settled()
    assert [getattr(one, "definitions", None) for one in site.sent] == [{"own/Add.srv": "---"}, None, {}]


async def test_a_process_learns_of_each_change_of_rights(site: DoorSite) -> None:
    """Most change without another revision: by hours, dates, approvals and hosts."""
    await site.hears(NEW)
    site.sent.clear()
    site.change_rights()
    await settled()
    assert site.sent == [door_link.PolicyChanged()]


async def test_a_process_gets_the_valid_tickets_and_reports_ended_connections(site: DoorSite) -> None:
    await site.hears(door_link.DoorStarted("alice", 1.0, False))
    assert site.sent[0].tickets == ["3f9a0c5d17e2"]
    await site.hears(door_link.ConnectionsChanged("10.0.0.7", "3f9a0c5d17e2", 1, 0, 0, ""))
    await site.hears(door_link.ConnectionsChanged("10.0.0.7", "3f9a0c5d17e2", 0, 1, 0, ""))
    assert site.left == [("alice", "3f9a0c5d17e2")]


async def test_refusals_are_denials_of_the_peer_and_connections_are_folded(site: DoorSite) -> None:
    """So unknown hosts at a door's port are folded as everywhere, and none of them in the door's name."""
    await site.hears(NEW)
    await site.hears(
        door_link.ConnectionsChanged("10.0.0.66", "", 0, 0, 9, "the agent's address is 10.0.0.7")
    )
    await site.hears(door_link.ConnectionsChanged("10.0.0.7", "", 2, 1, 0, "the client left"))
    refused, began, ended = site.trail.rows
    assert (refused["host"], refused["decision"], refused["count"]) == ("10.0.0.66", "deny", 9)
    for one in (began, ended):
        assert (one["host"], one["folds"], one["peer"]) == (ALICE.address, True, "10.0.0.7")


async def test_a_full_door_and_one_that_keeps_ending_are_alarms(site: DoorSite) -> None:
    def alarms() -> list[str]:
        state = DoorsState([site.processes.health(ALICE)])
        return [alarm.kind for alarm in DOORS_VIEW.states[0].alarms(state)]

    for _death in range(3):
        await site.hears(NEW)
        await site.ends()
    assert alarms() == ["doors-restarting"]
    let_time_pass(600.0)
    await site.hears(NEW, door_link.DoorCounted(connections=32))
    let_time_pass(59.0)
    assert alarms() == []
    await site.hears(door_link.DoorCounted(connections=32, received=1))
    let_time_pass(1.0)
    assert alarms() == ["doors-full"]
    await site.hears(door_link.DoorCounted(connections=31))
    assert alarms() == []


async def test_two_definitions_are_recorded_with_their_nodes_and_hosts(site: DoorSite) -> None:
    await site.hears(
        door_link.DefinitionsDiffer("own/Drive", "1f" * 16, ("/base", "/drive"), ("/guest", "/guest/drive"))
    )
    [record] = [one for one in site.trail.records if one.event == "definitions differ"]
    assert (record.host, record.caller_id, record.resource) == ("10.0.0.66", "/guest", "/guest/drive")
    assert "/base (/drive, 127.0.0.1) and /guest (/guest/drive, 10.0.0.66)" in record.reason


async def test_the_robots_machine_has_the_first_number_and_no_number_is_used_twice(
    site: DoorSite, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("appliance.features.doors.door_processes._MAX_HOSTS", 1)
    await site.hears(door_link.HostsWanted(1, ["/gone", "/base", "/guest", "/other", "/guest"]))
    [given] = [one for one in site.sent if isinstance(one, door_link.HostsGiven)]
    assert given.hosts == [-1, 0, 1, 2, 3]
