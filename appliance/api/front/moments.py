"""Write each time in JSON twice: as the number in the struct's field (`since`), then as RFC 3339 (`since_utc`)."""

import functools
from collections.abc import Mapping
from typing import Any

import msgspec

from appliance.api.front.problems import ProblemError
from appliance.audit.log.record_format import rfc3339
from appliance.base import clock
from appliance.base.timestamps import parse_timestamp
from appliance.channel.answers.field_docs import UNIT

_UTC = "_utc"
_OF_A_SECOND = 1_000_000  # a float has no more digits


def in_full(value: Any) -> Any:
    """Return the value with each time written twice, for msgspec to encode."""
    if isinstance(value, msgspec.Struct):
        units = _units(type(value))
        if units is None:
            return value
        fields: dict[str, Any] = {}
        for name, inner in msgspec.structs.asdict(value).items():
            fields[name] = in_full(inner)
            if name in units and fields[name] is not None:
                fields[name + _UTC] = _text(fields[name], units[name])
        return fields
    if isinstance(value, Mapping):
        return {name: in_full(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [in_full(item) for item in value]
    return value


def describe(schema: dict[str, Any]) -> None:
    fields: dict[str, Any] = {}
    for name, field in schema.get("properties", {}).items():
        fields[name] = field
        if _unit(field) is not None:
            text = f"`{name}` as RFC 3339, UTC" + ("; absent where that is null" if "anyOf" in field else "")
            fields[name + _UTC] = {"type": "string", "format": "date-time", "description": text}
            if name in schema.get("required", ()) and "anyOf" not in field:
                schema["required"].append(name + _UTC)
    if fields:
        schema["properties"] = fields


def parse_moment(text: str) -> int:
    """Return nanoseconds since the epoch. Raises `ProblemError` (422)."""
    try:
        return parse_timestamp(text, clock.wall_ns())
    except (OverflowError, ValueError) as error:
        raise ProblemError(422, "bad-input", str(error)) from error


def _text(moment: float, unit: str) -> str:
    return rfc3339(int(moment) if unit == "nanoseconds" else round(moment * _OF_A_SECOND) * 1_000)


@functools.cache
def _units(kind: type[msgspec.Struct]) -> dict[str, str] | None:
    _, kinds = msgspec.json.schema_components([kind])
    found = {
        name: {field: unit for field, of in schema.get("properties", {}).items() if (unit := _unit(of))}
        for name, schema in kinds.items()
    }
    return found[kind.__name__] if any(found.values()) else None


def _unit(field: dict[str, Any]) -> str | None:
    return field.get(UNIT) or next(filter(None, map(_unit, field.get("anyOf", ()))), None)
