"""The schema of audit records, and the part of a record that a client may read."""

from collections.abc import Iterable

from appliance.api.front.access import Bearer
from appliance.api.front.route_roles import reads_contents
from appliance.audit.log.record_format import LogEntry, as_json, without_contents
from appliance.audit.log.schema import json_schema

RECORD = {key: value for key, value in json_schema().items() if key != "$schema"}
RECORD_REFERENCE = {"$ref": "#/components/schemas/AuditRecord"}


def readable(entries: Iterable[LogEntry], bearer: Bearer, text: str | None = None) -> list[LogEntry]:
    """Return the records as the client may read them, without those that match `text` only in hidden parts."""
    found = []
    for entry in entries:
        shown = readable_by(entry, bearer)
        if shown is entry or text is None or text.casefold() in as_json(shown).casefold():
            found.append(shown)
    return found


def readable_by(entry: LogEntry, bearer: Bearer) -> LogEntry:
    return entry if reads_contents(bearer) else without_contents(entry)
