"""Print audit records as text: a table on a terminal, lines in a pipe. Text from the network is escaped."""

import sys
from pathlib import Path

import msgspec
from rich.console import Console
from rich.table import Table
from rich.text import Text

from appliance.audit.log.record import AuditRecord, Severity
from appliance.audit.log.record_format import LogEntry, fields_of, printable, requested, rule_text
from appliance.audit.search.equality import FOLDED, EqualRecords, grouped, time_span
from appliance.audit.search.search import RecordInContext
from appliance.base.actors import actor
from appliance.base.timestamps import local_text
from appliance.cli.audit.verification_text import write
from appliance.policy.host_names import HostInWords

_STYLES = {"allow": "green", "deny": "bold red", "would deny": "yellow", "ask": "yellow"}
_SECONDS, _MILLISECONDS = 19, 23  # characters of a time
_DATE = 11
_LEAST_WHY = 40  # characters; with less room for the reasons in a column, they are below the records
_COLUMNS = ("record", "time", "decision", "event", "who", "what", "why")
_GAP = 2


def print_entries(entries: list[LogEntry], host_in_words: HostInWords, *, each: bool = False) -> None:
    """Print records; on a terminal, equal records are one row unless `each`."""
    if sys.stdout.isatty():
        rows = [row for entry in entries for row in grouped([entry])] if each else grouped(entries)
        cells = [
            (Text(str(row.first.sequence)), Text(_times(row)), *_cells(row, host_in_words)) for row in rows
        ]
        console = Console(highlight=False)
        console.print(_table(cells) if _has_room(cells, console.width) else _below(cells))
    else:
        for entry in entries:
            write(line(entry, host_in_words))


def line(entry: LogEntry, host_in_words: HostInWords) -> str:
    record = entry.record
    parts = [
        local_text(record.time),
        f"#{entry.sequence}",
        (record.decision or record.severity.value).upper(),
        record.event,
        _host(record, host_in_words),
        record.caller_id,
        requested(record),
        record.resource,
        _by(record),
    ]
    shown = " ".join(printable(part) for part in parts if part)
    return shown + (f": {_why(record)}" if _why(record) else "")


def print_shown(shown: RecordInContext, host_in_words: HostInWords) -> None:
    record = shown.entry.record
    fields = {
        "id": record.id,
        "time": local_text(record.time),
        **fields_of(shown.entry),
        "host": _host(record, host_in_words),
        "reason": record.reason,
        "duration": None if record.duration_us is None else f"{record.duration_us} us",
        **{f"detail.{name}": str(value) for name, value in record.detail.items()},
    }
    for name, value in fields.items():
        if value:
            write(f"{printable(name):<12} {printable(value)}")
    for title, entries in (("before", shown.before), ("after", shown.after)):
        write(
            f"\n{title}, same host or caller:" if entries else f"\nnothing {title} by the same host or caller"
        )
        for entry in entries:
            write("  " + line(entry, host_in_words))


def _has_room(rows: list[tuple[Text, ...]], width: int) -> bool:
    columns = list(zip(map(Text, _COLUMNS), *rows, strict=True))[:-1]
    names: int = sum(max(cell.cell_len for cell in column) + _GAP for column in columns)
    return names + _LEAST_WHY <= width


def _table(rows: list[tuple[Text, ...]]) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold", padding=(0, _GAP, 0, 0))
    for name in _COLUMNS:
        table.add_column(
            name, overflow="fold", no_wrap=name != "why", justify="right" if name == "record" else "left"
        )
    for row in rows:
        table.add_row(*row)
    return table


def _below(rows: list[tuple[Text, ...]]) -> Table:
    grid = Table.grid(padding=(0, _GAP, 0, 0))
    grid.add_column(no_wrap=True, justify="right", style="bold")
    grid.add_column(overflow="fold")
    for number, *cells, why in rows:
        grid.add_row(number, Text("  ").join(cell for cell in cells if cell.plain))
        if why.plain:
            grid.add_row("", why)
    return grid


def _cells(row: EqualRecords, host_in_words: HostInWords) -> tuple[Text, ...]:
    record = row.first.record
    alarming = record.severity is Severity.ALARM
    return (
        Text(printable(record.decision or ""), style=_STYLES.get(record.decision or "", "")),
        Text(printable(record.event), style="bold red" if alarming else ""),
        Text(_joined(_host(record, host_in_words), record.caller_id, _by(record))),
        Text(_joined(requested(record), _monitor(record), record.resource)),
        Text(_why(record) if row.records == 1 else _why_of_several(row)),
    )


def _times(row: EqualRecords) -> str:
    spans = time_span(row.first.record), time_span(row.last.record)
    first, last = (local_text(time).replace("T", " ") for time in (spans[0][0], spans[1][1]))
    if row.records == 1:
        return first[:_MILLISECONDS] + _offset(first)
    same_day = first[:_DATE] == last[:_DATE]
    return f"{first[:_SECONDS]} to {last[_DATE if same_day else 0 : _SECONDS]}{_offset(last)}"


def _offset(text: str) -> str:
    return "Z" if text.endswith("Z") else text[-6:]


def _host(record: AuditRecord, host_in_words: HostInWords) -> str | None:
    return record.host and host_in_words(record.host)


def _monitor(record: AuditRecord) -> str | None:
    name = record.detail.get("monitor")
    return str(name) if name else None


def _by(record: AuditRecord) -> str | None:
    who = record.detail.get("who")
    unknown = (
        who == "None" and record.event in FOLDED
    )  # as versions up to 0.2.0 counted calls without a token
    return f"by {actor(str(who))}" if who and not unknown else None


def _why_of_several(row: EqualRecords) -> str:
    newest = msgspec.structs.replace(row.last.record, reason=row.value, event="")
    return f"{row.count} times, last: {_why(newest)}" if row.value else f"{row.count} times"


def _joined(*parts: str | None) -> str:
    return " ".join(printable(part) for part in parts if part)


def _why(record: AuditRecord) -> str:
    rule = record.rule
    named = rule is None or f"{Path(rule.file).name}:{rule.line}" in record.reason
    why = record.reason if named else f"{record.reason} ({rule_text(record.rule)})"
    count = record.detail.get("count") if record.event in FOLDED else None
    return printable(f"{count} more: {why}" if count else why)
