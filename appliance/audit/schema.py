"""The documented form of a record as a JSON schema, and the tables of the reviewer's page, made from the code.

`python -m appliance.audit.schema` prints the generated part of docs/audit.md; a test holds the page against it.
"""

import json
import sys
from typing import Any

from appliance.audit.record import SCHEMA_VERSION, Severity

_TEXT_OR_NULL = {"type": ["string", "null"]}
_FIELDS: dict[str, tuple[dict[str, Any], str]] = {
    "schema": ({"const": SCHEMA_VERSION}, "version of this schema"),
    "id": ({"type": "string", "pattern": "^[0-9a-f]{20}$"}, "unique; sorted as text it is sorted by time"),
    "time": ({"type": "string", "format": "date-time"}, "RFC 3339, UTC, nanoseconds"),
    "sequence": ({"type": "integer"}, "place in the log; never goes back, has no gaps"),
    "event": ({"type": "string"}, "what happened: a name of the list below"),
    "severity": ({"enum": [one.value for one in Severity]}, "how much a person should care"),
    "decision": ({"enum": ["allow", "deny", "would deny"]}, "absent where nothing was decided"),
    "host": (_TEXT_OR_NULL, "address of the peer"),
    "caller_id": (_TEXT_OR_NULL, "the name the peer gave: a claim"),
    "category": (_TEXT_OR_NULL, "what kind of request"),
    "resource": (_TEXT_OR_NULL, "topic, service, parameter, node or call"),
    "rule": (
        {
            "type": ["object", "null"],
            "properties": {
                "section": {"type": "string"},
                "key": {"type": "string"},
                "file": {"type": "string"},
                "line": {"type": "integer", "minimum": 0},
            },
            "required": ["section", "key", "file", "line"],
            "additionalProperties": False,
        },
        "the rule of the policy that decided; null where none did",
    ),
    "revision": ({"type": ["integer", "null"]}, "of the policy in force"),
    "reason": ({"type": "string"}, "a sentence for a person"),
    "duration_us": ({"type": ["integer", "null"]}, "microseconds from the request's arrival to the decision"),
    "detail": ({"type": "object"}, "further fields of this event"),
}


_HASH = {"type": "string", "pattern": "^[0-9a-f]{64}$"}
_CHAIN = {
    "type": "object",
    "description": "in an export: the place in the hash chain, as far as a signed checkpoint",
    "properties": {
        "previous": _HASH | {"description": "hash of the record before"},
        "hash": _HASH | {"description": "hash of this record"},
        "then": {
            "type": ["array", "null"],
            "items": _HASH,
            "description": "content hashes of the records after it that are left out; null: version 0.1.0 wrote them",
        },
        "checkpoint": {
            "type": ["object", "null"],
            "description": "the signed checkpoint that seals what is up to here, as `rosrv audit checkpoints` gives it",
        },
    },
    "required": ["previous", "hash", "then"],
    "additionalProperties": False,
}


def json_schema() -> dict[str, Any]:
    """The JSON schema (2020-12) of a record as CLI, REST and export give it."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": f"ROSRV audit record, version {SCHEMA_VERSION}",
        "type": "object",
        "properties": {name: form | {"description": text} for name, (form, text) in _FIELDS.items()},
        "required": [name for name in _FIELDS if name != "decision"],
        "additionalProperties": False,
    }


def export_schema() -> dict[str, Any]:
    """The JSON schema of a line of an export: a record and its place in the hash chain."""
    record = json_schema()
    return record | {
        "title": f"ROSRV audit record with its place in the chain, version {SCHEMA_VERSION}",
        "properties": record["properties"] | {"chain": _CHAIN},
        "required": [*record["required"], "chain"],
    }


def markdown() -> str:
    """The generated part of the reviewer's page."""
    lines = ["## Fields of a record", "", "| field | meaning |", "|---|---|"]
    lines += [f"| `{name}` | {text} |" for name, (_form, text) in _FIELDS.items()]
    lines += [
        "",
        "The names of `event`, each with its fields of `detail`: [audit-events.md](audit-events.md).",
    ]
    lines += ["", "## JSON schema", "", "```json", json.dumps(json_schema(), indent=2), "```", ""]
    lines += [
        "A line of an export has one field more, `chain`:",
        "",
        "```json",
        json.dumps(_CHAIN, indent=2),
        "```",
        "",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.stdout.write(markdown())
