import asyncio
import json
from itertools import count, islice
from pathlib import Path
from typing import Any

import pytest
from rosrv_fleet import connections
from rosrv_fleet.access import PEER_CERTIFICATE
from rosrv_fleet.config import Limits
from rosrv_fleet.connections import ClientConnections, CountedSocket
from rosrv_fleet.host_names import CollectorNames
from rosrv_fleet.server import Door
from rosrv_fleet.tokens import FleetRole, OperatorTokens

from tests.support.virtual_clock import let_time_pass

pytestmark = pytest.mark.anyio

_NUMBERS = count(100)


class _Socket(CountedSocket):
    def __init__(self) -> None:
        self.number, self.cut = next(_NUMBERS), False

    def fileno(self) -> int:
        return self.number

    def shutdown(self, _how: int) -> None:
        self.cut = True

    def close(self) -> None: ...


@pytest.fixture
def table(monkeypatch: pytest.MonkeyPatch) -> ClientConnections:
    monkeypatch.setattr(connections, "permitted_connections", lambda wanted: wanted)
    return ClientConnections(Limits(connections=400, address_connections=64))


def _opened(table: ClientConnections, address: str, number: int = 1) -> list[_Socket]:
    accepted = []
    for _ in range(number):
        let_time_pass(10.0)
        socket = _Socket()
        if table.accepted(socket, address):
            accepted.append(socket)
    return accepted


async def test_unproven_addresses_leave_half_of_the_connections(table: ClientConnections) -> None:
    others = [socket for number in range(17) for socket in _opened(table, f"203.0.113.{number}", 64)]
    assert sum(not one.cut for one in others) == 200
    (operator,) = _opened(table, "10.0.0.1")
    table.prove("10.0.0.1")
    robots = [socket for number in range(150) for socket in _opened(table, f"10.1.0.{number}")]
    assert all(table.established(robot.fileno(), f"robot{robot.fileno()}") for robot in robots)
    for number in range(17):
        _opened(table, f"203.0.113.{number}", 64)
    assert len(robots) == 150
    assert not any(one.cut for one in (operator, *robots))
    assert len(_opened(table, "10.0.0.1", 40)) == 40


async def test_robots_behind_one_address_do_not_wait_for_each_others_handshakes(
    table: ClientConnections,
) -> None:
    """After a pause of the site's link, all of them connect at once, again and again, while handshakes are slow."""
    robots = [f"robot{number}" for number in range(30)]
    first = _opened(table, "10.0.0.1", 30)
    for one, robot in zip(first, robots, strict=True):
        assert table.established(one.fileno(), robot)
        table.closed(one.fileno())
    waiting = _opened(table, "10.0.0.1", 300)
    assert len(waiting) == 64 + 4 * 30
    assert len(_opened(table, "10.0.0.2", 300)) == 64, "no robot has come from there"
    others = [socket for _number in range(100) for socket in _opened(table, "10.0.0.3")]
    for number, one in enumerate(others[:60]):
        table.established(one.fileno(), f"another{number}")
    assert len(_opened(table, "10.0.0.3", 300)) <= 200, "at most half of the whole is for one address"


async def test_room_is_made_by_the_address_with_most(table: ClientConnections) -> None:
    (early,) = _opened(table, "10.0.0.7")
    many = [socket for number in range(1, 5) for socket in _opened(table, f"203.0.113.{number}", 64)]
    (late,) = _opened(table, "10.0.0.8")
    assert not early.cut and not late.cut
    cut = next(one for one in many if one.cut)
    assert not table.established(cut.fileno(), None)
    table.closed(cut.fileno())
    assert table.established(late.fileno(), None)


async def test_a_customer_with_many_networks_keeps_no_robot_out(table: ClientConnections) -> None:
    """As after a start of the collector, when no address is proven yet."""
    others = [socket for number in range(250) for socket in _opened(table, f"2001:db8:0:{number:x}::1")]
    assert len(others) == 64
    [robot] = _opened(table, "2001:db8:1::1")
    assert table.established(robot.fileno(), "arm1")
    table.prove(others[0].network)
    assert len(_opened(table, "2001:db8::9", 70)) == 64
    for one in others:
        table.closed(one.fileno())
    assert len(_opened(table, "2001:db8:0:9::1", 70)) == 64


async def test_every_connection_that_ends_makes_room(table: ClientConnections) -> None:
    for _ in range(3):
        opened = [socket for number in range(3) for socket in _opened(table, f"203.0.113.{number}", 60)]
        assert len(opened) == 180
        assert table.established(opened[0].fileno(), "robot")
        for one in opened:
            table.closed(one.fileno())
    assert len(_opened(table, "198.51.100.1", 64)) == 64


async def test_handshakes_of_unproven_addresses_have_a_share(table: ClientConnections) -> None:
    def handshakes(seconds: int, *addresses: str) -> int:
        done = 0
        for _ in range(seconds * 100):
            let_time_pass(0.01)
            for address in addresses:
                socket = _Socket()
                if table.accepted(socket, address):
                    done += 1
                    table.closed(socket.fileno())
        return done

    table.prove("10.0.0.1")
    assert 500 <= handshakes(10, "203.0.113.1") <= 500 + 33
    assert 500 <= handshakes(10, "203.0.113.1", "203.0.113.2") <= 500 + 66
    assert all(table.accepted(_Socket(), "10.0.0.1") for _ in range(60))
    let_time_pass(60)
    assert all(table.accepted(_Socket(), "203.0.113.1") for _ in range(32))
    let_time_pass(60)
    assert sum(table.accepted(_Socket(), f"2001:db8:0:{number:x}::1") for number in range(300)) == 32
    assert table.accepted(_Socket(), "2001:db8:1::1")
    let_time_pass(60)
    once = (f"203.{number >> 8}.{number & 255}.1" for number in range(65_536))
    assert 10_900 <= sum(handshakes(1, *islice(once, 30)) for _ in range(50)) <= 11_000


async def _status(
    door: Door, address: str, token: str = "", *, robot: bool = False, name: str = "10.0.0.5"
) -> int:
    headers = [(b"host", name.encode())]
    headers += [(b"authorization", f"Bearer {token}".encode())] if token else []
    scope: Any = {
        "type": "http", "method": "POST", "path": "/login", "headers": headers, "client": (address, 1),
        "state": {PEER_CERTIFICATE: b"robot" if robot else None}, "query_string": b"",
    }  # fmt: skip
    sent: list[Any] = []

    async def send(message: Any) -> None:
        sent.append(message)

    await door(scope, lambda: asyncio.sleep(0), send)  # type: ignore[arg-type,return-value]  # nothing is received
    return int(sent[0]["status"])


async def test_requests_without_a_token_have_a_share(table: ClientConnections, tmp_path: Path) -> None:
    async def app(_scope: Any, _receive: Any, send: Any) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": json.dumps({}).encode()})

    tokens = OperatorTokens(tmp_path / "tokens.json")
    token = tokens.add("alice", FleetRole.VIEWER)
    robots = {b"robot"}
    door = Door(app, table, tokens, CollectorNames([]), lambda shown: "arm1" if shown in robots else None)

    for word in ("", "wrong"):
        found = [await _status(door, f"203.0.113.{len(word)}", word) for _ in range(100)]
        assert found.count(200) == 32 and found.count(429) == 68
    assert {await _status(door, "10.0.0.1", token) for _ in range(300)} == {200}
    assert {await _status(door, "203.0.113.0", robot=True) for _ in range(300)} == {200}
    behind_it = [await _status(door, "10.0.0.1", "wrong") for _ in range(300)]
    assert behind_it.count(429) > 0
    assert await _status(door, "203.0.113.77", name="evil.example.org") == 421
    assert await _status(door, "203.0.113.77", robot=True, name="evil.example.org") == 200
    robots.clear()  # the robot is removed while its connection is open
    assert 429 in {await _status(door, "203.0.113.78", robot=True) for _ in range(100)}
