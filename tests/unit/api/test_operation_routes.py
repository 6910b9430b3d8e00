"""Each operation over REST, from the gate to control's link: its order, roles, dry run and ETag."""

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

from appliance.api.access import Bearer, TokenAuthenticator
from appliance.api.app import build_app
from appliance.api.control import ControlLink, _made
from appliance.api.history import SampleHistory
from appliance.api.journal import Journal
from appliance.api.request_gate import RequestGate, is_console
from appliance.api.services import Services
from appliance.channel import admin
from appliance.channel.admin import CHANGES, OPERATIONS, A, AdminAnswer, AdminRequest, answer_to
from appliance.channel.answers.graph_answers import Registrations
from appliance.channel.answers.host_answers import Endpoint
from appliance.channel.answers.measures import Measures
from appliance.channel.answers.monitor_answers import Monitors
from appliance.channel.answers.policy_answers import PolicyKnown
from appliance.channel.messages.api import RequestMade, TokenKept
from appliance.channel.rest_meaning import call_of, filled_in, meant
from appliance.channel.rest_operation import Operation
from appliance.configuration.settings import ApiLimits, Settings
from appliance.store.access_tokens import make_token
from tests.support.answers import example
from tests.support.asgi import requested

LOOKS: dict[type, Any] = {
    admin.PolicyWanted: example(PolicyKnown, revision=7, text="[Nodes]\n", file="f"),
    admin.RegistrationsWanted: example(Registrations),
    admin.HostEndpoint: Endpoint("10.0.0.9", "the route"),
    admin.MonitorsWanted: example(Monitors, files={"safeZone": "text"}),
}
FILES = {"a.rv": "text"}
FIELDS = {"id": "a" * 20, "revision": 3, "topic": "/scan"}
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
    ("PATCH", "/v1/monitors/safeZone", {"shadow": True}),
    ("PATCH", "/v1/monitors", {"names": ["a"], "shadow": False}),
    ("PATCH", "/v1/monitors", {"names": ["a", "b"], "enabled": True}),
    ("PATCH", "/v1/monitors", {"names": ["a"], "held": False}),
    ("POST", "/v1/recordings", {}),
    ("POST", "/v1/recordings", {"before": 30, "after": 2.5, "note": "n"}),
    ("POST", "/v1/recordings/memory", {}),
    ("POST", "/v1/recordings/memory", {"since": 7, "until": 9}),
    ("POST", "/v1/recordings/memory", {"since": "2026-11-20T06:20:46.5Z"}),
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
    ("POST", "/v1/blocks", {"address": "10.0.0.7"}),
    ("POST", "/v1/blocks", {"address": "ocu-1", "for_seconds": 3600, "note": "strange traffic", "force": True}),
    ("DELETE", "/v1/blocks/10.0.0.7", None),
    ("DELETE", "/v1/blocks/fd00%3A%3A7", None),
    ("POST", "/v1/hosts/reload", None),
    ("POST", "/v1/standby/promote", None),
    ("DELETE", "/v1/hosts/laptop", None),
    ("PUT", "/v1/hosts/laptop/ports", {"state": "closed"}),
    ("PUT", "/v1/hosts/10.0.0.7/ports", {"state": "open", "open": [11311], "checked": 1.5}),
    ("PUT", "/v1/hosts/laptop/ports", {"state": "open", "checked": "2026-11-20T06:20:46Z"}),
]  # fmt: skip
ROLES = ("viewer", "investigator", "operator", "admin")
BY_ROLE = {
    "viewer": set(ROLES), "investigator": {"investigator"}, "operator": {"operator", "admin"}, "admin": {"admin"},
}  # fmt: skip
NAMED = [operation for operation in OPERATIONS if operation.name]
LEAST = {
    **dict.fromkeys(
        (
            "status", "inventory", "policy_revisions", "policy_revision", "graph", "monitors", "monitor_revisions",
            "monitor_revision",
            "recordings", "recording", "hosts", "host_blocks", "challenge", "standby",
        ),
        "viewer",
    ),
    "recording_of_memory": "investigator",
    **dict.fromkeys(
        (
            "reload_policy", "roll_back_policy", "confirm_policy", "topic_messages", "reload_monitors",
            "confirm_monitors", "switch_monitors", "switch_monitor", "record_now", "tell_host_ports", "reload_hosts",
            "block_host", "unblock_host",
        ),
        "operator",
    ),
    **dict.fromkeys(
        (
            "load_policy", "load_monitors", "replace_monitor", "remove_monitors", "remove_monitor",
            "roll_back_monitors", "remove_recording", "tokens", "revoke_token", "enrol_host", "host_token",
            "new_host_kit", "revoke_host", "promote_standby",
        ),
        "admin",
    ),
}  # fmt: skip
"""The least role of each operation, by its name in the contract; a dry run is for operators."""

PROBLEM = "urn:rosrv:problem:"
IDS = [f"{method} {path} {number}" for number, (method, path, _body) in enumerate(REQUESTS)]


def _empty(request: AdminRequest[Any]) -> Any:
    kind: Any = answer_to(type(request))
    return example(kind)


class Listening(ControlLink):
    """Control's end of the link: answers questions, collects orders and rejects them."""

    def __init__(self) -> None:
        super().__init__(lambda _tokens: None, lambda: None)
        self.orders: list[RequestMade] = []

    async def ask(
        self, request: AdminRequest[A], bearer: Bearer | None, seconds: float | None = None
    ) -> AdminAnswer[A]:  # fmt: skip
        """Return what control answers."""
        if type(request) in CHANGES:
            self.orders.append(_made(0, request, bearer))
            return AdminAnswer(False, error="noted", trouble="busy")
        return AdminAnswer(True, LOOKS.get(type(request)) or _empty(request))


@functools.cache
def api() -> tuple[RequestGate, Listening, dict[str, str]]:
    """Return the api with a token of each role."""
    made = {role: make_token("alice", role, now=time.time(), seconds=6000) for role in ROLES}
    door, control, journal = (
        TokenAuthenticator(10, lambda _token: None),
        Listening(),
        Journal(lambda _call: None),
    )
    door.state([
        TokenKept(row.id, row.name, row.role, row.salt, row.hash, row.expires)
        for row, _token in made.values()
    ])  # fmt: skip
    limits = ApiLimits(burst=100_000)
    gate = RequestGate(
        application(control, door, journal), limits=limits, doorkeeper=door, journal=journal, names=["api"]
    )
    return gate, control, {role: token for role, (_row, token) in made.items()}


def application(control: ControlLink, door: TokenAuthenticator, journal: Journal) -> FastAPI:
    """The routes of the api."""

    async def nothing() -> Measures:
        return example(Measures)

    return build_app(Services(Settings(), control, door, journal, asyncio.Event(), SampleHistory(nothing)))


def asked(method: str, target: str, body: Any, role: str, tag: str | None) -> httpx.Response:
    """Return the api's answer to a request by a role; `Listening.orders` has the orders of this request."""
    _gate, control, tokens = api()
    control.orders.clear()
    headers = {"Authorization": f"Bearer {tokens[role]}"} | ({} if tag is None else {"If-Match": tag})
    if isinstance(body, str):
        return requested(
            api()[0], method, target, headers=headers | {"Content-Type": "text/plain"}, content=body
        )
    return requested(api()[0], method, target, headers=headers, json=body)


def sample(operation: Operation) -> tuple[str, str, Any]:
    """Return the first request in `REQUESTS` for an operation, or the command line's request if there is none."""
    parts = operation.path.split("/")
    for method, target, body in REQUESTS:
        given = target.partition("?")[0].split("/")
        same = len(given) == len(parts) and all(
            part == word or word.startswith("{") for part, word in zip(given, parts, strict=True)
        )
        if same and method == operation.method:
            return method, target, body
    order = operation.request(
        **{name: value for name, value in FIELDS.items() if name in fields_of(operation)}
    )
    call = call_of(order, operation)
    return call.method, call.target, call.body


def fields_of(operation: Operation) -> set[str]:
    """Return the names of the fields that an order must have."""
    return {field.name for field in operation.fields().values() if field.required}


def ordered(method: str, target: str, body: Any, tag: str = "*") -> list[RequestMade]:
    """Return the orders that an honest api sends to control for a request by a role that may make it."""
    role = "investigator" if target == "/v1/recordings/memory" else "admin"
    assert "noted" in asked(method, target, body, role, tag).text
    return list(api()[1].orders)


@pytest.mark.nightly
@pytest.mark.parametrize("tag", ["*", '"7"'])
@pytest.mark.parametrize(("method", "target", "body"), REQUESTS, ids=IDS)
def test_the_api_and_control_understand_the_same(method: str, target: str, body: Any, tag: str) -> None:
    """For every way to give an order, control derives the order that the api made."""
    [made] = ordered(method, target, body, tag)
    assert made.asked is not None
    assert (made.asked.method, made.asked.target) == (method, target)
    assert filled_in(meant(made.asked), made.request) == made.request


MATRIX = [
    (operation, dry) for operation in NAMED for dry in ((False, True) if operation.dry_run else (False,))
]


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("operation", "dry"), MATRIX, ids=[f"{one.name}{' dry' * dry}" for one, dry in MATRIX]
)
def test_role_then_etag_decide_whether_an_operation_reaches_control(operation: Operation, dry: bool) -> None:
    """A wrong role gets 403 whatever its ETag.

    Then a missing ETag gets 428, and an invalid ETag 412; a dry run needs no ETag.
    """
    method, target, body = sample(operation)
    target += ("&" if "?" in target else "?") + "dry_run=1" if dry else ""
    allowed = BY_ROLE[LEAST[operation.name]] if not dry else BY_ROLE["operator"]
    tagged = operation.is_change and "expected" in operation.fields()
    for role in ROLES:
        for tag in (None, "", "7", 'W/"7"', '"7", "8"', "*", '"7"'):
            answer = asked(method, target, body, role, tag)
            case = (role, tag, answer.text)
            wrong = tag not in (None, "*", '"7"') and not (dry and tag == "")
            if role not in allowed:
                assert (answer.status_code, answer.json()["type"]) == (403, f"{PROBLEM}not-for-this-role"), (
                    case
                )
            elif tagged and tag is None and not dry:
                assert (answer.status_code, answer.json()["type"]) == (
                    428,
                    f"{PROBLEM}precondition-required",
                ), case
            elif tagged and wrong:
                assert (answer.status_code, answer.json()["type"]) == (412, f"{PROBLEM}changed-meanwhile"), (
                    case
                )
            elif operation.is_change and not dry:
                assert (answer.status_code, len(api()[1].orders)) == (503, 1), case
                continue
            else:
                assert answer.status_code == 200, case
            assert not api()[1].orders, case


def test_the_matrix_has_every_operation() -> None:
    """`LEAST` has every operation and nothing else."""
    assert LEAST.keys() == {operation.name for operation in NAMED}
    assert {operation.name for operation in NAMED if operation.dry_run} == {
        "load_policy", "load_monitors", "replace_monitor",
    }  # fmt: skip


def test_rows_name_fields_of_their_requests() -> None:
    """A misspelt field in a row would be sent elsewhere, or not be protected."""
    for one in OPERATIONS:
        known = {field.name for field in one.fields().values()}
        assert {*one.query, *one.fixed, *one.admin_with, *one.filled} <= known, one.request
        assert set(re.findall(r"{(\w+)", one.path)) <= {*one.fields()}, one.path


@pytest.mark.nightly
def test_pruning_is_for_admins() -> None:
    """Operators load the folder's files; only admins remove monitors whose files the folder does not have."""
    for role, status in (("operator", 403), ("admin", 503)):
        assert asked("POST", "/v1/monitors/reload?prune=1", None, role, "*").status_code == status
    assert "removing files that the folder does not have is for admins" in asked(
        "POST", "/v1/monitors/reload?prune=1", None, "operator", "*"
    ).text  # fmt: skip


BY_HAND = {
    None: {
        "GET /healthz", "GET /readyz", "GET /v1/healthz", "GET /v1/readyz", "GET /v1/openapi.json",
        "GET /v1/authority", "GET /v1/revocations", "POST /v1/enrol", "POST /v1/hosts/{name}/renew",
        "POST /v1/hosts/{name}/renewed",
    },
    "viewer": {
        "GET /metrics", "GET /v1/metrics", "GET /v1/history", "GET /v1/live", "GET /v1/whoami", "GET /v1/evidence",
        "GET /v1/audit", "GET /v1/audit/checkpoints", "GET /v1/audit/export", "GET /v1/audit/stream",
        "GET /v1/audit/summary", "GET /v1/audit/{record_id}", "GET /v1/audit/{record_id}/grant",
        "GET /v1/audit/{record_id}/why",
        "GET /v1/hosts/{name}", "GET /v1/monitors/{name}", "GET /v1/monitors/{name}/history",
        "GET /v1/monitors/{name}/picture", "GET /v1/policy", "GET /v1/policy/explain", "POST /v1/policy/explain",
        "POST /v1/policy/test", "GET /v1/recordings/{recording_id}/timeline",
    },
    "investigator": {
        "GET /v1/recordings/{recording_id}/bag", "GET /v1/recordings/{recording_id}/evidence",
        "GET /v1/recordings/{recording_id}/messages",
    },
    "operator": {"GET /v1/audit/verify", "GET /v1/hosts/{name}/kit"},
}  # fmt: skip
"""The routes that have no row, or a row without a name, by their least role; evidence is for all but viewers."""


def routes() -> dict[str, set[str]]:
    """Return the least roles of each method and path, without the console's."""
    app = application(Listening(), TokenAuthenticator(10, lambda _token: None), Journal(lambda _call: None))
    return {
        f"{method} {re.sub(r':[a-z]+}', '}', str(route.path))}": {
            role for role in roles_of(route.dependant) if role
        }
        for route in iter_route_contexts(app.routes)
        for method in route.methods or ()
        if not is_console(str(route.path))
    }


def test_routes_written_by_hand_are_for_these_roles() -> None:
    """Every route has a row in the tables and requires exactly the role of its row."""
    named = {f"{one.method} {one.path}": one.name for one in NAMED}
    of_table = {
        path: {"operator" if any(one.dry_run and one.name == name for one in NAMED) else LEAST[name]}
        for path, name in named.items()
    }
    by_hand = {path: {role} - {None} for role, paths in BY_HAND.items() for path in paths}
    assert routes() == of_table | by_hand
    for one in OPERATIONS:
        if one.path and f"{one.method} {one.path}" not in named:
            assert by_hand[f"{one.method} {one.path}"] == {one.role}, one


def roles_of(dependant: Any) -> Iterator[str | None]:
    """Yield the least roles that a route requires."""
    if dependant is not None:
        yield getattr(dependant.call, "least", None)
        for one in dependant.dependencies:
            yield from roles_of(one)


@pytest.mark.nightly
def test_every_order_has_its_way() -> None:
    """`REQUESTS` has a request for every kind of order that the api may send."""
    found = {
        type(ordered(method, target, body)[0].request) for method, target, body in REQUESTS
    }  # fmt: skip
    assert found == CHANGES


@pytest.mark.nightly
@pytest.mark.parametrize(("method", "target", "body"), REQUESTS, ids=IDS)
def test_no_field_of_an_order_can_be_another(method: str, target: str, body: Any) -> None:
    """A compromised api cannot change a field of an order, except those that the appliance fills in."""
    [made] = ordered(method, target, body, '"7"')
    assert made.asked is not None
    body = body if isinstance(body, dict) else {}
    for field in msgspec.structs.fields(made.request):
        other = msgspec.structs.replace(
            made.request, **{field.name: _other(getattr(made.request, field.name))}
        )
        filled = field.name == "request" and body.get("request") is None
        assert (filled_in(meant(made.asked), other) == other) is filled, field.name


def _other(value: Any) -> Any:
    """Return a different value of the same type; for None, a number."""
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


@pytest.mark.nightly
def test_control_hears_of_a_client_that_disconnects() -> None:
    """When the client of an order disconnects, its bearer ends, and control withdraws the order."""
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
        """Drop the message."""

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
