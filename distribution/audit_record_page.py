"""Generate the end of docs/reference/audit-log.md: the fields and the JSON schema of audit records."""

import json
from typing import Any

from appliance.audit.log.schema import FIELDS, json_schema

_HASH = {"type": "string", "pattern": "^[0-9a-f]{64}$"}
CHAIN: dict[str, Any] = {
    "type": "object",
    "description": "in an export: the position in the hash chain, up to a signed checkpoint",
    "properties": {
        "previous": _HASH | {"description": "hash of the record before"},
        "hash": _HASH | {"description": "hash of this record"},
        "then": {
            "type": ["array", "null"],
            "items": _HASH,
            "description": "content hashes of the omitted records after it, or null in records of version 0.1.0",
        },
        "checkpoint": {
            "type": ["object", "null"],
            "description": "signed checkpoint that seals the records up to this one (see `rosrv audit checkpoints`)",
        },
    },
    "required": ["previous", "hash", "then"],
    "additionalProperties": False,
}


def markdown() -> str:
    lines = ["## Fields of a record", "", "| field | meaning |", "|---|---|"]
    lines += [f"| `{name}` | {text} |" for name, (_form, text) in FIELDS.items()]
    lines += [
        "",
        "The names of `event`, each with its fields of `detail`: [audit-events.md](generated/audit-events.md).",
    ]
    lines += ["", "## JSON schema", "", "```json", json.dumps(json_schema(), indent=2), "```", ""]
    lines += [
        "A line of an export also has `robot`, if `appliance.yaml` names the robot and the appliance runs, "
        "and `chain`:",
        "",
        "```json",
        json.dumps(CHAIN, indent=2),
        "```",
        "",
    ]
    return "\n".join(lines)
