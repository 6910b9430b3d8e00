"""`rosrv audit tail|search|show|verify|checkpoints|export`: review the audit log."""

import json
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from pkgutil import resolve_name
from typing import Annotated, BinaryIO, Protocol, TypeVar

import msgspec
import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from appliance.api.routes.named_hosts import has_name, with_networks
from appliance.audit.log.record import AuditRecord, Severity
from appliance.audit.log.record_format import (
    LogEntry,
    as_json,
    as_object,
    fields_of,
    printable,
    request_of,
    rule_text,
)
from appliance.audit.log.signatures import read_public_key
from appliance.audit.proof.chain_findings import Verification
from appliance.audit.proof.copies import SignedCheckpoint, read_copies
from appliance.audit.search.equality import FOLDED, EqualRecords, group_equal, time_span
from appliance.audit.search.filter_options import FILTER
from appliance.audit.search.query import Filter, FilterError
from appliance.audit.search.search import LARGEST_PAGE, RecordInContext
from appliance.base import clock
from appliance.base.actors import actor
from appliance.base.counted import counted
from appliance.base.timestamps import local_text
from appliance.channel.admin import PolicyWanted
from appliance.channel.answers.policy_answers import PolicyKnown
from appliance.cli.audit.audit_errors import Errors, fail, note
from appliance.cli.audit.record_argument import RecordArgument
from appliance.cli.audit.verification_text import print_verification, write
from appliance.cli.audit.verified import keep_verification
from appliance.cli.connection.admin_client import AccessDeniedError, NotRunningError
from appliance.cli.connection.audit_file import FileLog
from appliance.cli.connection.audit_source import AuditSource, audit_of
from appliance.cli.connection.target import Appliance, speaks_with
from appliance.cli.output import OR_STANDARD, STANDARD_OUTPUT, new_file
from appliance.features.audit_tools.csv_records import csv_head, csv_lines
from appliance.features.audit_tools.unrecorded import unknown_names
from appliance.features.views import pair_view
from appliance.policy.host_names import HostInWords
from appliance.policy.model import Category
from rosmop.tool.batch_session import progress

# Print audit records as text: a table on a terminal, lines in a pipe. Text from the network is escaped.

_STYLES = {"allow": "green", "deny": "bold red", "would deny": "yellow", "ask": "yellow"}
_SECONDS, _MILLISECONDS = 19, 23  # characters of a time
_DATE = 11
_LEAST_WHY = 40  # characters; with less room for the reasons in a column, they are below the records
_COLUMNS = ("record", "time", "decision", "event", "who", "what", "why")
_GAP = 2


def print_entries(entries: list[LogEntry], host_in_words: HostInWords, *, each: bool = False) -> None:
    """Print records; on a terminal, equal records are one row unless `each`."""
    if sys.stdout.isatty():
        rows = [row for entry in entries for row in group_equal([entry])] if each else group_equal(entries)
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
        request_of(record),
        record.resource,
        _parameter(record),
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
        Text(_join(_host(record, host_in_words), record.caller_id, _by(record))),
        Text(_join(request_of(record), _monitor(record), record.resource, _parameter(record))),
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


def _parameter(record: AuditRecord) -> str | None:
    """Return the parameter of a call."""
    key = record.detail.get("key")
    return str(key) if key is not None and record.category == Category.COMMAND else None


def _by(record: AuditRecord) -> str | None:
    who = record.detail.get("who")
    unknown = (
        who == "None" and record.event in FOLDED
    )  # as versions up to 0.2.0 counted calls without a token
    return f"by {actor(str(who))}" if who and not unknown else None


def _why_of_several(row: EqualRecords) -> str:
    newest = msgspec.structs.replace(row.last.record, reason=row.value, event="")
    return f"{row.count} times, last: {_why(newest)}" if row.value else f"{row.count} times"


def _join(*parts: str | None) -> str:
    return " ".join(printable(part) for part in parts if part)


def _why(record: AuditRecord) -> str:
    rule = record.rule
    named = rule is None or f"{Path(rule.file).name}:{rule.line}" in record.reason
    why = record.reason if named else f"{record.reason} ({rule_text(record.rule)})"
    count = record.detail.get("count") if record.event in FOLDED else None
    return printable(f"{count} more: {why}" if count else why)


_CHECKPOINT_SECONDS = (
    5.0  # pause between two queries: a checkpoint is made once a minute, and REST queries are recorded
)
_PROGRESS_EVERY = 1000  # records
_JSON_HELP = "Machine-readable output, one object per line"
_ALWAYS_JSON_HELP = "Accepted; the output is always NDJSON"


@speaks_with(_JSON_HELP, FILTER)
@Errors()
def search(
    appliance: Appliance,
    *,
    limit: Annotated[
        int, typer.Option("--limit", min=1, max=LARGEST_PAGE, help="Largest number of records")
    ] = 100,
    oldest_first: Annotated[bool, typer.Option("--oldest-first", help="Start with the first record")] = False,
    cursor: Annotated[str | None, typer.Option("--cursor", help="Continue where a search ended")] = None,
    each: Annotated[
        bool, typer.Option("--each", help="On a terminal, show each of several equal records in its own row")
    ] = False,
) -> None:
    """Find records, newest first.

    On a terminal, equal consecutive records share a row, which shows how many there are, the first and last time, the
    number of the first record and the last value. In a pipe and with --json, each record is one line.

    Example: rosrv audit search --deny --since 1h --topic '/cmd_*'
    """
    wanted = _filter_of(appliance)
    page = audit_of(appliance.way).search(wanted, cursor, limit, newest_first=not oldest_first)
    if appliance.as_json:
        _print_lines(page.entries, appliance)
    else:
        print_entries(page.entries, appliance.host_in_words, each=each)
        if not page.entries:
            note(f"no record matches{_hint(wanted)}")
    if page.cursor is not None:
        note(f"more records match: --cursor {page.cursor}, or a larger --limit")


def _hint(wanted: Filter) -> str:
    given = (("--topic", wanted.resource), ("--caller", wanted.caller_id))
    bare = [f"{option} /{name}" for option, name in given if name and name[0] not in "/*?["]
    if bare:
        return f"; names in ROS begin with a slash: {' '.join(bare)}"
    name = wanted.resource or ""
    parameter = name.startswith("/") and wanted.text is None and not any(sign in name for sign in "*?[")
    return f"; for calls on this parameter use --text {name} instead of --topic" if parameter else ""


@speaks_with(_JSON_HELP, FILTER)
@Errors()
def tail(
    appliance: Appliance,
    *,
    lines: Annotated[
        int, typer.Option("--lines", "-n", min=0, max=LARGEST_PAGE, help="Records to show first")
    ] = 10,
    follow: Annotated[bool, typer.Option(help="Wait for new records until interrupted")] = True,
) -> None:
    """Show the last records and follow the log.

    Example: rosrv audit tail --deny
    """
    for entries in audit_of(appliance.way).follow(_filter_of(appliance), lines, on=follow):
        _print_lines(entries, appliance)


@speaks_with(_JSON_HELP)
def show(
    appliance: Appliance,
    record: RecordArgument,
    neighbours: Annotated[
        int, typer.Option("--neighbours", min=0, max=1000, help="Records to show around it")
    ] = 5,
) -> None:
    """Show one record in full, with the records of the same host or caller around it.

    Example: rosrv audit show 18e9aa02efc40abb0e51
    """
    with Errors():
        shown = audit_of(appliance.way).show(record, neighbours)
        if shown is None:
            fail(f"no record in the log has the id {record!a}; list them: rosrv audit search", 1)
        if appliance.as_json:
            around = {
                "before": [as_object(one) for one in shown.before],
                "after": [as_object(one) for one in shown.after],
            }
            write(json.dumps(as_object(shown.entry) | {"neighbours": around}))
        else:
            print_shown(shown, appliance.host_in_words)


@speaks_with(_JSON_HELP)
def verify(
    appliance: Appliance,
    *,
    key: Annotated[
        Path | None,
        typer.Option("--key", help="Public key (PEM) of the key pair that must have signed the checkpoints"),
    ] = None,
    checkpoints: Annotated[
        Path | None,
        typer.Option("--checkpoints", help="Checkpoints kept on another machine: NDJSON, or a syslog file"),
    ] = None,
    other: Annotated[
        Path | None,
        typer.Option(
            "--other",
            help="State directory, or a copy, of the other appliance of a pair: verify both logs, and the takeovers"
            " between them",
        ),
    ] = None,
    other_key: Annotated[
        Path | None, typer.Option("--other-key", help="Public key (PEM) of the other appliance's log")
    ] = None,
    other_checkpoints: Annotated[
        Path | None,
        typer.Option("--other-checkpoints", help="Checkpoints of the other log kept on another machine"),
    ] = None,
) -> None:
    """Verify that the log is complete and unchanged. Exit status: 0 yes, 1 no, 2 cannot be read.

    Signatures are checked with the key beside the log, or with --key. For root, checkpoints are also compared with
    the signer's memory; the output says whether they were. With --checkpoints, they are compared with copies on
    another machine, which even root on this one cannot change. To prove records without the log, use `rosrv evidence
    export` and `rosrv evidence verify`.

    Example: rosrv audit verify --key audit.pub --checkpoints checkpoints.ndjson
    """
    if other is None and (other_key is not None or other_checkpoints is not None):
        fail("--other-key and --other-checkpoints need --other, the other appliance's state directory", 2)
    with Errors():
        source = audit_of(appliance.way)
        partner = None if other is None else _files(source, other)
        result = _verify(source, key, checkpoints)
        if partner is None or other is None:
            _print_result(result, print_verification, as_json_lines=appliance.as_json)
            return
        own, of_other = partner
        found, printed = resolve_name(pair_view().verification)(
            own.path, result, of_other.path, other, lambda: _verify(of_other, other_key, other_checkpoints)
        )
        _print_result(found, printed, as_json_lines=appliance.as_json)


def _files(source: AuditSource, other: Path) -> tuple[FileLog, FileLog]:
    if not isinstance(source, FileLog):
        fail("--other needs the logs' files: run this with --state, on any machine with copies of both", 2)
    if not (other / "control").is_dir():
        fail(f"{other} is not a state directory: give the other appliance's with --other", 2)
    return source, FileLog(other)


def _verify(source: AuditSource, key: Path | None, checkpoints: Path | None) -> Verification:
    copies = None if checkpoints is None else read_copies(checkpoints)
    public_key = None if key is None else read_public_key(key)
    began = clock.now()
    with progress("checking the chain", source.last) as report:
        result = source.verify(public_key, copies, report)
    if isinstance(source, FileLog):
        keep_verification(source.path, result, clock.now() - began)
    return result


class _Result(Protocol):
    @property
    def ok(self) -> bool: ...


_R = TypeVar("_R", bound=_Result)


def _print_result(result: _R, printed: Callable[[_R], None], *, as_json_lines: bool) -> None:
    if as_json_lines:
        write(json.dumps(msgspec.to_builtins(result)))
    else:
        printed(result)
    if not result.ok:
        raise typer.Exit(1)


@speaks_with(_ALWAYS_JSON_HELP)
def checkpoints(
    appliance: Appliance,
    after: Annotated[int, typer.Option("--after", min=0, help="Only checkpoints with a greater number")] = 0,
    follow: Annotated[
        bool, typer.Option("--follow", help="Wait for new checkpoints until interrupted")
    ] = False,
) -> None:
    """Write the signed checkpoints as NDJSON. Keep them on another machine for `verify --checkpoints`.

    With --follow, an appliance that restarts is asked again until it answers. Exit status: 1 if the reader of the
    output ends, 2 if the token is rejected.

    Example: rosrv audit checkpoints --follow | ssh keeper 'cat >> signed.ndjson'
    """
    with Errors(unread=1 if follow else 0):
        for found in _checkpoints(audit_of(appliance.way).checkpoints, after, follow=follow):
            for checkpoint in found:
                write(checkpoint.as_json())
            sys.stdout.flush()


def _checkpoints(
    read: Callable[[int], list[SignedCheckpoint]], after: int, *, follow: bool
) -> Iterator[list[SignedCheckpoint]]:
    pause, away = threading.Event(), False
    last: SignedCheckpoint | None = None
    yield (found := read(after))
    while found or follow:
        if found:
            last = found[-1]
        else:
            pause.wait(_CHECKPOINT_SECONDS)
        try:
            found = read(after) if last is None else _later(read, last)
            away = False
        except NotRunningError as error:
            if not follow or isinstance(error, AccessDeniedError):
                raise
            if not away:  # it may be restarting
                note(f"{printable(str(error))}; trying again")
            found, away = [], True
        yield found


def _later(read: Callable[[int], list[SignedCheckpoint]], last: SignedCheckpoint) -> list[SignedCheckpoint]:
    """Return the checkpoints after the last one, or all those of a log that has replaced its log."""
    found = read(last.number - 1)
    if found and (found[0].log, found[0].number) == (last.log, last.number):
        return found[1:]
    anew = read(0)
    if anew and anew[0].log != last.log:
        note(f"log {anew[0].log} took the place of log {last.log}: see rosrv audit verify")
    return anew


@speaks_with(_ALWAYS_JSON_HELP, FILTER)
@Errors()
def export(
    appliance: Appliance,
    *,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help=f"File, must not exist; {OR_STANDARD} (default)"),
    ] = None,
    as_csv: Annotated[
        bool, typer.Option("--csv", help="CSV for a spreadsheet instead of NDJSON, without proofs")
    ] = False,
) -> None:
    """Write all matching records as NDJSON, oldest first, each with its position in the hash chain.

    In CSV, a cell that a spreadsheet would take for a formula begins with an apostrophe. To prove records on another
    machine, use `rosrv evidence export`.

    Example: rosrv audit export --since 7d --output week.ndjson
    """
    wanted = _filter_of(appliance)
    source = audit_of(appliance.way)
    entries = _csv(source.export(wanted)) if as_csv else source.evidence(wanted)
    with (
        progress("exporting", source.last, shares_screen=output is None) as report,
        new_file(output or STANDARD_OUTPUT) as file,
    ):
        count = _write_all(entries, report, file)
    if output is not None:
        note(f"{counted(count - as_csv, 'record')} in {output}")


def _csv(entries: Iterator[LogEntry]) -> Iterator[tuple[int, str]]:
    yield 0, csv_head()
    yield from csv_lines(entries)


def _filter_of(appliance: Appliance) -> Filter:
    """Return the filter, with networks instead of a host's name. Raises `FilterError`."""
    wanted = FILTER.value(appliance.params)
    for warning in unknown_names(wanted):
        note(printable(warning))
    if has_name(wanted) and appliance.place is None:  # over REST, the appliance looks the name up
        return with_networks(wanted, _known(appliance, wanted))
    return wanted


def _known(appliance: Appliance, wanted: Filter) -> PolicyKnown:
    try:
        answer = appliance.ask(PolicyWanted())
    except NotRunningError:
        raise FilterError(
            f"--host {wanted.host}: only the running appliance knows the names of hosts; give an address or a glob"
        ) from None
    if not answer.ok:
        raise FilterError(f"--host {wanted.host}: {answer.error}")
    return answer.unwrap()


def _print_lines(entries: list[LogEntry], appliance: Appliance) -> None:
    for entry in entries:
        write(as_json(entry) if appliance.as_json else line(entry, appliance.host_in_words))
    sys.stdout.flush()


def _write_all(lines: Iterable[tuple[int, str]], report: Callable[[int], None], file: BinaryIO) -> int:
    count = 0
    for count, (sequence, line_of) in enumerate(lines, 1):
        file.write(f"{line_of}\n".encode("ascii"))
        if count % _PROGRESS_EVERY == 0:
            report(sequence)
    file.flush()
    return count
