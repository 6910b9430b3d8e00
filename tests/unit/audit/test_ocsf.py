"""Tests of records as events of OCSF 1.6.0, held against a schema made from its published class definitions."""

import json
from typing import Any

import jsonschema_rs
import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.audit.events import EVENTS
from appliance.audit.ocsf import API, CLASSES, FINDING, KINDS, as_ocsf, as_ocsf_line
from appliance.audit.output import Entry
from appliance.audit.record import Record, RuleReference, Severity
from distribution.audit_events_page import ELSEWHERE

_TIME = 1_700_000_000_123_456_789

# Of each class: what it requires beyond what every event does, what it has besides, its activities.
_CLASSES: dict[int, tuple[list[str], list[str], int]] = {
    1008: ([], ["src_endpoint", "dst_endpoint", "log_name", "log_type_id", "file"], 10),
    2004: (["finding_info"], ["evidences", "resources", "comment"], 3),
    3004: (["entity"], ["entity_result", "src_endpoint", "comment", "access_list"], 13),
    4001: ([], ["src_endpoint", "dst_endpoint", "connection_info", "traffic", "url"], 7),
    4014: ([], ["src_endpoint", "dst_endpoint", "session", "tunnel_type_id", "user"], 3),
    6002: (["app"], [], 8),
    6003: (
        ["api", "actor", "src_endpoint"],
        ["dst_endpoint", "resources", "http_request", "http_response"],
        4,
    ),
}
_REQUIRED = ["activity_id", "category_uid", "class_uid", "metadata", "severity_id", "time", "type_uid"]
# Of every event, with the profiles `host` and `security_control`.
_EVERY = [
    *_REQUIRED, "activity_name", "message", "status_id", "status_code", "status_detail", "count", "start_time",
    "end_time", "duration", "unmapped", "observables", "actor", "device", "action_id", "disposition_id", "is_alert",
    "authorizations", "policy",
]  # fmt: skip
_TEXT = {"type": "string"}
_WHOLE = {"type": "integer", "minimum": 0}


def _object(required: list[str], any_of: list[str], **properties: Any) -> dict[str, Any]:
    schema = {"type": "object", "required": required, "properties": properties, "additionalProperties": False}
    return schema | ({"anyOf": [{"required": [name]} for name in any_of]} if any_of else {})


def _one_of(*numbers: int) -> dict[str, Any]:
    return {"enum": list(numbers)}


_ENDPOINT = _object([], ["ip", "name", "hostname"], ip=_TEXT, name=_TEXT, hostname=_TEXT)
_USER = _object([], ["name", "uid"], name=_TEXT, uid=_TEXT)
_ACTOR = _object([], ["user", "app_name"], user=_USER, app_name=_TEXT)
_ATTRIBUTES: dict[str, Any] = {
    "activity_name": _TEXT, "message": _TEXT, "status_code": _TEXT, "time": {"type": "integer"},
    "count": _WHOLE, "start_time": {"type": "integer"}, "end_time": {"type": "integer"},
    "severity_id": _one_of(0, 1, 2, 3, 4, 5, 6, 99), "is_alert": {"type": "boolean"},
    "action_id": _one_of(0, 1, 2, 3, 4, 99), "disposition_id": _one_of(*range(28), 99),
    "unmapped": {"type": "object"}, "actor": _ACTOR, "src_endpoint": _ENDPOINT,
    "api": _object(["operation"], [], operation=_TEXT),
    "app": _object([], ["name"], name=_TEXT),
    "metadata": _object(
        ["version", "product"], [], version={"const": "1.6.0"}, uid=_TEXT, sequence=_WHOLE, event_code=_TEXT,
        product=_object(["name", "vendor_name", "version"], [], name=_TEXT, vendor_name=_TEXT, version=_TEXT),
        profiles={"type": "array", "items": _TEXT}, original_time=_TEXT, log_name=_TEXT, log_level=_TEXT,
        log_version=_TEXT, is_truncated={"type": "boolean"},
    ),
    "finding_info": _object(
        ["uid"], [], uid=_TEXT, title=_TEXT,
        analytic=_object(["type_id"], [], name=_TEXT, type_id=_one_of(*range(12), 99)),
    ),
    "evidences": {
        "type": "array", "items": _object([], ["actor", "src_endpoint"], actor=_ACTOR, src_endpoint=_ENDPOINT),
    },
    "resources": {"type": "array", "items": _object([], ["name", "type"], name=_TEXT, type=_TEXT)},
    "entity": _object([], ["name"], name=_TEXT, type=_TEXT, type_id=_one_of(0, 1, 2, 3, 4, 5, 6, 7, 99)),
    "authorizations": {
        "type": "array",
        "items": _object([], [], decision=_TEXT, policy=_object([], ["name", "uid"], name=_TEXT, version=_TEXT)),
    },
}  # fmt: skip


def _schema_of(class_uid: int) -> dict[str, Any]:
    required, more, activities = _CLASSES[class_uid]
    statuses = _one_of(0, 1, 2, 3, 4, 5, 6, 99) if class_uid == FINDING else _one_of(0, 1, 2, 99)
    known = {name: _ATTRIBUTES.get(name, {}) for name in (*_EVERY, *required, *more)}
    one_activity = [
        {"properties": {"activity_id": {"const": one}, "type_uid": {"const": class_uid * 100 + one}}}
        for one in (*range(activities + 1), 99)
    ]
    properties = known | {
        "class_uid": {"const": class_uid},
        "category_uid": {"const": class_uid // 1000},
        "status_id": statuses,
        "activity_id": {"type": "integer"},
        "type_uid": {"type": "integer"},
    }
    schema: dict[str, Any] = _object([*_REQUIRED, *required], [], **properties) | {"oneOf": one_activity}
    if class_uid == 4014:
        schema["anyOf"] = [{"required": [name]} for name in ("session", "src_endpoint", "tunnel_type_id")]
    return schema


_SCHEMAS = {class_uid: jsonschema_rs.Draft202012Validator(_schema_of(class_uid)) for class_uid in _CLASSES}


def entry(event: str, **fields: Any) -> Entry:
    """A record at place 7."""
    all_fields: dict[str, Any] = {"id": "0" * 20, "time": _TIME, "event": event} | fields
    return Entry(7, Record(**all_fields))


def valid(event: dict[str, Any]) -> dict[str, Any]:
    """The event, which its class allows."""
    errors = [
        f"{one.instance_path}: {one.message}" for one in _SCHEMAS[event["class_uid"]].iter_errors(event)
    ]
    assert errors == []
    if event["activity_id"] == 99:
        assert event["activity_name"]
    return event


def test_every_event_has_a_class() -> None:
    """The table is complete, and has no event that the catalogue has not."""
    assert KINDS.keys() == EVENTS.keys()
    assert {kind.class_uid for kind in KINDS.values()} == set(CLASSES) == set(_CLASSES)


@pytest.mark.parametrize("severity", list(Severity))
@pytest.mark.parametrize("event", list(EVENTS))
def test_every_event_is_as_its_class_says(event: str, severity: Severity) -> None:
    """With nothing but a name, and with everything a record can have."""
    valid(as_ocsf(entry(event, severity=severity)))
    detail: dict[str, Any] = dict.fromkeys(ELSEWHERE.get(event, ()), "x")
    full = entry(
        event, severity=severity, decision="deny", host="10.0.0.66", caller_id="/evil", category="publish",
        resource="/cmd_vel", rule=RuleReference("Publishers", "/cmd_vel", "robot.ini", 12), revision=3, reason="why",
        duration_us=12, detail=detail | {"who": "alice", "count": 3, "first_time": _TIME, "last_time": _TIME},
    )  # fmt: skip
    made = valid(as_ocsf(full))
    text = json.dumps(made)
    for value in ("10.0.0.66", "/cmd_vel", "why", "alice", "robot.ini:12"):
        assert value in text, (value, made)
    assert made["metadata"]["log_level"] == severity.value


def test_a_schema_that_refuses() -> None:
    """The schema finds what is missing, wrong or of another class: it could fail."""
    wrongs: list[dict[str, Any]] = [
        {"actor": {}},
        {"activity_id": 77},
        {"type_uid": 600300},
        {"app": {"name": "x"}},
        {"status_id": 5},
        {"src_endpoint": None},
    ]
    for wrong in wrongs:
        assert not _SCHEMAS[API].is_valid(as_ocsf(entry("decision")) | wrong), wrong


def test_a_denial() -> None:
    """A denied publisher: who, from where, what, by which rule; each where OCSF has it."""
    made = as_ocsf(
        entry(
            "decision", severity=Severity.WARNING, decision="deny", host="10.0.0.66", caller_id="/evil",
            category="publish", resource="/cmd_vel", revision=3, reason="[Publishers] /cmd_vel does not have it",
            rule=RuleReference("Publishers", "/cmd_vel", "robot.ini", 12), detail={"call": "registerPublisher"},
        )
    )  # fmt: skip
    assert (made["category_uid"], made["class_uid"], made["activity_id"], made["type_uid"]) == (
        6,
        6003,
        1,
        600301,
    )
    assert made["time"] == 1_700_000_000_123
    assert (made["action_id"], made["disposition_id"], made["status_id"]) == (2, 2, 2)
    assert made["actor"] == {"app_name": "/evil"}
    assert made["src_endpoint"] == {"ip": "10.0.0.66"}
    assert made["api"] == {"operation": "registerPublisher"}
    assert made["resources"] == [{"name": "/cmd_vel", "type": "publish"}]
    (authorization,) = made["authorizations"]
    assert authorization["policy"] == {"name": "[Publishers] /cmd_vel robot.ini:12", "version": "3"}
    assert made["unmapped"] == {"detail": {"call": "registerPublisher"}}
    assert made["metadata"]["uid"] == "0" * 20


@pytest.mark.parametrize(
    ("call", "activity"),
    [
        ("registerSubscriber", 1),
        ("unregisterService", 4),
        ("getParam", 2),
        ("setParam", 3),
        ("deleteParam", 4),
        ("unsubscribeParam", 4),
        ("noSuchCall", 99),
    ],
)
def test_the_activity_of_a_call(call: str, activity: int) -> None:
    """What is made, read, changed and ended is told apart; what is no call of the ROS Master is something else."""
    made = valid(as_ocsf(entry("decision", detail={"call": call})))
    assert made["activity_id"] == activity


def test_a_change_by_a_person() -> None:
    """Who loaded a policy is a user; a node's name never is."""
    made = as_ocsf(entry("policy loaded", detail={"who": "alice", "file": "robot.ini"}))
    assert made["actor"] == {"user": {"name": "alice"}}
    assert made["entity"] == {"name": "robot.ini", "type": "Policy", "type_id": 5}


def test_a_monitors_drop() -> None:
    """A finding: of which monitor, about what, dropped; its details are kept."""
    detail = {"monitor": "speed", "happened": "drop", "number": 4}
    made = as_ocsf(
        entry(
            "message dropped", severity=Severity.ALARM, resource="/cmd_vel", category="topic", detail=detail
        )
    )
    assert made["finding_info"]["analytic"] == {"name": "speed", "type_id": 1}
    assert (made["action_id"], made["disposition_id"], made["is_alert"]) == (2, 6, True)
    assert made["unmapped"]["detail"] == detail


@pytest.mark.parametrize(
    ("found", "closed"), [("probe failed", "probe passed"), ("disk nearly full", "disk has room")]
)
def test_a_finding_that_is_closed(found: str, closed: str) -> None:
    """What is over closes the finding that was made when it began."""
    begun, over = as_ocsf(entry(found)), as_ocsf(entry(closed))
    assert begun["finding_info"]["uid"] == over["finding_info"]["uid"]
    assert (begun["activity_id"], over["activity_id"], over["status_id"]) == (1, 3, 4)


def test_repetitions() -> None:
    """A summary has how many, and when the first and the last were."""
    detail = {"count": 1000, "first_time": _TIME, "last_time": _TIME + 5_000_000_000, "call": "getParam"}
    made = valid(as_ocsf(entry("denials folded", decision="deny", detail=detail)))
    assert (made["count"], made["start_time"], made["end_time"]) == (
        1000,
        1_700_000_000_123,
        1_700_000_005_123,
    )


@given(
    event=st.sampled_from(list(EVENTS)),
    texts=st.fixed_dictionaries(
        {name: st.text(max_size=4096) for name in ("host", "caller_id", "category", "resource", "reason")}
    ),
    detail=st.dictionaries(
        st.sampled_from(["call", "who", "status", "name", "x"]), st.text(max_size=3000), max_size=5
    ),
    longest=st.integers(1024, 8192),
)
def test_strangers_text(event: str, texts: dict[str, str], detail: dict[str, str], longest: int) -> None:
    """Whatever a stranger is called, the line is printable ASCII, valid, and not longer than it may be."""
    record = entry(event, **texts, detail=detail)
    for line in (as_ocsf_line(record), as_ocsf_line(record, longest)):
        assert line.isascii()
        assert line.isprintable()
        valid(json.loads(line))
    assert len(line) <= longest


def test_what_is_too_long_says_so() -> None:
    """The details go first; the event says that something is missing, and keeps its names."""
    long = entry(
        "decision", caller_id="/evil", resource="/cmd_vel", detail={"call": "setParam", "x": "y" * 9000}
    )
    made = valid(json.loads(as_ocsf_line(long, 2048)))
    assert made["metadata"]["is_truncated"] is True
    assert (made["actor"]["app_name"], made["resources"][0]["name"]) == ("/evil", "/cmd_vel")
    assert made["unmapped"] == {"detail": {"call": "setParam"}}
    assert "is_truncated" not in as_ocsf(long)["metadata"]


def test_an_event_of_a_later_version() -> None:
    """A name that this version does not know is an event of the log, of another activity."""
    made = valid(as_ocsf(entry("something new")))
    assert (made["class_uid"], made["activity_id"], made["activity_name"]) == (1008, 99, "something new")
