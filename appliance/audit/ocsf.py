"""A record as an event of the Open Cybersecurity Schema Framework, OCSF 1.6.0. No I/O.

Invariants:

1. Every event of the catalogue has one class and one activity of that class (`KINDS`); of what was asked of the ROS
   Master or over REST the activity is that of the call.
2. What OCSF has a place for stands there; the rest stands in `unmapped`, under its name in the record.
3. What a node called itself is a claim: it stands as the name of an application, never as that of a user.
4. The same record gives the same event, in ASCII, and its `metadata.uid` is the record's id.
"""

import ipaddress
import json
from typing import Any, NamedTuple

import msgspec

import appliance
from appliance.audit.output import Entry, rfc3339, rule_text
from appliance.audit.record import SCHEMA_VERSION, Record, RuleReference, Severity

VERSION = "1.6.0"
LOG, FINDING, ENTITY, NETWORK, TUNNEL, LIFECYCLE, API = 1008, 2004, 3004, 4001, 4014, 6002, 6003
CLASSES = {
    LOG: "Event Log Activity", FINDING: "Detection Finding", ENTITY: "Entity Management",
    NETWORK: "Network Activity", TUNNEL: "Tunnel Activity", LIFECYCLE: "Application Lifecycle", API: "API Activity",
}  # fmt: skip
"""Class ids and their captions; the thousands are the category."""

_OTHER = 99
_BY_CALL = -1
_CREATE, _READ, _UPDATE, _DELETE = 1, 2, 3, 4  # of API Activity; Entity Management has the same
# Entity Management
_ENROL, _UNENROL, _ENABLE, _DISABLE, _ACTIVATE, _DEACTIVATE, _RESUME = 6, 7, 8, 9, 10, 11, 13
_START, _STOP, _RESTART, _CHANGED = 3, 4, 5, 8  # Application Lifecycle
_LOG_DELETE, _LOG_START, _LOG_STOP, _LOG_RESTART = 2, 6, 7, 8  # Event Log Activity
_FOUND, _CLOSED = 1, 3  # Detection Finding
# Network and Tunnel Activity; the last of Tunnel alone
_OPEN, _CLOSE, _REFUSE, _TRAFFIC, _RENEW = 1, 2, 5, 6, 3
_CALLS = (  # how the calls of the ROS Master and of HTTP begin
    (_CREATE, ("register", "subscribe", "POST")),
    (_READ, ("get", "has", "lookup", "search", "GET", "HEAD")),
    (_UPDATE, ("set", "PUT", "PATCH")),
    (_DELETE, ("unregister", "unsubscribe", "delete", "DELETE")),
)

# action_id and disposition_id
_ALLOWED, _BLOCKED, _REVOKED, _REJECTED, _DROPPED = (1, 1), (2, 2), (2, 24), (2, 25), (2, 6)
_DETECTED, _LOGGED, _CORRECTED = (3, 15), (3, 17), (4, 11)
_DECISIONS = {"allow": _ALLOWED, "deny": _BLOCKED, "would deny": _DETECTED}
_SEVERITIES = {
    Severity.DEBUG: 1, Severity.INFO: 1, Severity.NOTICE: 2, Severity.WARNING: 3, Severity.ALARM: 5,
}  # fmt: skip
_ENTITIES = {"Device": 1, "Policy": 5}
_TEXTS = (4096, 512, 128, 32, 8, 2)  # characters; one of a stranger's takes up to 12 bytes
_PLACED = ("call", "method", "verb", "who", "status", "count", "name", "token", "file", "monitor")
_SPAN = (("start_time", "first_time"), ("end_time", "last_time"))
_FAILURES = ("refused", "failed", "died", "lost", "ended", "gap")


class Kind(NamedTuple):
    """Class and activity of an event.

    `outcome` is what was done where the record has no decision; `about` is the type of the entity that is managed, or
    what a finding is about that is closed later.
    """

    class_uid: int
    activity_id: int
    outcome: tuple[int, int] | None = None
    about: str = ""


KINDS: dict[str, Kind] = {
    "decision": Kind(API, _BY_CALL),
    "registered": Kind(API, _CREATE),
    "unregistered": Kind(API, _DELETE),
    "revoked": Kind(API, _DELETE, _REVOKED),
    "node lost": Kind(LIFECYCLE, _STOP),
    "node returned": Kind(LIFECYCLE, _START),
    "replaced": Kind(API, _UPDATE),
    "takeover": Kind(API, _UPDATE),
    "policy loaded": Kind(ENTITY, _UPDATE, about="Policy"),
    "policy confirmed": Kind(ENTITY, _ACTIVATE, about="Policy"),
    "policy refused": Kind(ENTITY, _UPDATE, _REJECTED, "Policy"),
    "host enrolled": Kind(ENTITY, _ENROL, about="Device"),
    "host renewed": Kind(ENTITY, _UPDATE, about="Device"),
    "host revoked": Kind(ENTITY, _UNENROL, about="Device"),
    "certificate ends soon": Kind(FINDING, _FOUND, _DETECTED),
    "certificate ended": Kind(ENTITY, _DEACTIVATE, about="Device"),
    "host awaited": Kind(ENTITY, _CREATE, about="Device"),
    "host awaited no longer": Kind(ENTITY, _DELETE, about="Device"),
    "hosts reloaded": Kind(ENTITY, _UPDATE, about="Device"),
    "enrolment refused": Kind(ENTITY, _ENROL, _BLOCKED, "Device"),
    "renewal refused": Kind(ENTITY, _UPDATE, _BLOCKED, "Device"),
    "ports checked": Kind(FINDING, _FOUND, _DETECTED),
    "topics moved": Kind(LIFECYCLE, _CHANGED),
    "tunnel up": Kind(TUNNEL, _OPEN),
    "tunnel moved": Kind(TUNNEL, _RENEW),
    "tunnel down": Kind(TUNNEL, _CLOSE),
    "tunnel refused": Kind(TUNNEL, _OPEN, _BLOCKED),
    "packets refused": Kind(NETWORK, _TRAFFIC, _DROPPED),
    "specifications confirmed": Kind(ENTITY, _ACTIVATE, about="Specifications"),
    "specifications loaded": Kind(ENTITY, _UPDATE, about="Specifications"),
    "specifications refused": Kind(ENTITY, _UPDATE, _REJECTED, "Specifications"),
    "monitor enabled": Kind(ENTITY, _ENABLE, about="Monitor"),
    "monitor disabled": Kind(ENTITY, _DISABLE, about="Monitor"),
    "monitor on trial": Kind(ENTITY, _UPDATE, about="Monitor"),
    "trial observed": Kind(FINDING, _FOUND, _LOGGED),
    "monitor resumed": Kind(ENTITY, _RESUME, about="Monitor"),
    "monitors restarted": Kind(LIFECYCLE, _RESTART),
    "topics held": Kind(LIFECYCLE, _RESTART),
    "monitor verdict": Kind(FINDING, _FOUND, _DETECTED),
    "message dropped": Kind(FINDING, _FOUND, _DROPPED),
    "message changed": Kind(FINDING, _FOUND, _CORRECTED),
    "monitor fault": Kind(FINDING, _FOUND, _DETECTED),
    "monitor log": Kind(FINDING, _FOUND, _LOGGED),
    "monitor published": Kind(FINDING, _FOUND, _LOGGED),
    "publication refused": Kind(FINDING, _FOUND, _REJECTED),
    "recording ordered": Kind(API, _CREATE),
    "recording closed": Kind(LOG, _OTHER),
    "recording fetched": Kind(API, _READ),
    "recording read": Kind(API, _READ),
    "recording removed": Kind(API, _DELETE),
    "recording missed": Kind(FINDING, _FOUND, _LOGGED),
    "topic looked into": Kind(API, _READ),
    "evidence exported": Kind(API, _READ),
    "rest call": Kind(API, _BY_CALL),
    "order refused": Kind(API, _BY_CALL),
    "token added": Kind(ENTITY, _CREATE, about="Token"),
    "token revoked": Kind(ENTITY, _DELETE, about="Token"),
    "process started": Kind(LIFECYCLE, _START),
    "process died": Kind(LIFECYCLE, _STOP),
    "process failing": Kind(LIFECYCLE, _STOP),
    "appliance started": Kind(LIFECYCLE, _START),
    "appliance stopped": Kind(LIFECYCLE, _STOP),
    "malformed": Kind(API, _BY_CALL, _REJECTED),
    "connection opened": Kind(NETWORK, _OPEN),
    "connection closed": Kind(NETWORK, _CLOSE),
    "connection refused": Kind(NETWORK, _REFUSE, _BLOCKED),
    "limit exceeded": Kind(API, _BY_CALL, _REJECTED),
    "rate limited": Kind(NETWORK, _TRAFFIC, _DROPPED),
    "probe failed": Kind(FINDING, _FOUND, _DETECTED, "the hidden ROS Master can be reached"),
    "probe passed": Kind(FINDING, _CLOSED, about="the hidden ROS Master can be reached"),
    "reconciled": Kind(LIFECYCLE, _CHANGED),
    "denials folded": Kind(API, _BY_CALL),
    "repetitions folded": Kind(API, _BY_CALL),
    "log begun": Kind(LOG, _LOG_START),
    "records removed": Kind(LOG, _LOG_DELETE),
    "records lost": Kind(LOG, _OTHER),
    "checkpoint": Kind(LOG, _OTHER),
    "signature refused": Kind(FINDING, _FOUND, _DETECTED),
    "forwarding failed": Kind(LOG, _LOG_STOP),
    "forwarding resumed": Kind(LOG, _LOG_START),
    "forwarding gap": Kind(LOG, _OTHER),
    "disk nearly full": Kind(FINDING, _FOUND, _DETECTED, "the audit log's disk is nearly full"),
    "disk has room": Kind(FINDING, _CLOSED, about="the audit log's disk is nearly full"),
    "clock not synchronised": Kind(FINDING, _FOUND, _DETECTED, "the clock is not synchronised"),
    "clock synchronised": Kind(FINDING, _CLOSED, about="the clock is not synchronised"),
    "clock set forward": Kind(FINDING, _FOUND, _DETECTED),
    "clock set back": Kind(FINDING, _FOUND, _DETECTED),
    "protection forgotten": Kind(FINDING, _FOUND, _DETECTED),
    "log failed": Kind(LOG, _LOG_RESTART),
}


def as_ocsf(entry: Entry) -> dict[str, Any]:
    """The event of a record; `time` is in milliseconds since the epoch, as OCSF has it."""
    record, detail = entry.record, entry.record.detail
    kind = KINDS.get(record.event, Kind(LOG, _OTHER))  # of a log that a later version wrote
    activity = _activity(record) if kind.activity_id == _BY_CALL else kind.activity_id
    outcome = _DECISIONS.get(record.decision or "", kind.outcome)
    event: dict[str, Any] = {
        "category_uid": kind.class_uid // 1000,
        "class_uid": kind.class_uid,
        "activity_id": activity,
        "activity_name": record.event if activity == _OTHER else None,
        "type_uid": kind.class_uid * 100 + activity,
        "time": record.time // 1_000_000,
        "severity_id": _SEVERITIES[record.severity],
        "status_id": _status(record, kind.class_uid, activity),
        "status_code": str(detail["status"]) if "status" in detail else None,
        "action_id": outcome and outcome[0],
        "disposition_id": outcome and outcome[1],
        "is_alert": record.severity in (Severity.WARNING, Severity.ALARM),
        "message": record.reason or record.event,
        "metadata": _metadata(entry),
        "actor": _actor(record),
        "authorizations": _authorizations(record),
    }
    if record.event in ("denials folded", "repetitions folded"):
        event |= {"count": detail.get("count")}
        event |= {name: _milliseconds(detail.get(of)) for name, of in _SPAN}
    placed, event_of_class = _of_class(record, kind)
    fields = {
        name: getattr(record, name)
        for name in ("host", "category", "resource", "revision", "duration_us", "detail")
        if name not in placed and not (name == "revision" and event["authorizations"])
    }
    event |= event_of_class | {"unmapped": _given(fields)}
    return _given(event)


def as_ocsf_line(entry: Entry, longest: int | None = None) -> str:
    """One line of NDJSON, without the newline; printable ASCII only.

    At most `longest` bytes, from 1024 on: first the details go that have no place of their own, then the ends of texts;
    `metadata.is_truncated` says so.
    """
    line = _line(as_ocsf(entry))
    for longest_text in _TEXTS:
        if longest is None or len(line) <= longest:
            break
        event = as_ocsf(Entry(entry.sequence, _shortened(entry.record, longest_text)))
        event["metadata"]["is_truncated"] = True
        line = _line(event)
    return line


def _line(event: dict[str, Any]) -> str:
    return json.dumps(event, separators=(",", ":")).replace("\x7f", "\\u007f")


def _shortened(record: Record, longest: int) -> Record:
    """The record with the details that have a place of their own, and no text of a stranger's longer than this."""

    def cut(value: Any) -> Any:
        return value[:longest] if isinstance(value, str) else value

    texts = {
        name: cut(getattr(record, name)) for name in ("host", "caller_id", "category", "resource", "reason")
    }
    rule = record.rule and RuleReference(
        cut(record.rule.section), cut(record.rule.key), cut(record.rule.file), record.rule.line
    )
    detail = {name: cut(record.detail[name]) for name in _PLACED if name in record.detail}
    return msgspec.structs.replace(record, **texts, rule=rule, detail=detail)


def class_text(event: str) -> str:
    """Class and activity of an event of the catalogue, for a page: `API Activity 6003`, with the activity's id."""
    kind = KINDS[event]
    activity = "by the call" if kind.activity_id == _BY_CALL else str(kind.activity_id)
    return f"{CLASSES[kind.class_uid]} {kind.class_uid}: {activity}"


def _of_class(record: Record, kind: Kind) -> tuple[tuple[str, ...], dict[str, Any]]:
    """What this class alone has, and which fields of the record that holds."""
    detail = record.detail
    match kind.class_uid:
        case 6003:
            fields = {
                "api": {"operation": _operation(record)},
                "actor": _actor(record) or {"app_name": "unknown"},
                "src_endpoint": _endpoint(record) or {"name": "unknown"},
                "resources": _resources(record),
            }
            return ("host", "resource", "category"), fields
        case 2004:
            where = _given({"src_endpoint": _endpoint(record), "actor": _actor(record)})
            monitor = detail.get("monitor")
            info = {
                "uid": kind.about or record.id,
                "title": kind.about or record.event,
                "analytic": {"name": str(monitor), "type_id": 1} if monitor else None,
            }
            fields = {
                "finding_info": _given(info),
                "evidences": [where] if where else None,
                "resources": _resources(record),
            }
            return ("host", "resource", "category"), fields
        case 3004:
            names = (detail.get("name"), detail.get("token"), detail.get("file"), record.resource, kind.about)
            entity = {
                "name": next(str(name) for name in names if name),
                "type": kind.about,
                "type_id": _ENTITIES.get(kind.about, _OTHER),
            }
            return ("host", "resource"), {"entity": entity, "src_endpoint": _endpoint(record)}
        case 6002:
            return ("resource",), {"app": {"name": record.resource or record.caller_id or "rosrv"}}
        case 4014:
            return ("host",), {"src_endpoint": _endpoint(record) or {"name": "unknown"}}
        case _:
            return ("host",), {"src_endpoint": _endpoint(record)}


def _metadata(entry: Entry) -> dict[str, Any]:
    record = entry.record
    return {
        "version": VERSION,
        "product": {"name": "ROSRV", "vendor_name": "ROSRV", "version": appliance.__version__},
        "profiles": ["host", "security_control"],
        "uid": record.id,
        "sequence": entry.sequence,
        "event_code": record.event,
        "original_time": rfc3339(record.time),
        "log_name": "audit",
        "log_level": record.severity.value,
        "log_version": str(SCHEMA_VERSION),
    }


def _operation(record: Record) -> str:
    named = (record.detail.get(name) for name in ("call", "method", "verb"))
    return next((str(name) for name in (*named, record.category) if name), record.event)


def _activity(record: Record) -> int:
    operation = _operation(record)
    return next((activity for activity, begins in _CALLS if operation.startswith(begins)), _OTHER)


def _status(record: Record, class_uid: int, activity: int) -> int:
    """Success or failure; of a finding: new, or resolved."""
    if class_uid == FINDING:
        return 4 if activity == _CLOSED else 1
    return 2 if record.decision == "deny" or record.event.endswith(_FAILURES) else 1


def _actor(record: Record) -> dict[str, Any] | None:
    who = record.detail.get("who")
    return _given({"user": {"name": str(who)} if who else None, "app_name": record.caller_id}) or None


def _endpoint(record: Record) -> dict[str, Any] | None:
    if not record.host:
        return None
    try:
        ipaddress.ip_address(record.host)
    except ValueError:
        return {"name": record.host}
    return {"ip": record.host}


def _resources(record: Record) -> list[dict[str, Any]] | None:
    found = _given({"name": record.resource, "type": record.category})
    return [found] if found else None


def _authorizations(record: Record) -> list[dict[str, Any]] | None:
    if record.decision is None and record.rule is None:
        return None
    revision = None if record.revision is None else str(record.revision)
    policy = {"name": rule_text(record.rule) or "no rule", "version": revision}
    return [_given({"decision": record.decision, "policy": _given(policy)})]


def _milliseconds(time: object) -> int | None:
    return time // 1_000_000 if isinstance(time, int) else None


def _given(fields: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in fields.items() if value is not None and value not in ("", {}, [])}
