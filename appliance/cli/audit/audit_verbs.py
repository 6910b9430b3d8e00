"""`rosrv audit tail|search|show|verify|checkpoints|export`: the review of the audit log.

With a state directory they read the log's file, so they work while the appliance runs, when it is stopped, and on a
copy; with `--api` they read the running appliance's log over REST.
"""

import json
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, TextIO

import msgspec
import typer

from appliance.audit.copies import read_copies
from appliance.audit.export_proof import verify_export
from appliance.audit.query import Filter
from appliance.audit.record_format import Entry, as_json, as_object
from appliance.audit.search import LARGEST_PAGE
from appliance.audit.signatures import read_public_key
from appliance.cli.audit.audit_errors import Errors, fail, tell
from appliance.cli.audit.filter import filtered
from appliance.cli.audit.record_table import (
    line,
    print_entries,
    print_export_verification,
    print_shown,
    print_verification,
    write,
)
from appliance.cli.target import Appliance, speaks
from rosmop.tool.progress_bar import progress

_CHECKPOINT_SECONDS = 5.0  # between two looks: one is made a minute, and a look over REST is itself recorded
_TOLD_EVERY = 1000
_Json = Annotated[bool, typer.Option("--json", help="One JSON object a line (NDJSON)")]
_AlwaysJson = Annotated[bool, typer.Option("--json", help="NDJSON, which it always is")]


@speaks
@filtered
def search(
    appliance: Appliance,
    wanted: Filter,
    *,
    limit: Annotated[int, typer.Option("--limit", min=1, max=LARGEST_PAGE, help="At most")] = 100,
    oldest_first: Annotated[bool, typer.Option("--oldest-first", help="From the first record on")] = False,
    cursor: Annotated[str | None, typer.Option("--cursor", help="Go on where a search ended")] = None,
    as_json_lines: _Json = False,
) -> None:
    """Find records, newest first.

    Example: rosrv audit search --deny --since 1h --topic '/cmd_*'
    """
    page = appliance.audit().search(wanted, cursor, limit, newest_first=not oldest_first)
    if as_json_lines:
        _print_lines(page.entries, as_json_lines)
    else:
        print_entries(page.entries)
    if page.cursor is not None:
        tell(f"more records match: --cursor {page.cursor}, or a larger --limit")


@speaks
@filtered
def tail(
    appliance: Appliance,
    wanted: Filter,
    *,
    lines: Annotated[int, typer.Option("--lines", "-n", min=0, max=LARGEST_PAGE, help="At first")] = 10,
    follow: Annotated[bool, typer.Option(help="Wait for more, until interrupted")] = True,
    as_json_lines: _Json = False,
) -> None:
    """Show the last records and follow the log.

    Example: rosrv audit tail --deny
    """
    for entries in appliance.audit().follow(wanted, lines, on=follow):
        _print_lines(entries, as_json_lines)


@speaks
def show(
    appliance: Appliance,
    record_id: Annotated[str, typer.Argument(metavar="ID", help="The record's id, or its sequence")],
    neighbours: Annotated[int, typer.Option("--neighbours", min=0, max=1000, help="How many around it")] = 5,
    as_json_lines: _Json = False,
) -> None:
    """Show one record in full, and what the same host or caller did around it.

    Example: rosrv audit show 18e9aa02efc40abb0e51
    """
    with Errors():
        shown = appliance.audit().show(record_id, neighbours)
        if shown is None:
            fail(f"no record with the id {record_id!a} is in the log", 1)
        if as_json_lines:
            around = {
                "before": [as_object(record) for record in shown.before],
                "after": [as_object(record) for record in shown.after],
            }
            write(json.dumps(as_object(shown.entry) | {"neighbours": around}))
        else:
            print_shown(shown)


@speaks
def verify(
    appliance: Appliance,
    key: Annotated[
        Path | None, typer.Option("--key", help="Public key (PEM) that the checkpoints must be signed with")
    ] = None,
    checkpoints: Annotated[
        Path | None,
        typer.Option("--checkpoints", help="Checkpoints kept on another machine: NDJSON, or a syslog file"),
    ] = None,
    export_file: Annotated[
        Path | None,
        typer.Option("--export", help="What `rosrv audit export` wrote, on any machine; with --key"),
    ] = None,
    as_json_lines: _Json = False,
) -> None:
    """Prove that the log is complete and unchanged: exit status 0, else 1; 2 if it cannot be read.

    The key is the one pinned beside the log, unless --key gives one that was kept elsewhere. The checkpoints
    are also held against what the signer remembers, if its directory can be read; with --checkpoints, the log against
    what another machine was given, which nobody here can change, root neither. With --export, records that were
    exported, held against the public key alone: neither the log nor the appliance is asked.

    Example: rosrv audit verify --key /media/safe/audit.pub --checkpoints /media/safe/checkpoints.ndjson
    """
    if export_file is not None:
        _verify_export(export_file, key, copies=checkpoints is not None, as_json_lines=as_json_lines)
        return
    with Errors():
        source = appliance.audit()
        copies = None if checkpoints is None else read_copies(checkpoints)
        public_key = None if key is None else read_public_key(key)
        with progress("checking the chain", source.last) as told:
            result = source.verify(public_key, copies, told)
        if as_json_lines:
            write(json.dumps(msgspec.to_builtins(result)))
        else:
            print_verification(result)
        if not result.ok:
            raise typer.Exit(1)


def _verify_export(file: Path, key: Path | None, *, copies: bool, as_json_lines: bool) -> None:
    with Errors():
        if key is None or copies:
            fail(
                "--export takes --key, the appliance's public key (control/audit.pub in its state directory), and no"
                " --checkpoints: the export has its own",
                2,
            )
        result = verify_export(file, read_public_key(key))
        if as_json_lines:
            write(json.dumps(msgspec.to_builtins(result)))
        else:
            print_export_verification(result)
        if not result.ok:
            raise typer.Exit(1)


@speaks
def checkpoints(
    appliance: Appliance,
    after: Annotated[int, typer.Option("--after", min=0, help="Only those with a greater number")] = 0,
    follow: Annotated[bool, typer.Option("--follow", help="Wait for more, until interrupted")] = False,
    as_json_lines: _AlwaysJson = True,  # noqa: ARG001  every verb takes --json
) -> None:
    """Write the signed checkpoints as NDJSON: keep them on another machine, for `verify --checkpoints`.

    Example: rosrv audit checkpoints --follow | ssh keeper 'cat >> checkpoints.ndjson'
    """
    with Errors():
        source = appliance.audit()
        pause = threading.Event()
        while True:
            found = source.checkpoints(after)
            for checkpoint in found:
                write(checkpoint.as_json())
                after = checkpoint.number
            sys.stdout.flush()
            if not found:
                if not follow:
                    break
                pause.wait(_CHECKPOINT_SECONDS)


@speaks
@filtered
def export(
    appliance: Appliance,
    wanted: Filter,
    *,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="File, must not exist")] = None,
    as_json_lines: _AlwaysJson = True,  # noqa: ARG001  every verb takes --json
) -> None:
    """Write all records that match as NDJSON, oldest first, each with its place in the hash chain.

    It proves itself elsewhere: `rosrv audit verify --export week.ndjson --key audit.pub`.

    Example: rosrv audit export --since 7d --output week.ndjson
    """
    source = appliance.audit()
    entries = source.evidence(wanted)
    with progress("exporting", source.last, shares_screen=output is None) as told:
        if output is None:
            count = _write_all(entries, told, sys.stdout)
        else:
            with _new_file(output) as file:
                count = _write_all(entries, told, file)
    if output is not None:
        tell(f"{count} records in {output}")


def _print_lines(entries: list[Entry], as_json_lines: bool) -> None:
    formatted = as_json if as_json_lines else line
    for entry in entries:
        write(formatted(entry))
    sys.stdout.flush()


@contextmanager
def _new_file(path: Path) -> Iterator[TextIO]:
    """A file that is not there yet; one that is not whole is none."""
    file = path.open("x", encoding="ascii")
    try:
        with file:
            yield file
    except BaseException as error:
        path.unlink()
        if isinstance(error, OSError):  # a full disk: the system does not say of which file
            error.filename = error.filename or str(path)
        raise


def _write_all(lines: Iterable[tuple[int, str]], told: Callable[[int], None], file: TextIO) -> int:
    count = 0
    for count, (sequence, line_of) in enumerate(lines, 1):
        file.write(line_of + "\n")
        if count % _TOLD_EVERY == 0:
            told(sequence)
    file.flush()
    return count
