"""The JSON schema of a record."""

from typing import Any

from appliance.audit.log.record import SCHEMA_VERSION, Severity

_TEXT_OR_NULL = {"type": ["string", "null"]}
FIELDS: dict[str, tuple[dict[str, Any], str]] = {
    "schema": ({"const": SCHEMA_VERSION}, "version of this schema"),
    "id": ({"type": "string", "pattern": "^[0-9a-f]{20}$"}, "unique; sorted as text it is sorted by time"),
    "time": ({"type": "string", "format": "date-time"}, "RFC 3339, UTC, nanoseconds"),
    "sequence": ({"type": "integer"}, "place in the log; never goes back, has no gaps"),
    "event": ({"type": "string"}, "what happened: a name of the list below"),
    "severity": ({"enum": [severity.value for severity in Severity]}, "how much a person should care"),
    "decision": ({"enum": ["allow", "deny", "would deny", "ask"]}, "absent where nothing was decided"),
    "host": (_TEXT_OR_NULL, "address of the peer"),
    "caller_id": (_TEXT_OR_NULL, "the name the peer gave: a claim"),
    "category": (_TEXT_OR_NULL, "what kind of request"),
    "resource": (_TEXT_OR_NULL, "topic, service, node or call; the parameter of a call is `key` in `detail`"),
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


def json_schema() -> dict[str, Any]:
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": f"ROSRV audit record, version {SCHEMA_VERSION}",
        "type": "object",
        "properties": {name: form | {"description": text} for name, (form, text) in FIELDS.items()},
        "required": [name for name in FIELDS if name != "decision"],
        "additionalProperties": False,
    }
