"""The commands `rosrv policy grant` and `rosrv audit why`."""

import shlex
from datetime import UTC
from pathlib import Path
from typing import Annotated, NoReturn

import msgspec
import typer

from appliance.audit.log.ids import ID_OR_SEQUENCE
from appliance.audit.log.record_format import LogEntry
from appliance.audit.search.search import recorded_in_full
from appliance.base.counted import counted
from appliance.base.input_files import read_given
from appliance.base.timestamps import in_local_zone
from appliance.channel.admin import PolicyLoad, PolicyWanted
from appliance.channel.answers.policy_answers import Granted, Why
from appliance.cli.audit.audit_errors import Errors, fail
from appliance.cli.audit.record_argument import RecordArgument
from appliance.cli.commit_confirm import ConfirmWithin, seconds_within
from appliance.cli.connection.admin_client import NotRunningError, RestProblemError
from appliance.cli.connection.audit_file import FileLog
from appliance.cli.connection.audit_source import audit_of
from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.durations import bounded_span
from appliance.cli.output import OR_STANDARD, say_json, usage_error, write_told
from appliance.features.policy_tools.explanations import asks_policy, explained, grant_of
from appliance.features.policy_tools.grant import UngrantableError
from appliance.features.policy_tools.live_verbs import say_loaded
from appliance.policy.hours import instant
from rosmop.tool.terminal import printable, say


@speaks
def why(appliance: Appliance, record: RecordArgument) -> None:
    """Explain a record: its sender, events, values, line of the specification and recording, and the rule that would
    allow a denied request.

    The listed events are those that led to a monitor's verdict. The appliance may be stopped; only the rule that would
    allow a denied request needs the running appliance.

    Example: rosrv audit why 18e9aa02efc40abb0e51
    """
    found = _explain(appliance, record)
    if appliance.as_json:
        say_json(found)
        return
    for line in found.lines:
        say(printable(in_local_zone(line)), "green" if line.startswith("would be allowed by") else "")
    if found.refusal:
        say(printable(found.refusal), "yellow")


def _explain(appliance: Appliance, record: str) -> Why:
    if appliance.place is not None:
        return msgspec.convert(_over_rest(appliance, record, "why"), Why)

    with Errors():
        entry = _entry(appliance, record)
        found = entry.record
        try:
            known = appliance.ask(PolicyWanted()).unwrap() if asks_policy(found) else None
        except NotRunningError as error:
            typer.echo(
                f"rosrv audit: {error}; without it, the rule that would allow the request is unknown",
                err=True,
            )
            known = None
        source = audit_of(appliance.way)
        assert isinstance(source, FileLog)  # noqa: S101  it has no place
        return explained(found, known, recorded_in_full(source.path, entry), appliance.host_in_words)


@speaks
def grant(
    appliance: Appliance,
    record: RecordArgument,
    *,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help=f"File for the changed policy; replaced if it exists; {OR_STANDARD}"
        ),
    ] = None,
    tool: Annotated[
        bool,
        typer.Option("--tool", help="Grant everything that the denied stock tool (such as rostopic) needs"),
    ] = False,
    until: Annotated[
        str,
        typer.Option(
            "--until",
            metavar="TIME",
            help="End of the right, in the policy's zone: 2026-12-05 (that day included), or 2026-12-05T18:00",
        ),
    ] = "",
    for_time: Annotated[
        str, typer.Option("--for", metavar="DURATION", help="End of the right, from now: 2h, 7d")
    ] = "",
    load: Annotated[bool, typer.Option("--load", help="Bring the changed policy into force")] = False,
    confirm_within: ConfirmWithin = None,
) -> None:
    """Show the smallest policy change that would allow a denied request.

    A stock tool makes several calls, one after the other; with --tool the change allows all of them.

    The change is checked with the policy's tests. Only --output and --load change anything. Exit status 1 if no rule
    can grant the request or a test fails.

    Example: rosrv policy grant 18e9aa02efc40abb0e51 --load --confirm-within 5m
    """
    within = seconds_within(confirm_within, "policy")
    if within is not None and not load:
        raise usage_error("--confirm-within needs --load")
    found = _grant(appliance, record, tool=tool, until=_end(until, for_time))
    if appliance.as_json:
        say_json(found)
    else:
        _show(found, record)
    if found.findings or not found.added:
        raise typer.Exit(1)
    if output is not None:
        try:
            write_told(output, _with_ends_of(output, found.text))
        except OSError as error:
            raise usage_error(f"cannot write {output}: {error.strerror}") from None
        if not appliance.as_json and not load:
            say(f"written to {output}; the policy in force is unchanged until it is loaded")
    if load:
        order = PolicyLoad(found.text, f"grants record {record[:100]}", within, found.revision)
        body = appliance.ask_or_exit(order)
        if appliance.as_json:
            say_json(body)
        else:
            say_loaded(body)


def _end(until: str, for_time: str) -> str:
    if until and for_time:
        raise usage_error("give --until or --for, not both", "rosrv policy")
    if for_time:
        bounded_span("--for", for_time, "1m", "520w", "rosrv policy")
    if until:
        try:
            instant(until, UTC)
        except ValueError:
            text = f"--until: {until!r} is not a valid time: write 2026-12-05, or 2026-12-05T18:00"
            raise usage_error(text, "rosrv policy") from None
    return until or for_time


def _with_ends_of(file: Path, text: str) -> bytes:
    """Keep the line ends of the existing file; a new file gets LF."""
    ends = b"\r\n" if file.is_file() and b"\r\n" in read_given(file) else b"\n"
    return text.encode().replace(b"\n", ends)


def _show(found: Granted, record: str) -> None:
    say(f"denied: {printable(found.reason)}")
    if not found.added:
        say(
            "the policy in force grants it: it was denied for another reason, or before this revision",
            "yellow",
        )
    for line in found.diff:
        say(printable(line), {"+": "green", "-": "red"}.get(line[:1], ""))
    for finding in found.findings:
        say(printable(finding), "red")
    if found.tool_needs:
        more = counted(len(found.tool_needs), "more line")
        all_of_it = f"rosrv policy grant {shlex.quote(record)} --tool"
        say(f"other verbs of {found.tool} need up to {more}: {all_of_it}", "yellow")


def _grant(appliance: Appliance, record: str, *, tool: bool, until: str) -> Granted:
    if appliance.place is not None:
        return msgspec.convert(_over_rest(appliance, record, "grant", tool=tool, until=until), Granted)

    with Errors():
        found = _entry(appliance, record).record
        known = appliance.ask_or_exit(PolicyWanted())
        try:
            return grant_of(found, known, whole_tool=tool, until=until)
        except UngrantableError as error:
            fail(str(error), 1)


def _entry(appliance: Appliance, record: str) -> LogEntry:
    shown = audit_of(appliance.way).show(record, 0)
    if shown is None:
        _unknown(record)
    return shown.entry


def _unknown(record: str) -> NoReturn:
    fail(f"no record in the log has the id {record!a}; list them: rosrv audit search", 1)


def _over_rest(
    appliance: Appliance, record: str, what: str, *, tool: bool = False, until: str = ""
) -> dict[str, object]:
    if not ID_OR_SEQUENCE.fullmatch(record):
        _unknown(record)
    with Errors():
        try:
            params = ({"tool": "1"} if tool else {}) | ({"until": until} if until else {})
            return appliance.rest.call("GET", f"/v1/audit/{record}/{what}", params=params or None)
        except RestProblemError as problem:
            if problem.status == 404:
                _unknown(record)
            fail(problem.lines[0], 1)
