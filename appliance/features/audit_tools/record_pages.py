"""Make the pages and streams of audit records that a client may read."""

import pathlib
from typing import Any

from appliance.api.front.access import Bearer
from appliance.api.routes.log_reader import RECORD_REFERENCE, readable
from appliance.audit.log.record_format import LogEntry, as_object
from appliance.audit.search.equality import equality_of
from appliance.audit.search.query import Filter
from appliance.audit.search.search import search
from appliance.features.audit_tools.unrecorded import unrecorded

_EQUALITY = {
    "type": "object",
    "properties": {
        "key": {"type": "string", "description": "equal in equal records"},
        "reason": {"type": "string", "description": "equal in equal records, or empty if equal to each"},
        "reach": {"type": "integer", "description": "how many of the last rows the record can join"},
        "times": {"type": "integer", "description": "how often the event happened"},
        "value": {"type": "string", "description": "the reason, without the words about repetitions"},
        "began": {"type": "string", "format": "date-time", "description": "time of the first event"},
        "ended": {"type": "string", "format": "date-time", "description": "time of the last event"},
    },
    "required": ["key", "reason", "reach", "times", "value", "began", "ended"],
    "additionalProperties": False,
}
PAGE = {
    "type": "object",
    "properties": {
        "records": {"type": "array", "items": RECORD_REFERENCE},
        "cursor": {
            "type": ["string", "null"],
            "description": "cursor of the next page, or null on the last page",
        },
        "equality": {
            "type": "array",
            "items": _EQUALITY,
            "description": "only with equality=1: for each record, what makes equal ones one row",
        },
        "notes": {
            "type": "array",
            "items": {"type": "string"},
            "description": "only if there are any: an event or category that this version does not record",
        },
    },
    "required": ["records", "cursor"],
    "additionalProperties": False,
}
_STEP = 500


def page_of(
    path: pathlib.Path,
    wanted: Filter,
    cursor: str | None,
    limit: int,
    bearer: Bearer,
    *,
    newest_first: bool,
    equality: bool = False,
) -> dict[str, Any]:
    """Return a page, whose cursor reveals nothing about hidden records."""
    found: list[LogEntry] = []
    more: str | None = cursor
    count = limit + 1
    while len(found) <= limit:
        entries, more = search(path, wanted, more, count, newest_first=newest_first)
        found += readable(entries, bearer, wanted.text)
        if more is None:
            break
        count = _STEP  # many records may be hidden; large steps skip them faster
    last = str(found[limit - 1].sequence) if len(found) > limit else None
    page: dict[str, Any] = {"records": [as_object(entry) for entry in found[:limit]], "cursor": last}
    if equality:
        page["equality"] = [equality_of(entry.record) for entry in found[:limit]]
    return page | {"notes": notes} if (notes := unrecorded(wanted)) else page


def streamed(entry: LogEntry, *, equality: bool) -> dict[str, Any]:
    return as_object(entry) | ({"equality": equality_of(entry.record)} if equality else {})
