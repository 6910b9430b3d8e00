"""Tests of the past publishers of a topic: gaps in a log without its first records, or after a loss."""

from typing import Any

from appliance.audit.publishers import publishers_at
from appliance.audit.query import Filter
from appliance.audit.record import AuditRecord
from appliance.audit.record_format import LogEntry


def entry(sequence: int, event: str, **fields: Any) -> LogEntry:
    """Return a record at the second of its sequence."""
    return LogEntry(sequence, AuditRecord(id=str(sequence), time=sequence * 10**9, event=event, **fields))


def unknown(log: list[LogEntry], at: int) -> tuple[str, ...]:
    """Return the reported gaps for /a at this second."""

    def export(wanted: Filter) -> list[LogEntry]:
        return [one for one in log if one.record.event == wanted.event]

    return publishers_at(export, log[0] if log else None, "/a", at * 10**9).unknown


def test_gaps_of_the_log_are_reported() -> None:
    """Removed records, an earlier log, lost records and an empty log are reported; a whole log has no such gap."""
    begun = entry(1, "log begun")
    assert unknown([begun, entry(2, "appliance started")], 5) == ()
    [removed] = unknown([entry(4, "decision")], 5)
    assert removed.startswith("records before 1970-01-01T00:00:04.000000000Z were removed")
    [earlier] = unknown([entry(1, "log begun", detail={"earlier_log_missing": True})], 5)
    assert earlier.startswith("an earlier log is missing")
    [lost] = unknown([begun, entry(3, "records lost")], 5)
    assert lost.startswith("records were lost")
    [empty] = unknown([], 5)
    assert empty.startswith("the log is empty")
