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
    """Return the row with the address of its REST call, if the log leaves no doubt."""
    if row.who in _LOCAL:
        return row
    calls = log.search(Filter(event="rest call"), str(row.sequence), _ORIGIN_RECORDS, newest_first=False)
    return msgspec.structs.replace(row, origin=origin_of(row, calls.entries))


def origin_of(row: Intervention, calls: Iterable[LogEntry]) -> str:
    """Return the address of the call that made a change: it was answered after the change.

    If its author's changes in that time came from several addresses, it may be any of them, and none is returned.
    """
    hosts = {
        entry.record.host or ""
        for entry in calls
        if 0 <= entry.record.time - row.time <= _ORIGIN_SECONDS * 1_000_000_000
        and entry.record.detail.get("who") == row.who
        and entry.record.detail.get("method") not in _READS
    }
    return hosts.pop() if len(hosts) == 1 else ""
