"""A blocked host gets nothing from REST and the console, whatever it shows."""

import asyncio
import re
from collections.abc import Iterator
from typing import Any

import pytest

from appliance.api.front.access import Bearer, TokenAuthenticator
from appliance.api.front.journal import Journal
from appliance.api.front.problems import ProblemError
from appliance.api.front.request_gate import PUBLIC, RequestGate
from appliance.base import clock
from appliance.channel.messages.api import LongRequest
from appliance.configuration.settings import ApiLimits
from appliance.control.assembly.host_blocks import HostUses
from appliance.control.rest.rest import RestUses
from appliance.policy.model import address_of
from tests.support.asgi import sent as sent_to
from tests.support.virtual_clock import VirtualClock
from tests.unit.api.routes.test_operation_routes import routes, world

HOST, OTHER = "10.0.0.7", "10.0.0.8"


@pytest.fixture
def doorkeeper() -> Iterator[TokenAuthenticator]:
    doorkeeper = world().gate.doorkeeper
    doorkeeper.state_blocks([HOST])
    yield doorkeeper
    doorkeeper.state_blocks([])


def sent(method: str, path: str, host: str) -> Any:
    token = {"Authorization": f"Bearer {world().tokens.texts['admin']}"}
    return world().play(lambda: sent_to(world().gate, method, path, host, headers=token))


@pytest.mark.parametrize("host", [HOST, f"::ffff:{HOST}"])
def test_every_route_is_closed_for_a_blocked_host(doorkeeper: TokenAuthenticator, host: str) -> None:
    paths = [f"GET {path}" for path in sorted(PUBLIC)] + [
        "GET /",
        "GET /console/static/app.js",
        "GET /console",
    ]
    for route in [*routes(), *paths]:
        method, path = re.sub(r"{\w+}", "laptop", route).split()
        answer = sent(method, path, host)
        assert answer.status_code == 403, route
        assert answer.json()["type"] == "urn:rosrv:problem:host-blocked", route
    assert sent("GET", "/v1/status", OTHER).status_code == 200
    doorkeeper.state_blocks([])
    assert sent("GET", "/v1/status", host).status_code == 200


def test_a_websocket_of_a_blocked_host_is_refused(doorkeeper: TokenAuthenticator) -> None:
    assert doorkeeper.is_blocked(HOST)
    with pytest.raises(ProblemError, match="blocked by an operator"):
        world().gate.admit_websocket(HOST, "/door/")
    world().gate.admit_websocket(OTHER, "/door/")


@pytest.mark.anyio
async def test_long_answers_end_and_are_stated_to_control() -> None:
    """Followers and exports: the next piece is not sent."""
    doorkeeper = TokenAuthenticator(10, lambda _token: None)
    pieces: list[Any] = []
    more = asyncio.Event()

    async def follows(_scope: Any, _receive: Any, send: Any) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b"x", "more_body": True})
        await more.wait()
        await send({"type": "http.response.body", "body": b"y", "more_body": True})

    async def send(message: Any) -> None:
        pieces.append(message)

    async def receive() -> Any:
        return {"type": "http.request", "body": b"", "more_body": False}

    gate = RequestGate(
        follows,
        limits=ApiLimits(),
        doorkeeper=doorkeeper,
        journal=Journal(lambda _call: None),
        names=["api"],
    )
    bearer = Bearer("1", "ann", "viewer", 0.0, "")
    doorkeeper.recognise = lambda *_given: asyncio.sleep(0, bearer)  # type: ignore[method-assign]  # the one bearer of the test
    scope = {
        "type": "http", "client": (HOST, 5), "path": "/v1/live", "method": "GET", "query_string": b"",
        "headers": [(b"host", b"api")],
    }  # fmt: skip
    with clock.using(machine := VirtualClock()):
        running = asyncio.ensure_future(gate(scope, receive, send))
        await asyncio.sleep(1)
        assert gate.long_requests() == []
        machine.advance(6)
        assert gate.long_requests() == [LongRequest(HOST, "ann", "/v1/live", 1)]
        doorkeeper.state_blocks([HOST])
        assert doorkeeper.end_of(bearer, HOST) == "this host is blocked by an operator"
        more.set()
        with pytest.raises(ConnectionAbortedError):
            await running
    assert len(pieces) == 2
    assert gate.long_requests() == []


def test_sessions_and_followers_of_a_host_are_named() -> None:
    rest, uses = RestUses(), HostUses()
    uses.add(rest.of)
    uses.add(lambda _host: ["1 connection to the door alice"])
    with clock.using(machine := VirtualClock()):
        for host, who in ((HOST, "ann"), (f"::ffff:{HOST}", "bob"), (OTHER, "eve"), (HOST, ""), ("", "x")):
            rest.called(host, who)
        rest.running([LongRequest(HOST, "ann", "/v1/live", 2), LongRequest(OTHER, "eve", "/v1/live", 1)])
        machine.advance(12)
        assert uses.of(address_of(HOST)) == [
            "session of ann (REST, last call 12 s ago)",
            "session of bob (REST, last call 12 s ago)",
            "2 followers of ann (/v1/live)",
            "1 connection to the door alice",
        ]
        machine.advance(900)
        assert len(uses.of(address_of(HOST))) == 2
        for number in range(5000):
            rest.called(f"10.1.{number // 250}.{number % 250}", "many")
        assert uses.of(address_of("10.1.0.0")) == ["1 connection to the door alice"], "at most 1,000 are kept"
        assert len(uses.of(address_of("10.1.19.249"))) == 2
