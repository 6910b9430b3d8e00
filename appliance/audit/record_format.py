"""What leaves the log: a record as the documented JSON object, strangers' text made fit for a terminal.

JSON is ASCII only. Text for people has every character escaped that a terminal could act on or that could
make a name look like another one by order of writing: control characters, escape sequences, bidirectional
marks.
"""

import json
import re
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any, NamedTuple

import msgspec
from msgspec.structs import asdict

from appliance.audit.record import SCHEMA_VERSION, Record, RuleReference
from appliance.audit.timestamps import parse_moment

_SECOND = 1_000_000_000
_NOT_THE_RECORDS = ("schema", "sequence", "chain")
_OF_THE_RECORD = (
    "event", "severity", "decision", "host", "caller_id", "category", "resource", "rule", "revision", "reason",
    "duration_us", "detail",
)  # fmt: skip


_CONTENTS = ("before", "after", "before_fields", "after_fields", "conditions", "values", "why", "binding")
"""What messages said, in the detail of a monitor's record: as bytes, as fields, and what was compared of them."""
_BOUND = re.compile(r"(property \d+ of \S+ \(\w+\)|: \d+ \w+) with \w+ = .*", re.DOTALL)


class Entry(NamedTuple):
    """A record of the log with its sequence."""

    sequence: int
    record: Record


def rfc3339(time: int) -> str:
    """Nanoseconds since the epoch as RFC 3339 in UTC, nine digits of a second."""
    seconds, fraction = divmod(time, _SECOND)
    try:
        moment = datetime.fromtimestamp(seconds, UTC)
    except (OverflowError, ValueError, OSError):
        return f"@{time}ns"
    return f"{moment:%Y-%m-%dT%H:%M:%S}.{fraction:09d}Z"


def without_contents(entry: Entry) -> Entry:
    """The record without what messages said, which `detail.withheld` names then: for who may not read messages."""
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
    return Entry(entry.sequence, record)


def without_binding(text: str, detail: Mapping[str, Any]) -> str:
    """What a monitor's record says of a verdict, without the values of parameters, which messages said."""
    found = _BOUND.search(text)
    if found is None:
        return text
    category = f": {detail['category']}" if found[1].startswith("property") and "category" in detail else ""
    return text[: found.end(1)] + category


def as_object(entry: Entry) -> dict[str, Any]:
    """The documented JSON object of a record; `decision` is absent where nothing was decided."""
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


def entry_of(fields: Any) -> Entry:
    """A record from its documented JSON object. Raises `ValueError`, `KeyError` and `TypeError` for anything else."""
    if not isinstance(fields, dict):
        raise TypeError("not an object")
    own = {name: value for name, value in fields.items() if name not in _NOT_THE_RECORDS}
    time = str(fields["time"])
    own["time"] = int(time[1:-2]) if time.startswith("@") else parse_moment(time, 0)
    return Entry(int(fields["sequence"]), msgspec.convert(own, Record))


def as_json(entry: Entry) -> str:
    """One line of NDJSON, without the newline; ASCII only."""
    return json.dumps(as_object(entry), separators=(",", ":"))


def fields_of(entry: Entry) -> dict[str, str | None]:
    """What names a record and says what it is about, as text; None is what it has not."""
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


def rule_text(rule: RuleReference | None) -> str | None:
    """A rule and where it stands, as one word of a line; None for none."""
    return None if rule is None else f"[{rule.section}] {rule.key} {rule.file}:{rule.line}"


def printable(text: str) -> str:
    """Text that no terminal acts on: what is not printable is written as an escape, a backslash as two."""
    if text.isprintable() and "\\" not in text:
        return text
    return "".join(_escape(character) for character in text)


def _escape(character: str) -> str:
    if character == "\\":
        return "\\\\"
    if character.isprintable():
        return character
    return character.encode("unicode_escape", "backslashreplace").decode("ascii")
