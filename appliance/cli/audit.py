"""`rosrv audit tail|search|show|verify|export`: the review of the audit log.

Reads the log's file directly, so it works while the appliance runs, when it is stopped, and on a copy.
"""

import json
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, NoReturn, TextIO

import msgspec
import typer
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from appliance.audit.copies import CopiesUnreadableError, read_copies, signed_checkpoints
from appliance.audit.database import LogUnreadableError
from appliance.audit.moment import MomentError, parse_moment
from appliance.audit.output import Entry, as_json, as_object, printable
from appliance.audit.query import Filter, FilterError
from appliance.audit.record import Severity
from appliance.audit.search import LARGEST_PAGE, Follower
from appliance.audit.search import export as export_entries
from appliance.audit.search import search as search_log
from appliance.audit.search import show as show_one
from appliance.audit.signatures import KeyUnreadableError, read_public_key
from appliance.audit.verify import verify as verify_log
from appliance.cli.audit_output import line, print_entries, print_shown, print_verification, write
from appliance.config import Settings

app = typer.Typer(help="Review the audit log and prove that it is complete.", no_args_is_help=True)

CANNOT_READ = 2
DEFAULT_STATE: Path = Settings.model_fields["state"].default
_POLL_SECONDS = 0.2
_PROGRESS_EVERY = 1000

_State = Annotated[
    Path,
    typer.Option("--state", envvar="ROSRV_STATE", help="State directory of the appliance", readable=False),
]
_Deny = Annotated[bool, typer.Option("--deny", help="Only what was denied (and summaries of denials)")]
_Allow = Annotated[bool, typer.Option("--allow", help="Only what was allowed")]
_WouldDeny = Annotated[bool, typer.Option("--would-deny", help="Only what a trial policy would have denied")]
_Since = Annotated[
    str | None, typer.Option("--since", help="From this moment: 1h (ago), a date, or RFC 3339")
]
_Until = Annotated[str | None, typer.Option("--until", help="Before this moment")]
_Topic = Annotated[
    str | None,
    typer.Option("--topic", "--resource", help="Topic, service, parameter, call; a glob: '/cmd_*'"),
]
_Host = Annotated[str | None, typer.Option("--host", help="Address of the peer; a glob")]
_Caller = Annotated[str | None, typer.Option("--caller", help="Name the node gave; a glob")]
_Event = Annotated[str | None, typer.Option("--event", help="Name of the event; a glob")]
_Category = Annotated[str | None, typer.Option("--category", help="Category of the request; a glob")]
_Severity = Annotated[Severity | None, typer.Option("--severity", help="This severity or a graver one")]
_Rule = Annotated[str | None, typer.Option("--rule", help="Section or key of the policy rule; a glob")]
_Text = Annotated[str | None, typer.Option("--text", help="Found anywhere in names, reason and details")]
_Json = Annotated[bool, typer.Option("--json", help="One JSON object a line (NDJSON)")]


@app.command()
def search(
    *, state: _State = DEFAULT_STATE,
    deny: _Deny = False, allow: _Allow = False, would_deny: _WouldDeny = False,
    since: _Since = None, until: _Until = None, topic: _Topic = None, host: _Host = None,
    caller: _Caller = None, event: _Event = None, category: _Category = None, severity: _Severity = None,
    rule: _Rule = None, text: _Text = None,
    limit: Annotated[int, typer.Option("--limit", min=1, max=LARGEST_PAGE, help="At most")] = 100,
    oldest_first: Annotated[bool, typer.Option("--oldest-first", help="From the first record on")] = False,
    cursor: Annotated[str | None, typer.Option("--cursor", help="Go on where a search ended")] = None,
    as_json_lines: _Json = False,
) -> None:  # fmt: skip
    """Find records, newest first.

    Example: rosrv audit search --deny --since 1h --topic '/cmd_*'
    """
    with _Errors():
        decisions = _decisions(deny=deny, allow=allow, would_deny=would_deny)
        wanted = _filter(
            decisions, since, until, host=host, caller_id=caller, resource=topic, category=category,
            event=event, severity=severity, rule=rule, text=text,
        )  # fmt: skip
        page = search_log(_log(state), wanted, cursor, limit, newest_first=not oldest_first)
        _print(page.entries, as_json_lines)
        if page.cursor is not None:
            _say(f"more records match: --cursor {page.cursor}, or a larger --limit")


@app.command()
def tail(
    *, state: _State = DEFAULT_STATE,
    deny: _Deny = False, allow: _Allow = False, would_deny: _WouldDeny = False,
    since: _Since = None, until: _Until = None, topic: _Topic = None, host: _Host = None,
    caller: _Caller = None, event: _Event = None, category: _Category = None, severity: _Severity = None,
    rule: _Rule = None, text: _Text = None,
    lines: Annotated[int, typer.Option("--lines", "-n", min=0, max=LARGEST_PAGE, help="At first")] = 10,
    follow: Annotated[bool, typer.Option(help="Wait for more, until interrupted")] = True,
    as_json_lines: _Json = False,
) -> None:  # fmt: skip
    """Show the last records and follow the log.

    Example: rosrv audit tail --deny
    """
    with _Errors():
        decisions = _decisions(deny=deny, allow=allow, would_deny=would_deny)
        wanted = _filter(
            decisions, since, until, host=host, caller_id=caller, resource=topic, category=category,
            event=event, severity=severity, rule=rule, text=text,
        )  # fmt: skip
        path = _log(state)
        follower = Follower(path, wanted)
        if lines:
            last = search_log(path, wanted, str(follower.position + 1), lines)
            _print_lines(last.entries[::-1], as_json_lines)
        pause = threading.Event()
        while follow:
            _print_lines(follower.poll(), as_json_lines)
            pause.wait(_POLL_SECONDS)


@app.command()
def show(
    record_id: Annotated[str, typer.Argument(metavar="ID", help="The record's id, or its sequence")],
    state: _State = DEFAULT_STATE,
    neighbours: Annotated[int, typer.Option("--neighbours", min=0, max=1000, help="How many around it")] = 5,
    as_json_lines: _Json = False,
) -> None:
    """Show one record in full, and what the same host or caller did around it.

    Example: rosrv audit show 18e9aa02efc40abb0e51
    """
    with _Errors():
        path = _log(state)
        shown = show_one(path, record_id, neighbours)
        if shown is None:
            _fail(f"{path}: no record with the id {record_id!a}", 1)
        if as_json_lines:
            around = {
                "before": [as_object(one) for one in shown.before],
                "after": [as_object(one) for one in shown.after],
            }
            write(json.dumps(as_object(shown.entry) | {"neighbours": around}))
        else:
            print_shown(shown)


@app.command()
def verify(
    state: _State = DEFAULT_STATE,
    key: Annotated[
        Path | None, typer.Option("--key", help="Public key (PEM) that the checkpoints must be signed with")
    ] = None,
    checkpoints: Annotated[
        Path | None,
        typer.Option("--checkpoints", help="Checkpoints kept on another machine: NDJSON, or a syslog file"),
    ] = None,
    as_json_lines: _Json = False,
) -> None:
    """Prove that the log is complete and unchanged: exit status 0, else 1; 2 if it cannot be read.

    The key is the one pinned beside the log, unless --key gives one that was kept elsewhere. The checkpoints
    are also held against what the signer remembers, if its directory can be read; with --checkpoints, the log against
    what another machine was given, which nobody here can change, root neither.

    Example: rosrv audit verify --key /media/safe/audit.pub --checkpoints /media/safe/checkpoints.ndjson
    """
    with _Errors():
        path = _log(state)
        copies = None if checkpoints is None else read_copies(checkpoints)
        public_key = None if key is None else read_public_key(key)
        signer = path.parent.parent / "signer"
        with _progress("checking the chain"):
            result = verify_log(
                path, public_key, signer if os.access(signer, os.R_OK | os.X_OK) else None, copies
            )
        if as_json_lines:
            write(json.dumps(msgspec.to_builtins(result)))
        else:
            print_verification(result)
        if not result.ok:
            raise typer.Exit(1)


@app.command()
def checkpoints(
    state: _State = DEFAULT_STATE,
    after: Annotated[int, typer.Option("--after", min=0, help="Only those with a greater number")] = 0,
    follow: Annotated[bool, typer.Option("--follow", help="Wait for more, until interrupted")] = False,
    as_json_lines: Annotated[bool, typer.Option("--json", help="NDJSON, which it always is")] = True,  # noqa: ARG001  every verb takes --json
) -> None:
    """Write the signed checkpoints as NDJSON: keep them on another machine, for `verify --checkpoints`.

    Example: rosrv audit checkpoints --follow | ssh keeper 'cat >> checkpoints.ndjson'
    """
    with _Errors():
        path = _log(state)
        pause = threading.Event()
        while True:
            found = signed_checkpoints(path, after)
            for one in found:
                write(one.as_json())
                after = one.number
            sys.stdout.flush()
            if not found:
                if not follow:
                    break
                pause.wait(_POLL_SECONDS)


@app.command()
def export(
    *, state: _State = DEFAULT_STATE,
    deny: _Deny = False, allow: _Allow = False, would_deny: _WouldDeny = False,
    since: _Since = None, until: _Until = None, topic: _Topic = None, host: _Host = None,
    caller: _Caller = None, event: _Event = None, category: _Category = None, severity: _Severity = None,
    rule: _Rule = None, text: _Text = None,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="File, must not exist")] = None,
    as_json_lines: Annotated[bool, typer.Option("--json", help="NDJSON, which it always is")] = True,  # noqa: ARG001  every verb takes --json
) -> None:  # fmt: skip
    """Write all records that match as NDJSON, oldest first.

    Example: rosrv audit export --since 7d --output week.ndjson
    """
    with _Errors():
        decisions = _decisions(deny=deny, allow=allow, would_deny=would_deny)
        wanted = _filter(
            decisions, since, until, host=host, caller_id=caller, resource=topic, category=category,
            event=event, severity=severity, rule=rule, text=text,
        )  # fmt: skip
        entries = export_entries(_log(state), wanted)
        with _progress("exporting") as progress:
            if output is None:
                count = _write_all(entries, progress, sys.stdout)
            else:
                with output.open("x", encoding="ascii") as file:
                    count = _write_all(entries, progress, file)
        if output is not None:
            _say(f"{count} records in {output}")


class _Errors:
    """Says in words what went wrong, and ends with the exit status for it."""

    def __enter__(self) -> None:
        pass

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        match error:
            case LogUnreadableError() | KeyUnreadableError() | CopiesUnreadableError():
                _fail(str(error), CANNOT_READ)
            case FilterError() | MomentError():
                _fail(str(error), CANNOT_READ)
            case BrokenPipeError():
                # The reader (head, less) has enough: what is still buffered has nowhere to go.
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
                raise typer.Exit(0)
            case KeyboardInterrupt():
                raise typer.Exit(0)
            case PermissionError():
                _fail(f"{error.filename}: {error.strerror}; run this as root", CANNOT_READ)
            case OSError():
                _fail(f"{error.filename or 'output'}: {error.strerror}", CANNOT_READ)


def _log(state: Path) -> Path:
    if not state.is_dir():
        raise LogUnreadableError(f"{state}: no such directory; is the state directory right (--state)?")
    return state / "control" / "audit.db"


def _decisions(*, deny: bool, allow: bool, would_deny: bool) -> tuple[str, ...]:
    wanted = {"deny": deny, "allow": allow, "would deny": would_deny}
    return tuple(name for name, asked in wanted.items() if asked)


def _filter(decision: tuple[str, ...], since: str | None, until: str | None, **rest: Any) -> Filter:
    now = time.time_ns()
    return Filter(
        decision=decision,
        since=None if since is None else parse_moment(since, now),
        until=None if until is None else parse_moment(until, now),
        **rest,
    )


def _print(entries: list[Entry], as_json_lines: bool) -> None:
    if as_json_lines:
        _print_lines(entries, as_json_lines)
    else:
        print_entries(entries)


def _print_lines(entries: list[Entry], as_json_lines: bool) -> None:
    for entry in entries:
        write(as_json(entry) if as_json_lines else line(entry))
    sys.stdout.flush()


def _write_all(entries: Iterable[Entry], progress: Callable[[int], None], file: TextIO) -> int:
    count = 0
    for count, entry in enumerate(entries, 1):
        file.write(as_json(entry) + "\n")
        if count % _PROGRESS_EVERY == 0:
            progress(count)
    file.flush()
    return count


@contextmanager
def _progress(what: str) -> Iterator[Callable[[int], None]]:
    """Shows on a terminal that long work goes on; elsewhere nothing."""
    console = Console(stderr=True)
    columns = (SpinnerColumn(), TextColumn(what), TextColumn("{task.completed} records"), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(what, total=None)
        yield lambda count: progress.update(task, completed=count)


def _say(text: str) -> None:
    sys.stderr.write(f"rosrv: {text}\n")


def _fail(text: str, status: int) -> NoReturn:
    _say(printable(text))
    raise typer.Exit(status)
