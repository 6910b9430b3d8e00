"""Format records as the documented JSON object, and untrusted text for a terminal."""

import json
import re
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any, NamedTuple

import msgspec
from msgspec.structs import asdict

from appliance.audit.log.columns import StoredColumns, from_columns
from appliance.audit.log.record import SCHEMA_VERSION, AuditRecord, RuleReference
from appliance.base.timestamps import parse_timestamp

_SECOND = 1_000_000_000
_GIVES_UP = ("unregister", "unsubscribe")
_NOT_THE_RECORDS = ("schema", "sequence", "chain")
_OF_THE_RECORD = AuditRecord.__struct_fields__[2:-2]  # without id and time, and what is not stored


_CONTENTS = ("before", "after", "before_fields", "after_fields", "conditions", "values", "why", "binding")
"""The fields of `detail` in a monitor's record that contain parts of messages."""
_BOUND = re.compile(r"(property \d++ of \S++ \(\w++\)|: \d++ \w++) with \w++ = ")


class LogEntry(NamedTuple):
    """A record with its sequence."""

    sequence: int
    record: AuditRecord


def stored_entry(columns: StoredColumns) -> LogEntry:
    return LogEntry(columns.sequence, from_columns(columns))


def rfc3339(time: int) -> str:
    """Return nanoseconds since the epoch as RFC 3339, or as `@…ns` if they are out of range."""
    seconds, fraction = divmod(time, _SECOND)
    try:
        moment = datetime.fromtimestamp(seconds, UTC)
    except (OverflowError, ValueError, OSError):
        return f"@{time}ns"
    return f"{moment:%Y-%m-%dT%H:%M:%S}.{fraction:09d}Z"


def without_contents(entry: LogEntry) -> LogEntry:
    """Return the entry without the contents of messages, for roles that may not read them."""
    detail = entry.record.detail
    if "monitor" not in detail:
        return entry
    texts = {"reason": entry.record.reason, "handler": str(detail.get("handler", ""))}
    plain = {name: without_binding(text, detail) for name, text in texts.items()}
    withheld = [name for name in _CONTENTS if name in detail]
    withheld += [name for name in texts if plain[name] != texts[name]]
    if not withheld:
        return entry
    kept = {name: value for name, value in detail.items() if name not in withheld}
    if "handler" in detail:
        kept["handler"] = plain["handler"]
    record = msgspec.structs.replace(
        entry.record, reason=plain["reason"], detail=kept | {"withheld": withheld}
    )
    return LogEntry(entry.sequence, record)


def without_binding(text: str, detail: Mapping[str, object]) -> str:
    """Return the text without the values of parameters, which come from messages."""
    match = _BOUND.search(text)
    if match is None:
        return text
    category = f": {detail['category']}" if match[1].startswith("property") and "category" in detail else ""
    return text[: match.end(1)] + category


def as_object(entry: LogEntry) -> dict[str, Any]:
    record = entry.record
    fields = {name: getattr(record, name) for name in _OF_THE_RECORD}
    if record.decision is None:
        del fields["decision"]
    head = {
        "schema": SCHEMA_VERSION,
        "id": record.id,
        "time": rfc3339(record.time),
        "sequence": entry.sequence,
    }
    return head | fields | {"severity": record.severity.value, "rule": record.rule and asdict(record.rule)}


def entry_of(fields: object) -> LogEntry:
    """Return the entry of a JSON object. Raises `ValueError`, `KeyError` and `TypeError`."""
    if not isinstance(fields, dict):
        raise TypeError("not an object")
    own = {name: value for name, value in fields.items() if name not in _NOT_THE_RECORDS}
    time = str(fields["time"])
    own["time"] = int(time[1:-2]) if time.startswith("@") else parse_timestamp(time, 0)
    return LogEntry(int(fields["sequence"]), msgspec.convert(own, AuditRecord))


def as_json(entry: LogEntry) -> str:
    return json.dumps(as_object(entry), separators=(",", ":"))


def fields_of(entry: LogEntry) -> dict[str, str | None]:
    record = entry.record
    return {
        "sequence": str(entry.sequence),
        "id": record.id,
        "event": record.event,
        "severity": record.severity.value,
        "decision": record.decision,
        "host": record.host,
        "caller_id": record.caller_id,
        "category": record.category,
        "resource": record.resource,
        "rule": rule_text(record.rule),
        "revision": None if record.revision is None else str(record.revision),
    }


def request_of(record: AuditRecord) -> str | None:
    call = record.detail.get("call")
    if record.category != "command" and isinstance(call, str) and call.startswith(_GIVES_UP):
        return call
    return record.category


def rule_text(rule: RuleReference | None) -> str | None:
    return None if rule is None else f"[{rule.section}] {rule.key} {rule.file}:{rule.line}"


def printable(text: str) -> str:
    if text.isprintable() and "\\" not in text:
        return text
    return "".join(_escape(character) for character in text)


def _escape(character: str) -> str:
    if character == "\\":
        return "\\\\"
    if character.isprintable():
        return character
    return character.encode("unicode_escape", "backslashreplace").decode("ascii")
