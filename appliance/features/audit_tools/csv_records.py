"""Write records as CSV (RFC 4180), for spreadsheets.

A cell that a spreadsheet would take for a formula begins with an apostrophe: names and reasons come from the network.
"""

import csv
import io
import json
from collections.abc import Iterable, Iterator

from appliance.audit.log.record_format import LogEntry, rfc3339

COLUMNS = (
    "time", "sequence", "id", "event", "severity", "decision", "host", "caller_id", "category", "resource", "section",
    "key", "file", "line", "reason", "detail",
)  # fmt: skip
_END = "\r\n"
_FORMULA = ("=", "+", "-", "@", "\t", "\r")


def csv_lines(entries: Iterable[LogEntry]) -> Iterator[tuple[int, str]]:
    """Yield each record's sequence and line, without its end. The caller writes `csv_head` first."""
    for entry in entries:
        yield entry.sequence, _line(_cells(entry))


def csv_head() -> str:
    return _line(COLUMNS)


def _cells(entry: LogEntry) -> list[str]:
    record, rule = entry.record, entry.record.rule
    where = ("", "", "", "") if rule is None else (rule.section, rule.key, rule.file, str(rule.line))
    cells = [
        rfc3339(record.time), str(entry.sequence), record.id, record.event, record.severity.value,
        record.decision, record.host, record.caller_id, record.category, record.resource, *where, record.reason,
        json.dumps(record.detail, separators=(",", ":")),
    ]  # fmt: skip
    return [_harmless(cell or "") for cell in cells]


def _harmless(cell: str) -> str:
    return f"'{cell}" if cell.startswith(_FORMULA) else cell


def _line(cells: Iterable[str]) -> str:
    line = io.StringIO()
    csv.writer(line, lineterminator=_END).writerow(
        cells
    )  # it quotes a cell with characters of the line's end
    return line.getvalue().removesuffix(_END)
