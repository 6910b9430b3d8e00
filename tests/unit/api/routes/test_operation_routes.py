import asyncio
import functools
import json
import re
from collections.abc import Iterator
from functools import partial
from typing import Any

import httpx
import msgspec
import pytest
from fastapi import FastAPI
from fastapi.routing import iter_route_contexts
from structlog.testing import capture_logs

from appliance.api.front.access import Bearer
from appliance.api.front.request_gate import is_console
from appliance.api.routes.operation_routes import Answer, OperationCall, is_offered
from appliance.base.withdrawal import WithdrawnError
from appliance.channel import admin
from appliance.channel.admin import A, AdminAnswer, AdminRequest
from appliance.channel.messages.api import RequestMade
from appliance.channel.operations import CHANGES, OPERATIONS
from appliance.channel.operations import REQUESTS as REQUESTS_OF_CONTROL
from appliance.channel.rest_bodies import DATED
from appliance.channel.rest_meaning import call_of, filled_in, order_of
from appliance.channel.rest_operation import Operation, extra_of, plain
from appliance.control.assembly.policies import RevisionChangedError
from appliance.control.errors import SenselessError, TokenRefusedError, UnknownThingError
from appliance.control.operators.admin_socket import AdminServer
from appliance.control.operators.administration import Administration
from appliance.hosts.host_table import HostForbiddenError
from appliance.specifications.specification_files import MonitorsChangedError
from appliance.store.writer_thread import StoreError
from appliance.telemetry.audit_trail import NOT_RECORDED
from tests.support.idle import idle
from tests.support.rest_world import ROLES, RestWorld, idle_application
from tests.support.rows import require_rows

FILES = {"a.rv": "text"}
FIELDS = {"id": "a" * 20, "revision": 3, "topic": "/scan", "name": "zone"}
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
    ("POST", "/v1/monitors?shadow=1&force=1&hold=1", {"files": FILES}),
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
    ("PATCH", "/v1/monitors/a/given", {"values": {"vMax": 0.3}}),
    ("POST", "/v1/guards", {"preset": "speed", "topics": {"command": "/cmd_vel"}}),
    ("POST", "/v1/guards?confirm_within=9&hold=1", {"preset": "fence", "topics": {"command": "/a", "by": "/odom"},
                                                    "values": {"margin": "1"}, "name": "yard", "shadow": True}),
    ("POST", "/v1/guards/driver-check", {"command": "/cmd_vel", "by": "/odom"}),
    ("PATCH", "/v1/guards/fence?hold=1", {"values": {"margin": "0.5"}}),
    ("POST", "/v1/guards/estop/test", None),
    ("POST", "/v1/guards/yard/upgrade", {}),
    ("POST", "/v1/guards/yard/upgrade?confirm_within=300&hold=1", {"topics": {"state": "/joint_states"}}),
    ("POST", "/v1/guards/plan?hold=1", {"name": "fence", "values": {"margin": "0.5"}}),
    ("POST", "/v1/drive/base/assign", {"host": "robot"}),
    ("POST", "/v1/drive/base/free", {}),
    ("POST", "/v1/drive/base/free", {"to": "10.0.0.7"}),
    ("POST", "/v1/drive/base/ask", {"host": "robot"}),
    ("POST", "/v1/approvals/17/approve", {}),
    ("POST", "/v1/approvals/17/approve", {"seconds": 30}),
    ("POST", "/v1/approvals/17/refuse", None),
    ("POST", "/v1/recordings", {}),
    ("POST", "/v1/recordings", {"before": 30, "after": 2.5, "note": "n"}),
    ("POST", "/v1/recordings/memory", {}),
    ("POST", "/v1/recordings/memory", {"since": 7, "until": 9}),
    ("POST", "/v1/recordings/memory", {"since": "2026-11-20T06:20:46.5Z"}),
    ("DELETE", f"/v1/recordings/{'a' * 20}", None),
    ("DELETE", "/v1/tokens/two%20words", None),
    ("POST", "/v1/doors", {"name": "alice"}),
    ("POST", "/v1/doors", {"name": "agent-1", "port": 9091, "source": "10.0.0.7"}),
    ("POST", "/v1/doors/alice/tickets", {"seconds": 3600.5}),
    ("POST", "/v1/door/tickets", None),
    ("DELETE", "/v1/doors/alice", None),
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
    ("POST", "/v1/alarms/acknowledge", {"kind": "monitor-held:zone", "note": "on the way"}),
    ("POST", "/v1/alarms/silence", {"kind": "recorder", "seconds": 3600}),
    ("POST", "/v1/alarms/silence", {"kind": "recorder"}),
    ("POST", "/v1/hosts/reload", None),
    ("POST", "/v1/standby/switch", None),
    ("DELETE", "/v1/hosts/laptop", None),
    ("DELETE", "/v1/sso/sessions/0123456789ab", None),
    ("DELETE", "/v1/sso/people/sso%3Aalice%40example.org", None),
    ("PUT", "/v1/hosts/laptop/ports", {"state": "closed"}),
    ("PUT", "/v1/hosts/10.0.0.7/ports", {"state": "open", "open": [11311], "checked": 1.5}),
    ("PUT", "/v1/hosts/laptop/ports", {"state": "open", "checked": "2026-11-20T06:20:46Z"}),
]  # fmt: skip
BY_ROLE = {
    "viewer": set(ROLES), "investigator": {"investigator"}, "operator": {"operator", "admin"}, "admin": {"admin"},
}  # fmt: skip
NAMED = [operation for operation in OPERATIONS if operation.name]
LEAST = {
    **dict.fromkeys(
        (
            "status", "alarms", "inventory", "limits",
            "policy_revisions", "policy_revision", "graph", "monitors", "monitor_revisions",
            "monitor_revision",
            "recordings", "recording", "guards", "guard_suggestions", "driver_check", "hosts", "host_blocks",
            "challenge", "standby",
            "approvals", "doors", "own_door", "make_own_ticket", "drive", "sign_out",
        ),
        "viewer",
    ),
    "recording_of_memory": "investigator",
    **dict.fromkeys(
        (
            "reload_policy", "roll_back_policy", "confirm_policy", "topic_messages", "reload_monitors",
            "confirm_monitors", "switch_monitors", "switch_monitor", "record_now", "tell_host_ports", "reload_hosts",
            "set_monitor", "block_host", "unblock_host", "acknowledge_alarm", "silence_alarm",
            "make_door_ticket", "plan_guard", "test_guard", "monitor_values",
            "approve", "approval_refuse", "drive_assign", "drive_free", "drive_ask",
        ),
        "operator",
    ),
    **dict.fromkeys(
        (
            "load_policy", "load_monitors", "replace_monitor", "remove_monitors", "remove_monitor",
            "roll_back_monitors", "remove_recording", "tokens", "revoke_token", "enrol_host", "host_token",
            "new_host_kit", "revoke_host", "switch_standby", "new_guard", "set_guard", "upgrade_guard", "check_driver",
            "add_door",
            "remove_door", "sso_sessions", "end_sessions",
        ),
        "admin",
    ),
}  # fmt: skip
"""The lowest role of each operation, by its name in the contract. A dry run is for operators."""

PROBLEM = "urn:rosrv:problem:"
IDS = [f"{method} {path} {number}" for number, (method, path, _body) in enumerate(REQUESTS)]
TAGS = (None, "*", '"7"', "", "7", 'W/"7"', '"7", "8"')  # missing, valid, valid, and four that are none


@functools.cache
def world() -> RestWorld:
    return RestWorld()


def sample(operation: Operation) -> tuple[str, str, Any]:
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
    return {field.name for field in operation.fields().values() if field.required}


def role_for(target: str) -> str:
    return "investigator" if target == "/v1/recordings/memory" else "admin"


@functools.cache
def orders() -> dict[type[AdminRequest[Any]], AdminRequest[Any]]:
    """Return a request of each type."""
    requests = (ordered(method, target, body).request for method, target, body in REQUESTS)
    return {type(request): request for request in requests}


def ordered(method: str, target: str, body: Any, tag: str = "*") -> RequestMade:
    role = role_for(target)
    answer = world().asked(method, target, body, role, tag)
    assert answer.status_code in (200, 201), answer.text
    [made] = world().made
    assert world().carried.orders == [(made.request, f"a-{role}")]
    return made


@pytest.mark.parametrize("tag", ["*", '"7"'])
@pytest.mark.parametrize(("method", "target", "body"), REQUESTS, ids=IDS)
def test_the_api_and_control_understand_the_same(method: str, target: str, body: Any, tag: str) -> None:
    made = ordered(method, target, body, tag)
    assert made.asked is not None
    assert (made.asked.method, made.asked.target) == (method, target)
    assert filled_in(order_of(made.asked), made.request) == made.request


MATRIX = [
    (operation, dry)
    for operation in NAMED
    if operation.name in LEAST
    for dry in ((False, True) if operation.dry_run else (False,))
]


@pytest.mark.parametrize(
    ("operation", "dry"), MATRIX, ids=[f"{one.name}{' dry' * dry}" for one, dry in MATRIX]
)
def test_role_dry_run_and_etag_decide_what_an_operation_does(operation: Operation, dry: bool) -> None:
    method, target, body = sample(operation)
    target += ("&" if "?" in target else "?") + "dry_run=1" if dry else ""
    allowed = BY_ROLE["operator" if dry else LEAST[operation.name]]
    tagged = operation.is_change and "expected" in operation.fields()
    for role in (None, *ROLES):
        for tag in TAGS if tagged and role in allowed else TAGS[:3]:
            answer = world().asked(method, target, body, role, tag)
            expected = 401, "not-recognised"
            if role in allowed:
                wrong = tagged and tag not in TAGS[:3] and not (dry and not tag)
                missing = tagged and tag is None and not dry
                expected = (
                    (412, "changed-meanwhile")
                    if wrong
                    else (428, "precondition-required")
                    if missing
                    else (operation.status, "")
                )
            elif role is not None:
                expected = 403, "not-for-this-role"
            case = (role, tag, answer.text)
            assert answer.status_code == expected[0], case
            if expected[1]:
                require_problem(answer, *expected)
            changes = operation.is_change and not dry and not expected[1]
            assert [who for _order, who in world().carried.orders] == [f"a-{role}"] * changes, case
            if role is None:  # the journal folds equal calls without a token
                assert {row["decision"] for row in world().trail.rows} <= {"deny"}
            elif operation.is_change:
                [record] = world().trail.rows
                denied = bool(expected[1]) and (expected[0] in (401, 403) or not dry)
                assert (record["event"], record["decision"], record["who"], record["status"]) == (
                    "rest call", "deny" if denied else "allow", f"a-{role}", expected[0],
                ), case  # fmt: skip


@pytest.mark.parametrize("request_type", sorted(CHANGES, key=str), ids=lambda one: one.__name__)
def test_control_itself_denies_what_the_api_should_have_denied(request_type: type[AdminRequest[Any]]) -> None:
    assert request_type in orders(), f"add a request that makes a {request_type.__name__} to REQUESTS here"
    made = orders()[request_type]
    another: tuple[str, str, Any] = (
        ("POST", "/v1/policy/confirm", None)
        if "Policy" not in request_type.__name__
        else ("POST", "/v1/recordings", {})
    )
    for asked in (None, ordered(*another).asked):
        for role in ROLES:
            record = world().bypassing(made, role, asked)
            assert (record["event"], record["decision"], record["who"]) == (
                "order refused",
                "deny",
                f"a-{role}",
            )
            assert not world().carried.orders


def test_while_no_record_can_be_written_only_what_helps_then_is_carried_out() -> None:
    works = {
        "host block", "host revoke", "token revoke", "approve", "approval refuse", "drive take", "drive give",
        "drive ask", "door remove", "door visit", "record now", "recording memory", "recording remove", "sso end",
        "sso sign out",
    }  # fmt: skip
    found: dict[str, set[bool]] = {}
    world().trail.log.failure = "disk full"
    try:
        for method, target, body in REQUESTS:
            answer = world().asked(method, target, body, role_for(target), "*")
            for made in world().made:
                verb = admin.verb_of(made.request)
                said = world().play(partial(world().administration.carry_out, made.request, who="operator"))
                done = bool(answer.status_code < 400), said.ok
                found.setdefault(verb, set()).update(done)
                assert all(done) or (answer.status_code, said.error) == (503, NOT_RECORDED), verb
        for request in (admin.TokenAdd("late", "viewer", 60.0), admin.TokenRotate("guest")):
            said = world().play(partial(world().administration.carry_out, request, who="operator"))
            assert said.error == NOT_RECORDED
    finally:
        world().trail.log.failure = None
    assert {verb for verb, done in found.items() if True in done} == works & found.keys()
    assert all(len(done) == 1 for done in found.values())
    assert found.keys() == {str(request.__struct_config__.tag) for request in CHANGES}


REJECTIONS = (
    (RevisionChangedError(7, 8), 412, "changed-meanwhile"),
    (MonitorsChangedError("other", "3.1"), 412, "changed-meanwhile"), (UnknownThingError("none"), 404, "unknown"),
    (SenselessError("odd"), 422, "bad-input"), (TokenRefusedError("wrong"), 422, "refused"),
    (HostForbiddenError("no"), 403, "not-for-this-role"), (WithdrawnError(), 503, "busy"),
    (StoreError("full"), 503, "not-available"), (RuntimeError("a secret detail"), 503, "not-available"),
)  # fmt: skip


@pytest.mark.parametrize("request_", REQUESTS[::9], ids=IDS[::9])
@pytest.mark.parametrize(
    ("error", "status", "kind"), REJECTIONS, ids=[type(rejection[0]).__name__ for rejection in REJECTIONS]
)
def test_a_rejection_by_control_is_a_problem(
    error: Exception, status: int, kind: str, request_: tuple[str, str, Any]
) -> None:
    method, target, body = request_
    if kind == "refused" and target.startswith(("/v1/monitors", "/v1/guards")):
        kind = "specifications-refused"
    world().carried.error = error
    try:
        with capture_logs():
            answer = world().asked(method, target, body, role_for(target), tag="*")
    finally:
        world().carried.error = None
    assert answer.status_code == status, answer.text
    require_problem(answer, status, kind)
    assert "secret" not in answer.text
    assert ("ETag" in answer.headers) is isinstance(error, MonitorsChangedError)
    [record] = world().trail.rows
    assert (record["decision"], record["status"]) == ("deny", status)


BODIES = [request for request in REQUESTS if request[2] is not None]


@pytest.mark.parametrize("sent", BODIES, ids=[f"{body[0]} {body[1]} {n}" for n, body in enumerate(BODIES)])
def test_an_invalid_body_changes_nothing(sent: tuple[str, str, Any]) -> None:
    method, target, body = sent
    role = role_for(target)
    text = target.partition("?")[0] == "/v1/policy" or (method, target[:13]) == ("PUT", "/v1/monitors/")
    other = (415, "wrong-type") if text else (422, "bad-input")
    more = json.dumps({**(body if isinstance(body, dict) else {"text": body}), "unknown": 1}).encode()
    wrong: list[tuple[bytes, str, tuple[int, str]]] = [
        (b"x", "application/x-www-form-urlencoded", other),
        (b"x", "", other),
        (b'{"text": \n oops}', "application/json", (422, "not-json")),
        (b"[" * 100_000, "application/json", (422, "not-json")),
        (b'{"note": "\xff"}', "application/json", (422, "bad-input")),
        (more, "application/json", (422, "bad-input")),
    ]
    wrong += [(content, "text/plain", (422, "bad-input")) for content in (b"", b"\xff")] * text
    for content, kind, problem in wrong:
        answer = world().asked(method, target, content, role, "*", kind=kind)
        assert answer.status_code == problem[0], (content[:50], kind, answer.text)
        require_problem(answer, *problem)
        assert not world().made
        if b"oops" in content:
            assert (answer.json()["line"], answer.json()["column"]) == (2, 2)


WRONG: dict[str, list[Any]] = {
    "POST /v1/hosts": [
        {"name": "laptop"} | wrong
        for wrong in (
            {"name": "../a"}, {"endpoint": "a b"}, {"how": "post"}, {"days": 0}, {"open": ["ssh"]}, {"ports": "70000"},
        )
    ],
    "PATCH /v1/monitors/a": [
        {}, {"held": True}, {"enabled": True, "held": False}, {"enabled": "yes"}, {"shadow": 1},
        {"shadow": False, "enabled": True},
    ],
    "POST /v1/monitors": [
        {"files": {}}, {"files": {"../a.rv": ""}}, {"files": {"a.txt": ""}}, {"files": {".rv": ""}},
        {"files": FILES, "note": "x" * 201}, {"files": FILES, "definitions": {"../T.msg": ""}},
        {"files": {"a.rv": 7}},
    ],
    "POST /v1/policy?confirm_within=0": ["x"],
    "POST /v1/policy?confirm_within=nan": ["x"],
    "POST /v1/policy/rollback": [{"revision": 0}],
    "PUT /v1/hosts/a/ports": [{"state": "ajar"}],
    "POST /v1/blocks": [{"address": "10.0.0.7", "for_seconds": -1}],
    "DELETE /v1/recordings/x": [None],
    "DELETE /v1/monitors": [None],
}  # fmt: skip


@pytest.mark.parametrize(
    ("method", "target", "body"), [(*call.split(), body) for call, bodies in WRONG.items() for body in bodies]
)
def test_a_field_out_of_bounds_changes_nothing(method: str, target: str, body: Any) -> None:
    answer = world().asked(method, target, body, tag="*")
    assert answer.status_code in (404, 422), answer.text
    assert answer.json()["detail"]
    assert not world().made


@pytest.mark.parametrize("path", ["/v1/monitors", "/v1/policy", "/v1/policy/explain", "/v1/policy/rollback"])
@pytest.mark.parametrize(
    "body",
    [
        b"[" * 500_000, b'{"a":' * 100_000, b'{"files":{' + b'"x":{' * 50_000,
        b'{"text":' + b"9" * 300_000 + b"}",
        b"1e" + b"9" * 100_000, b'{"a":1,' * 90_000, b'"\\ud800"', b"\xef\xbb\xbf{}",
        b'{"files":{' + b",".join(b'"f%d.rv":""' % one for one in range(50_000)) + b"}}",
    ],
    ids=[
        "deep", "deep objects", "deep files", "long number", "huge exponent", "no end", "surrogate", "bom",
        "many files",
    ],
)  # fmt: skip
def test_hostile_json_is_rejected(path: str, body: bytes) -> None:
    answer = world().asked("POST", path, body, "admin", "*", kind="application/json")
    assert answer.status_code in (413, 415, 422), answer.text[:300]
    assert answer.headers["content-type"] == "application/problem+json"
    assert not world().made


def require_problem(answer: httpx.Response, status: int, kind: str) -> None:
    assert answer.headers["content-type"] == "application/problem+json"
    document = json.loads(answer.text)
    assert (document["type"], document["status"]) == (f"{PROBLEM}{kind}", status)
    assert document["title"]
    assert document["detail"]


@pytest.mark.complete
def test_the_matrix_has_every_operation() -> None:
    require_rows((one.name for one in NAMED), LEAST, "LEAST here, with the least role that may call it")
    assert {operation.name for operation in NAMED if operation.dry_run} == {
        "load_policy", "load_monitors", "replace_monitor",
    }  # fmt: skip


def test_rows_name_fields_of_their_requests() -> None:
    for one in OPERATIONS:
        known = {field.name for field in one.fields().values()}
        assert {*one.query, *one.fixed, *one.admin_with, *one.filled} <= known, one.request
        assert set(re.findall(r"{(\w+)", one.path)) <= {*one.fields()}, one.path


def test_pruning_is_for_admins() -> None:
    target = "/v1/monitors/reload?prune=1"
    assert world().asked("POST", target, None, "admin", "*").status_code == 200
    answer = world().asked("POST", target, None, "operator", "*")
    assert "removing files that the folder does not have is for admins" in answer.text
    assert not world().carried.orders


BY_HAND = {
    None: {
        "GET /healthz", "GET /readyz", "GET /v1/healthz", "GET /v1/readyz", "GET /v1/openapi.json",
        "GET /v1/openapi.html",
        "GET /v1/authority", "GET /v1/revocations", "POST /v1/enrol", "POST /v1/hosts/{name}/renew",
        "POST /v1/hosts/{name}/renewed",
        "POST /v1/sso/begin", "POST /v1/sso/complete",
    },
    "viewer": {
        "GET /metrics", "GET /v1/metrics", "GET /v1/history", "GET /v1/live", "GET /v1/whoami", "GET /v1/evidence",
        "GET /v1/audit", "GET /v1/audit/checkpoints", "GET /v1/audit/export", "GET /v1/audit/stream",
        "GET /v1/audit/summary", "GET /v1/audit/{record_id}", "GET /v1/audit/{record_id}/grant",
        "GET /v1/audit/{record_id}/why",
        "GET /v1/hosts/{name}", "GET /v1/monitors/{name}", "GET /v1/monitors/{name}/history",
        "GET /v1/monitors/{name}/picture", "GET /v1/policy", "GET /v1/policy/explain", "POST /v1/policy/explain",
        "GET /v1/policy/hosts", "GET /v1/policy/uses",
        "POST /v1/policy/test", "GET /v1/recordings/{recording_id}/timeline",
    },
    "investigator": {
        "GET /v1/recordings/{recording_id}/bag", "GET /v1/recordings/{recording_id}/evidence",
        "GET /v1/recordings/{recording_id}/messages",
    },
    "operator": {"GET /v1/audit/verify", "GET /v1/hosts/{name}/kit"},
}  # fmt: skip
"""The routes without a row or a name, by their least role; evidence is for all but viewers."""


def served() -> Iterator[tuple[str, Any]]:
    for route in iter_route_contexts(idle_application().routes):
        for method in route.methods or ():
            if not is_console(str(route.path)):
                yield f"{method} {re.sub(r':[a-z]+}', '}', str(route.path))}", route


def test_each_path_is_served_once() -> None:
    paths = [path for path, _ in served()]
    assert sorted(paths) == sorted(set(paths))


def routes() -> dict[str, set[str]]:
    return {path: {role for role in roles_of(route.dependant) if role} for path, route in served()}


def test_routes_written_by_hand_are_for_these_roles() -> None:
    named = {f"{one.method} {one.path}": one.name for one in NAMED}
    of_table = {
        path: {"operator" if any(one.dry_run and one.name == name for one in NAMED) else LEAST[name]}
        for path, name in named.items()
        if name in LEAST
    }
    by_hand = {path: {role} - {None} for role, paths in BY_HAND.items() for path in paths}
    expected, missing = of_table | by_hand, named.keys() - of_table.keys()
    wrong = [
        f"{path} is for {sorted(map(str, roles))}: list it so in BY_HAND here"
        for path, roles in routes().items()
        if path not in missing and roles != expected.get(path)
    ]
    assert not wrong, "\n".join(wrong)
    assert routes().keys() >= expected.keys()
    for operation in OPERATIONS:
        if operation.path and f"{operation.method} {operation.path}" not in named:
            assert by_hand[f"{operation.method} {operation.path}"] == {operation.role}, operation


def roles_of(dependant: Any) -> Iterator[str | None]:
    if dependant is not None:
        yield getattr(dependant.call, "least", None)
        for dependency in dependant.dependencies:
            yield from roles_of(dependency)


def test_a_role_is_judged_before_the_request() -> None:
    """A request is checked only for a caller that may make it."""
    judged = 0
    for path, roles in routes().items():
        method, _, target = path.partition(" ")
        target = re.sub(r"\{[a-z_]+\}", "a" * 20, target) + "?limit=wrong&dry_run=wrong"
        for role in ROLES[: max((ROLES.index(role) for role in roles), default=0)]:
            answer = world().asked(method, target, None if method == "GET" else {"wrong": 1}, role)
            assert answer.status_code == 403, (path, role, answer.text)
            require_problem(answer, 403, "not-for-this-role")
            judged += 1
    assert judged > 80


@pytest.mark.complete
def test_every_order_has_its_way() -> None:
    made = {type(ordered(method, target, body).request) for method, target, body in REQUESTS}
    require_rows(
        (change.__name__ for change in CHANGES),
        (one.__name__ for one in made),
        "REQUESTS here, as a request that makes it",
    )


@pytest.mark.parametrize(("method", "target", "body"), REQUESTS, ids=IDS)
def test_no_field_of_an_order_can_be_another(method: str, target: str, body: Any) -> None:
    made = ordered(method, target, body, '"7"')
    assert made.asked is not None
    body = body if isinstance(body, dict) else {}
    for field in msgspec.structs.fields(made.request):
        other = msgspec.structs.replace(
            made.request, **{field.name: _other(getattr(made.request, field.name))}
        )
        filled = field.name == "request" and body.get("request") is None
        assert (filled_in(order_of(made.asked), other) == other) is filled, field.name


def _other(value: Any) -> Any:
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


def test_control_hears_of_a_client_that_disconnects() -> None:
    gate, control, tokens = world().gate, world().control, world().tokens.texts
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

    async def send(_message: Any) -> None: ...

    scope = {
        "type": "http", "http_version": "1.1", "method": "POST", "path": "/v1/policy/confirm", "query_string": b"",
        "raw_path": b"/v1/policy/confirm", "scheme": "http", "client": ("127.0.0.1", 1), "server": ("127.0.0.1", 80),
        "headers": [
            (b"host", b"127.0.0.1"), (b"if-match", b"*"), (b"authorization", f"Bearer {tokens['admin']}".encode()),
        ],
    }  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(control, "ask", asked)
        world().play(lambda: gate(scope, receive, send))
    assert seen == ["body", admin.PolicyConfirm]


def test_without_an_answer_that_makes_a_dry_run_the_operation_is_not_offered() -> None:
    """Otherwise a load that only asks for its effect would come into force."""

    async def makes_it(_call: OperationCall[Any]) -> None: ...

    named = [operation for operation in OPERATIONS if operation.name]
    assert any(one.dry_run for one in named)
    assert [one for one in named if not is_offered(one, None)] == [one for one in named if one.dry_run]
    assert all(is_offered(one, Answer(makes_it)) for one in named)


KEYS = ("x{}", "a{}.rv", "a/B{}.msg", "10-2{}", "tcp/{}", "f{}".rjust(14, "f"), "f{}".rjust(22, "f"))
ONLY_THE_API = {"endpoint", "ports", "open", "dry_run", "held", "how"}
"""Fields that choose an order, and those of a kit, which the api itself uses."""


def valid(schema: dict[str, Any], number: int = 1) -> Any:
    """Return a value that a schema permits; those of two numbers differ if they are strings."""
    if "anyOf" in schema:
        return valid(schema["anyOf"][0], number)
    if schema["type"] in ("array", "object"):
        return collection(schema, 1)
    texts = (text.format(number) for text in KEYS)
    text = next((text for text in texts if re.search(schema.get("pattern", ""), text)), "")
    return {"string": text, "boolean": False}.get(schema["type"], schema.get("minimum", 1))


def collection(schema: dict[str, Any], size: int) -> Any:
    if schema["type"] == "array":
        return [valid(schema["items"], number) for number in range(size)]
    return {valid(keys(schema), number): valid(schema["additionalProperties"]) for number in range(size)}


def keys(schema: dict[str, Any]) -> dict[str, Any]:
    names: dict[str, Any] = schema.get("propertyNames", {})
    return {"type": "string"} | names


def beyond(schema: dict[str, Any]) -> Iterator[Any]:
    """Yield a value beyond each bound of a schema."""
    for bound, limit in schema.items():
        match bound:
            case "maxLength" | "minLength":
                yield "x" * (limit + 1 if bound == "maxLength" else limit - 1)
            case "pattern":
                yield "\n"
            case "minimum" | "maximum" | "exclusiveMinimum":
                yield limit + {"maximum": 1, "minimum": -1}.get(bound, 0)
            case "maxItems" | "maxProperties" | "minItems" | "minProperties":
                yield collection(schema, limit + (1 if bound.startswith("max") else -1))
            case "anyOf":
                yield from (wrong for arm in limit for wrong in beyond(arm))
            case "items":
                yield from ([wrong] for wrong in beyond(limit))
            case "additionalProperties" if limit:
                yield from ({valid(keys(schema)): wrong} for wrong in beyond(limit))
                yield from ({wrong: valid(limit)} for wrong in beyond(keys(schema)))
            case _:
                assert bound not in {"exclusiveMaximum", "multipleOf", "$ref"}, bound


def bounded(operation: Operation, document: dict[str, Any]) -> Iterator[tuple[Operation, str, Any]]:
    """Yield each value beyond a bound of the contract, with its field and each operation that takes the field."""
    shown = document["paths"][operation.path][operation.method.lower()]
    schemas = {one["name"]: one["schema"] for one in shown.get("parameters", ()) if one["in"] != "header"}
    if operation.body is not None:
        name = shown["requestBody"]["content"]["application/json"]["schema"]["$ref"].rpartition("/")[2]
        schemas |= document["components"]["schemas"][name]["properties"]
    same = [one for one in OPERATIONS if (one.method, one.path) == (operation.method, operation.path)]
    for name, schema in schemas.items():
        fields = [
            (one, field.name)
            for one in same
            for known, field in one.fields().items()
            if name in (known, field.name)
        ]
        assert fields or name in ONLY_THE_API, name
        yield from ((one, field, wrong) for wrong in beyond(schema) for one, field in fields)


@pytest.mark.parametrize("operation", NAMED, ids=lambda one: one.name)
def test_control_checks_each_bound_of_the_contract(operation: Operation, app: FastAPI) -> None:
    server = AdminServer(idle(Administration))
    for taker, field, wrong in bounded(operation, app.openapi()):
        if (field, wrong) == ("request", ""):
            continue  # the api makes the request
        order = orders().get(taker.request) or taker.request(
            **{name: FIELDS[name] for name in fields_of(taker)}
        )
        sample = msgspec.to_builtins(order)
        listed = isinstance(sample[field], list) and not isinstance(wrong, list)
        line = json.dumps(sample | {field: [wrong] if listed else wrong}).encode()
        answer = asyncio.run(server.answer(line))
        assert (answer.ok, answer.trouble) == (False, "request"), (field, str(wrong)[:80])
        assert answer.error.startswith(field), answer.error


def test_a_post_that_makes_something_answers_201() -> None:
    """These rules have the exceptions of earlier releases; a new operation has none."""
    listed = {one.path for one in NAMED if one.method == "GET"}
    made = [one for one in NAMED if one.method == "POST" and one.path in listed]
    otherwise = {one.name for one in made if one.status != 201}
    assert otherwise == {"load_monitors", "block_host", "new_guard", "check_driver"}


def test_an_unknown_name_is_answered_with_404() -> None:
    otherwise = {one.name for one in NAMED if "{" in one.path and 404 not in one.problems}
    assert otherwise == {"revoke_token", "host_token"}


def test_lengths_of_time_end_in_seconds() -> None:
    numbers = {
        field.name
        for request in REQUESTS_OF_CONTROL
        for field in msgspec.structs.fields(request)
        if plain(field.type) is float and not extra_of(field.type, DATED)
    }
    otherwise = {name for name in numbers if not name.endswith("seconds")}
    assert otherwise == {"confirm_within", "before", "after", "days", "grace", "patience"}
