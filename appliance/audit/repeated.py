"""Find the record in full that a record of repetitions continues."""

from pathlib import Path

from appliance.audit.equality import FOLDED, equal_key
from appliance.audit.query import Filter
from appliance.audit.record_format import LogEntry
from appliance.audit.search import search, show

_MOST = 200
"""A monitor's count is at most a second later than its record in full; this many records may be between them."""


def recorded_in_full(path: Path, entry: LogEntry) -> LogEntry | None:
    """Return the record with the contents of the first of the counted events; None if there is none, or no more.

    Raises `LogUnreadableError`.
    """
    record = entry.record
    if record.event in FOLDED:
        shown = show(path, str(record.detail.get("recorded_id", "")), 0)
        return None if shown is None else shown.entry
    if not ("count" in record.detail and "monitor" in record.detail):
        return None
    wanted = Filter(event=record.event, category=record.category)
    page = search(path, wanted, str(entry.sequence), _MOST)
    key = equal_key(record)
    earlier = (one for one in page.entries if "count" not in one.record.detail)
    return next((one for one in earlier if key.equals(equal_key(one.record))), None)
