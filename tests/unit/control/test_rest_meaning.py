"""Tests of `appliance.control.rest_meaning` beside the api: routes, gate, the order of each request."""

import asyncio
import functools
import re
import time
from collections.abc import Iterator
from typing import Any

import httpx
import msgspec
import pytest
from fastapi import FastAPI
from fastapi.routing import iter_route_contexts

from appliance.api.access import Bearer, Doorkeeper
from appliance.api.app import build_app
from appliance.api.control import ControlLink, _made
from appliance.api.history import History
from appliance.api.journal import Journal
from appliance.api.request_gate import Gate
from appliance.api.services import Services
from appliance.channel import admin
from appliance.channel.admin import CHANGES, OPERATIONS, A, AdminAnswer, AdminRequest
from appliance.channel.answers.graph_answers import Registrations
from appliance.channel.answers.host_answers import Endpoint
from appliance.channel.answers.measures import Measures
from appliance.channel.answers.policy_answers import PolicyKnown
from appliance.channel.messages.api import Asked, RequestMade, TokenKept
from appliance.configuration.settings import ApiLimits, Settings
from appliance.control.rest_meaning import NoOrderError, meant
from appliance.store.access_tokens import make_token
from tests.support.answers import example

LOOKS: dict[type, Any] = {
    admin.PolicyWanted: example(PolicyKnown, revision=7, text="[Nodes]\n", file="f"),
    admin.RegistrationsWanted: example(Registrations),
    admin.HostEndpoint: Endpoint("10.0.0.9", "the route"),
}
FILES = {"a.rv": "text"}
REQUESTS: list[tuple[str, str, Any]] = [
    ("POST", "/v1/policy", "[Nodes]\n"),
    ("POST", "/v1/policy?confirm_within=2.5", {"text": "[Nodes]\n", "note": "ticket"}),
    ("POST", "/v1/policy/rollback", {"revision": 3}),
    ("POST", "/v1/policy/rollback", {}),
    ("POST", "/v1/policy/reload", None),
    ("POST", "/v1/policy/reload?confirm_within=300", None),
    ("POST", "/v1/policy/confirm", None),
    ("POST", "/v1/monitors", {"files": FILES}),
    ("POST", "/v1/monitors?dry_run=0", {"files": FILES, "definitions": {"a/B.msg": "int8 x"}, "note": "n"}),
    ("POST", "/v1/monitors/reload", None),
    ("POST", "/v1/monitors/reload?prune=1", None),
    ("POST", "/v1/monitors?confirm_within=9", {"files": FILES}),
    ("POST", "/v1/monitors?shadow=1&force=1", {"files": FILES}),
    ("PUT", "/v1/monitors/safeZone?shadow=1&force=true", "text"),
    ("POST", "/v1/monitors/reload?shadow=1&force=0", None),
    ("PATCH", "/v1/monitors/safeZone", {"enabled": False, "for_seconds": 600}),
    ("PATCH", "/v1/monitors/safeZone?force=1", {"shadow": False}),
    ("PATCH", "/v1/monitors", {"names": ["a"], "shadow": True}),
    ("POST", "/v1/monitors/reload?prune=1&confirm_within=9", None),
    ("POST", "/v1/monitors/rollback", {"revision": 3}),
    ("POST", "/v1/monitors/rollback", {}),
    ("POST", "/v1/monitors/confirm", None),
    ("PUT", "/v1/monitors/safeZone?confirm_within=9", "text"),
    ("DELETE", "/v1/monitors/safeZone?confirm_within=9", None),
    ("DELETE", "/v1/monitors?name=a&confirm_within=9", None),
    ("PUT", "/v1/monitors/safeZone", "text"),
    ("PUT", "/v1/monitors/safeZone", {"text": "text", "definitions": {"a/B.msg": "int8 x"}, "note": "n"}),
    ("DELETE", "/v1/monitors/safeZone", None),
    ("DELETE", "/v1/monitors?name=a&name=b", None),
    ("PATCH", "/v1/monitors/safeZone", {"enabled": False}),
    ("PATCH", "/v1/monitors/safeZone", {"held": False}),
    ("PATCH", "/v1/monitors/safeZone", {"trial": True}),
    ("PATCH", "/v1/monitors", {"names": ["a"], "trial": False}),
    ("PATCH", "/v1/monitors", {"names": ["a", "b"], "enabled": True}),
    ("PATCH", "/v1/monitors", {"names": ["a"], "held": False}),
    ("POST", "/v1/recordings", {}),
    ("POST", "/v1/recordings", {"before": 30, "after": 2.5, "note": "n"}),
    ("POST", "/v1/recordings/memory", {}),
    ("POST", "/v1/recordings/memory", {"since": 7, "until": 9}),
    ("DELETE", f"/v1/recordings/{'a' * 20}", None),
    ("DELETE", "/v1/tokens/two%20words", None),
    ("POST", "/v1/hosts", {"name": "laptop"}),
    ("POST", "/v1/hosts", {"name": "laptop", "how": "token", "endpoint": "robot.local", "ports": "40000-40100",
                           "open": ["tcp/22", "udp/53"], "days": 30, "token_seconds": 600, "address": "10.111.7.7"}),
    ("POST", "/v1/hosts", {"name": "laptop", "how": "kit"}),
    ("POST", "/v1/hosts", {"name": "laptop", "how": "kit", "request": "PEM", "days": 3.5, "endpoint": "10.0.0.9"}),
    ("POST", "/v1/hosts/laptop/token", {}),
    ("POST", "/v1/hosts/laptop/token", {"days": 3, "token_seconds": 90, "endpoint": None}),
    ("POST", "/v1/hosts/laptop/kit", {}),
    ("POST", "/v1/hosts/laptop/kit", {"request": "PEM", "days": 7}),
    ("POST", "/v1/hosts/reload", None),
    ("DELETE", "/v1/hosts/laptop", None),
    ("PUT", "/v1/hosts/laptop/ports", {"state": "closed"}),
    ("PUT", "/v1/hosts/10.0.0.7/ports", {"state": "open", "open": [11311], "checked": 1.5}),
]  # fmt: skip
IDS = [f"{method} {path} {number}" for number, (method, path, _body) in enumerate(REQUESTS)]


class Listening(ControlLink):
    """Control, as far as the api can tell: answers what only looks, notes the orders and refuses them."""

    def __init__(self) -> None:
        super().__init__(lambda _tokens: None, lambda: None)
        self.orders: list[RequestMade] = []

    async def ask(
        self, request: AdminRequest[A], bearer: Bearer | None, seconds: float = 1.0
    ) -> AdminAnswer[A]:  # fmt: skip
        """What control answers."""
        if type(request) in CHANGES:
            self.orders.append(_made(0, request, bearer))
            return AdminAnswer(False, error="noted", trouble="busy")
        return AdminAnswer(True, LOOKS[type(request)])


@functools.cache
def api() -> tuple[Gate, Listening, dict[str, str]]:
    """The api with a token of each role that gives orders."""
    made = {
        role: make_token("alice", role, now=time.time(), seconds=6000) for role in ("admin", "investigator")
    }
    door, control, journal = Doorkeeper(10), Listening(), Journal(lambda _call: None)
    door.state([
        TokenKept(row.id, row.name, row.role, row.salt, row.hash, row.expires)
        for row, _token in made.values()
    ])  # fmt: skip
    limits = ApiLimits(burst=100_000)
    gate = Gate(
        application(control, door, journal), limits=limits, doorkeeper=door, journal=journal, names=["api"]
    )
    return gate, control, {role: token for role, (_row, token) in made.items()}


def application(control: ControlLink, door: Doorkeeper, journal: Journal) -> FastAPI:
    """The routes of the api."""

    async def nothing() -> Measures:
        return example(Measures)

    return build_app(Services(Settings(), control, door, journal, asyncio.Event(), History(nothing)))


def ordered(method: str, target: str, body: Any, tag: str = "*") -> list[RequestMade]:
    """What an honest api asks of control for a request of whoever may make it."""
    gate, control, tokens = api()
    token = tokens["investigator" if target == "/v1/recordings/memory" else "admin"]
    control.orders.clear()
    headers = {"Authorization": f"Bearer {token}", "If-Match": tag}
    given = {"content": body} if isinstance(body, str) else {"json": body}
    if isinstance(body, str):
        headers["Content-Type"] = "text/plain"

    async def play() -> str:
        transport = httpx.ASGITransport(gate, client=("10.0.0.1", 4))
        async with httpx.AsyncClient(transport=transport, base_url="http://api") as client:
            return (await client.request(method, target, headers=headers, **given)).text

    assert "noted" in asyncio.run(play())
    return list(control.orders)


@pytest.mark.parametrize("tag", ["*", '"7"'])
@pytest.mark.parametrize(("method", "target", "body"), REQUESTS, ids=IDS)
def test_the_api_and_control_understand_the_same(method: str, target: str, body: Any, tag: str) -> None:
    """For every way to give an order, control derives the very order that the api made."""
    [made] = ordered(method, target, body, tag)
    assert made.asked is not None
    assert (made.asked.method, made.asked.target) == (method, target)
    assert meant(made.asked, made.request) == made.request


def test_every_operation_is_a_route_of_the_api_and_for_the_same_role() -> None:
    """What the command line calls, and what control lets a role do, the api has and lets the same role do.

    Only what an operator may have judged, and an admin alone may load, is told apart by control.
    """
    app = application(Listening(), Doorkeeper(10), Journal(lambda _call: None))
    routes = {
        (method, _unnamed(str(route.path))): [role for role in roles_of(route.dependant) if role]
        for route in iter_route_contexts(app.routes)
        for method in route.methods or ()
    }
    for one in OPERATIONS:
        if one.path:
            dry = one.request in {admin.PolicyLoad, admin.MonitorLoad, admin.MonitorReplace}
            assert routes[one.method, _unnamed(one.path)] == ["operator" if dry else one.role], one


def roles_of(dependant: Any) -> Iterator[str | None]:
    """The least roles that a route asks for, whatever it asks for by them."""
    if dependant is not None:
        yield getattr(dependant.call, "least", None)
        for one in dependant.dependencies:
            yield from roles_of(one)


def _unnamed(path: str) -> str:
    return re.sub(r"{[\w:]+}", "{}", path)


def test_every_order_has_its_way() -> None:
    """No order that the api may give is missing above."""
    found = {
        type(ordered(method, target, body)[0].request) for method, target, body in REQUESTS
    }  # fmt: skip
    assert found == CHANGES


@pytest.mark.parametrize(("method", "target", "body"), REQUESTS, ids=IDS)
def test_no_field_of_an_order_can_be_another(method: str, target: str, body: Any) -> None:
    """Whatever field a fallen api changes, the order is not what was asked, but for what the appliance fills in."""
    [made] = ordered(method, target, body, '"7"')
    assert made.asked is not None
    body = body if isinstance(body, dict) else {}
    for field in msgspec.structs.fields(made.request):
        other = msgspec.structs.replace(
            made.request, **{field.name: _other(getattr(made.request, field.name))}
        )
        filled = field.name == "request" and body.get("request") is None
        assert (meant(made.asked, other) == other) is filled, field.name


def _other(value: Any) -> Any:
    """Another value of the same kind, or of one that the field may have."""
    match value:
        case bool():
            return not value
        case str():
            return f"{value}x"
        case dict():
            return {**value, next(iter(value), "k"): "other"}
        case list():
            return [*value, "x"]
        case None:
            return 1.0
        case _:
            return value + 1


@pytest.mark.parametrize(
    "change",
    [
        {"target": "/v1/policy?dry_run=1"}, {"target": "/v1/policy?dry_run=yes"}, {"target": "/v1/policy/"},
        {"method": "GET"}, {"method": "PUT"}, {"target": "/v1/status"}, {"if_match": ""}, {"if_match": '"x"'},
        {"body": b"\xff"}, {"content_type": "application/json"}, {"target": "/v1/policy?confirm_within=x"},
        {"body": b"[" * 100_000, "content_type": "application/json"},
        {"body": b"[]", "content_type": "application/json"}, {"target": ""},
    ],
)  # fmt: skip
def test_what_orders_nothing_is_refused(change: dict[str, Any]) -> None:
    """A dry run, a look, another route or a body that makes no sense is no order, and no defect."""
    good = Asked("10.0.0.1", "POST", "/v1/policy", "*", "text/plain", "", b"[Nodes]\n")
    order = admin.PolicyLoad("[Nodes]\n")
    assert meant(good, order) == order
    with pytest.raises(NoOrderError):
        meant(msgspec.structs.replace(good, **change), order)


def test_control_hears_of_a_client_that_disconnects() -> None:
    """The bearer of an order ends with its client: a client that is killed withdraws what it ordered."""
    gate, control, tokens = api()
    seen: list[Any] = []

    async def receive() -> Any:
        if not seen:
            seen.append("body")
            return {"type": "http.request", "body": b"", "more_body": False}
        return {"type": "http.disconnect"}

    async def asked(request: AdminRequest[A], bearer: Bearer | None, seconds: float = 1.0) -> AdminAnswer[A]:
        assert bearer is not None
        assert bearer.gone is not None
        async with asyncio.timeout(20):
            await bearer.gone
        seen.append(type(request))
        return AdminAnswer(False, error="withdrawn", trouble="busy")

    async def send(_message: Any) -> None:
        """Nobody hears it."""

    scope = {
        "type": "http", "http_version": "1.1", "method": "POST", "path": "/v1/policy/confirm", "query_string": b"",
        "raw_path": b"/v1/policy/confirm", "scheme": "http", "client": ("127.0.0.1", 1), "server": ("127.0.0.1", 80),
        "headers": [
            (b"host", b"127.0.0.1"), (b"if-match", b"*"), (b"authorization", f"Bearer {tokens['admin']}".encode()),
        ],
    }  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(control, "ask", asked)
        asyncio.run(gate(scope, receive, send))
    assert seen == ["body", admin.PolicyConfirm]
