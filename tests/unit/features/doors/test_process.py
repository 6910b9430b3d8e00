import asyncio
from collections.abc import Coroutine
from types import SimpleNamespace
from typing import Any

import pytest

from appliance.features.doors import door_link, process
from appliance.features.doors.connections import DoorConnections
from appliance.features.doors.door_node import DoorNode
from appliance.features.doors.lookout import Lookout
from tests.support.features.doors.door_world import DOOR, WebSocketClient
from tests.support.memory_network import MemoryNetwork

pytestmark = pytest.mark.anyio
SLOTS = 32
GIVEN = door_link.DoorGiven("alice", 1.0, "10.0.0.2", 11311, [], SLOTS, 200, ["ticket"], [])


class Control:
    """Control's end of the link to the process of a door, in which the node never starts."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.network = MemoryNetwork()
        self.reports: list[Any] = []
        self.starts = asyncio.Event()
        self.serving: list[asyncio.Task[None]] = []
        self._arrived: asyncio.Queue[Any] = asyncio.Queue()
        self.network.listen(DOOR[0], lambda *streams: self._arrived.put(streams), DOOR[1])
        started: list[Coroutine[Any, Any, None]] = []
        monkeypatch.setattr(process, "Child", self._linked)
        monkeypatch.setattr(process, "Channel", lambda *_wires: None)
        monkeypatch.setattr(process, "socket", SimpleNamespace(socket=lambda **_of: None))
        monkeypatch.setattr(process, "uvloop", SimpleNamespace(run=started.append))
        monkeypatch.setattr(process, "RosNode", lambda *_of, **_more: SimpleNamespace(start=self._waits))
        monkeypatch.setattr(DoorConnections, "adopt", self._adopted())
        process.main(0, 0)
        self.running = asyncio.ensure_future(started[0])

    def _linked(self, _lifeline: Any, _messages: Any, *, said: Any, took: Any, **_more: Any) -> Any:
        self.say, self.give, self.ended = said, took, asyncio.Event()
        return SimpleNamespace(
            attach=lambda _first: None, tell=self._told, ended=self.ended, close=lambda: None
        )

    def _told(self, report: Any) -> bool:
        self.reports.append(report)
        return True

    async def _waits(self) -> None:
        await self.starts.wait()

    def _adopted(self) -> Any:
        def adopt(limited: DoorConnections, _number: int, serve: Any, refused: Any, *, host: str) -> None:
            work = limited.serve(serve, *self._arrived.get_nowait(), refused=refused, host=host)
            self.serving.append(asyncio.ensure_future(work))

        return adopt

    async def end(self) -> None:
        for task in self.serving:
            task.cancel()
        self.ended.set()
        await self.running

    async def pass_on(self, host: str) -> WebSocketClient:
        client = WebSocketClient(*self.network.connect(host, DOOR))
        while self._arrived.empty():
            await asyncio.sleep(0)
        self.give(door_link.ViewerGiven(host, "ticket"), (3,))
        return client


@pytest.mark.parametrize(("hosts", "most"), [(1, 24), (100, SLOTS)])
async def test_viewers_that_wait_for_the_node_are_bounded_like_connections(
    monkeypatch: pytest.MonkeyPatch, hosts: int, most: int
) -> None:
    """Each has a valid ticket. Those beyond the limits get the reason before the node has started."""
    control = Control(monkeypatch)
    control.say(GIVEN)
    clients = [await control.pass_on(f"10.0.1.{number % hosts}") for number in range(100)]
    await asyncio.sleep(3)
    refused = [client.response.status_code for client in clients if client.response is not None]
    assert refused == [503] * (100 - most)
    assert sum(not task.done() for task in control.serving) == most
    changes = [report for report in control.reports if isinstance(report, door_link.ConnectionsChanged)]
    assert (sum(one.began for one in changes), sum(one.refused for one in changes)) == (0, 100 - most)
    await control.end()


async def test_a_network_full_of_addresses_hides_no_other_host(monkeypatch: pytest.MonkeyPatch) -> None:
    """IPv6 gives one host as many addresses as it likes."""
    control = Control(monkeypatch)
    monkeypatch.setattr("appliance.features.doors.process.os.close", lambda _fd: None)
    control.say(GIVEN)
    hosts = [*(f"2001:db8::{number:x}" for number in range(1, 400)), "10.0.0.7"]
    control.say(door_link.BlocksGiven(hosts))
    for host in hosts:
        control.give(door_link.ViewerGiven(host, "ticket"), (3,))
    await asyncio.sleep(3)
    changes = [report for report in control.reports if isinstance(report, door_link.ConnectionsChanged)]
    assert [change.refused for change in changes if change.peer == "10.0.0.7"] == [1]
    assert sum(change.refused for change in changes if change.peer.startswith("2001:db8::")) == 399
    assert len(changes) < 300
    await control.end()


@pytest.mark.parametrize("when", ["before", "while it waits"])
async def test_a_blocked_host_is_not_served(monkeypatch: pytest.MonkeyPatch, when: str) -> None:
    control, closed = Control(monkeypatch), list[int]()
    monkeypatch.setattr("appliance.features.doors.process.os.close", closed.append)
    control.say(GIVEN)
    if when == "before":
        control.say(door_link.BlocksGiven(["10.0.0.7"]))
        control.give(door_link.ViewerGiven("::ffff:10.0.0.7", "ticket"), (3,))
        assert closed == [3]
    else:
        await control.pass_on("10.0.0.7")
        control.say(door_link.BlocksGiven(["10.0.0.7"]))
    await control.pass_on("10.0.0.8")
    control.starts.set()
    await asyncio.sleep(3)
    ends = {one.peer: one.reason for one in control.reports if isinstance(one, door_link.ConnectionsChanged)}
    assert ends.get("10.0.0.7") == "this host is blocked by an operator"
    await control.end()


@pytest.mark.parametrize("replaced", [True, False])
async def test_a_visit_that_a_newer_one_replaces_leaves_its_wills(
    monkeypatch: pytest.MonkeyPatch, replaced: bool
) -> None:
    """Its person may drive, and the door stops the robot. After the end of a ticket, no one has the right."""
    control, published = Control(monkeypatch), list[bool]()

    async def forget(_door: DoorNode, _client: object, *, wills: bool) -> None:
        published.append(wills)

    monkeypatch.setattr(DoorNode, "forget", forget)
    control.say(GIVEN)
    client = await control.pass_on("10.0.0.7")
    control.starts.set()
    await asyncio.sleep(3)
    control.say(door_link.TicketEnded("ticket", replaced))
    assert ("the ticket is over" in await client.closed()) is not replaced
    await asyncio.sleep(3)
    assert published == [replaced]
    await control.end()


@pytest.mark.parametrize("message", [door_link.PolicyChanged(), door_link.BlocksGiven([]), GIVEN])
async def test_denials_are_asked_about_again_after_each_change_of_rights(
    monkeypatch: pytest.MonkeyPatch, message: Any
) -> None:
    """A control that starts again sends the door, because rights may have changed while it was down."""
    control, asked = Control(monkeypatch), list[bool]()
    monkeypatch.setattr(Lookout, "policy_changed", lambda _lookout: asked.append(True))
    control.say(GIVEN)
    control.starts.set()
    await asyncio.sleep(3)
    before = len(asked)
    control.say(message)
    assert len(asked) == before + 1
    await control.end()
