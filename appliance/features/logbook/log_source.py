"""Read interventions, gaps and their origins from the audit log of an appliance."""

import heapq
from collections.abc import Iterable, Iterator

import msgspec

from appliance.audit.log.record_format import LogEntry
from appliance.audit.search.query import Filter
from appliance.base.actors import DISK, OPERATOR, UNCONFIRMED
from appliance.cli.connection.audit_file import FileLog
from appliance.cli.connection.audit_over_rest import RestLog
from appliance.features.logbook.interventions import Intervention

_ORIGIN_SECONDS = 60
_ORIGIN_RECORDS = 50
_LOCAL = {"", OPERATOR, DISK, UNCONFIRMED}
_READS = ("GET", "HEAD")

Log = FileLog | RestLog


def entries_of(log: Log, events: Iterable[str]) -> Iterator[LogEntry]:
    """Yield the records of some events in the order of the log. Raises `LogUnreadableError` and `FilterError`."""
    return heapq.merge(
        *(log.export(Filter(event=event)) for event in events), key=lambda entry: entry.sequence
    )


def with_origin(log: Log, row: Intervention) -> Intervention:
    """Return the row with the address of its REST call: the first change of its author that was answered after it."""
    if row.who in _LOCAL:
        return row
    calls = log.search(Filter(event="rest call"), str(row.sequence), _ORIGIN_RECORDS, newest_first=False)
    for entry in calls.entries:
        record = entry.record
        if record.time - row.time > _ORIGIN_SECONDS * 1_000_000_000:
            break
        if record.detail.get("who") == row.who and record.detail.get("method") not in _READS:
            return msgspec.structs.replace(row, origin=record.host or "")
    return row
