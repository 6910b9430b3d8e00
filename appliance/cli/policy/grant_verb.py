"""`rosrv policy grant`: what would grant a request that was refused, as the smallest change of the policy in force."""

from pathlib import Path
from typing import Annotated, Any, NoReturn

import msgspec
import typer

from appliance.audit.record import Record
from appliance.base.input_files import read_given
from appliance.channel.admin import PolicyLoad, PolicyWanted
from appliance.channel.answers.policy_answers import Granted, Why
from appliance.cli.admin_client import NotRunningError
from appliance.cli.audit.audit_errors import Errors, fail
from appliance.cli.commit_confirm import ConfirmWithin, seconds_within
from appliance.cli.output import say_json, usage_error, write_told
from appliance.cli.policy.live_verbs import say_loaded
from appliance.cli.target import Appliance, speaks
from rosmop.tool.terminal import printable, say


@speaks
def why(
    appliance: Appliance,
    record: Annotated[str, typer.Argument(metavar="RECORD", help="The record's id, or its sequence")],
) -> None:
    """Say why what a record tells happened: who, which events and values, which line; what would allow a refusal.

    The named events alone give a monitor's verdict. The record may be of a log whose appliance is stopped; only what
    would allow a refusal is asked of the running appliance.

    Example: rosrv audit why 18e9aa02efc40abb0e51
    """
    found = _explained(appliance, record)
    if appliance.as_json:
        say_json(found)
        return
    for line in found.lines:
        say(printable(line), "green" if line.startswith("would be allowed by") else "")
    if found.refusal:
        say(printable(found.refusal), "yellow")


def _explained(appliance: Appliance, record: str) -> Why:
    if appliance.place is not None:
        return msgspec.convert(_over_rest(appliance, record, "why"), Why)
    from appliance.api.denials import asks_policy  # noqa: PLC0415  not for every verb
    from appliance.api.dry_run_policy import explained  # noqa: PLC0415  as above

    with Errors():
        found = _record(appliance, record)
        try:
            known = appliance.ask(PolicyWanted()).given() if asks_policy(found) else None
        except NotRunningError as error:
            typer.echo(f"rosrv audit: {error}; what would allow it is not known without it", err=True)
            known = None
        return explained(found, known)


@speaks
def grant(
    appliance: Appliance,
    record: Annotated[str, typer.Argument(metavar="RECORD", help="The id of a refusal's audit record")],
    *,
    write: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the whole policy with the change to this file")
    ] = None,
    load: Annotated[bool, typer.Option("--load", help="Bring the policy with the change into force")] = False,
    confirm_within: ConfirmWithin = None,
) -> None:
    """Show the smallest change of the policy in force that grants what a record says was refused.

    It is tried against the policy's tests; nothing is changed unless --write or --load says so. Exit status 1 when no
    line of a policy grants it, or a test fails.

    Example: rosrv policy grant 18e9aa02efc40abb0e51 --load --confirm-within 5m
    """
    within = seconds_within(confirm_within, "policy")
    if within is not None and not load:
        raise usage_error("--confirm-within is for --load")
    found = _granted(appliance, record)
    if appliance.as_json:
        say_json(found)
    else:
        _show(found)
    if found.findings or not found.added:
        raise typer.Exit(1)
    if write is not None:
        try:
            write_told(write, _with_ends_of(write, found.text))
        except OSError as error:
            raise usage_error(f"cannot write {write}: {error.strerror}") from None
    if load:
        order = PolicyLoad(found.text, f"grants record {record[:100]}", within, found.revision)
        body = appliance.ask_or_exit(order)
        if appliance.as_json:
            say_json(body)
        else:
            say_loaded(body)


def _with_ends_of(file: Path, text: str) -> bytes:
    """The text with lines that end as those of the file that is there; what is in force has none but LF."""
    ends = b"\r\n" if file.is_file() and b"\r\n" in read_given(file) else b"\n"
    return text.encode().replace(b"\n", ends)


def _show(found: Granted) -> None:
    say(f"refused: {printable(found.reason)}")
    if not found.added:
        say(
            "the policy in force grants it: it was refused for another reason, or before this revision",
            "yellow",
        )
    for line in found.diff:
        say(printable(line), {"+": "green", "-": "red"}.get(line[:1], ""))
    for finding in found.findings:
        say(printable(finding), "red")


def _granted(appliance: Appliance, record: str) -> Granted:
    """Over REST the appliance works it out, over the socket this program."""
    if appliance.place is not None:
        return msgspec.convert(_over_rest(appliance, record, "grant"), Granted)
    from appliance.api.dry_run_policy import granted  # noqa: PLC0415  not for every verb
    from appliance.policy.grant import UngrantableError  # noqa: PLC0415  as above

    with Errors():
        found = _record(appliance, record)
        known = appliance.ask_or_exit(PolicyWanted())
        try:
            return granted(found, known)
        except UngrantableError as error:
            fail(str(error), 1)


def _record(appliance: Appliance, record: str) -> Record:
    shown = appliance.audit().show(record, 0)
    if shown is None:
        _unknown(record)
    return shown.entry.record


def _unknown(record: str) -> NoReturn:
    fail(f"no record with the id {record!a} is in the log", 1)


def _over_rest(appliance: Appliance, record: str, what: str) -> dict[str, Any]:
    from appliance.cli.audit.log_over_rest import ID  # noqa: PLC0415  as below
    from appliance.cli.rest.session import ProblemError  # noqa: PLC0415  httpx is not imported for the socket

    if not ID.fullmatch(record):
        _unknown(record)
    with Errors():
        try:
            return appliance.rest.call("GET", f"/v1/audit/{record}/{what}")
        except ProblemError as problem:
            if problem.status == 404:
                _unknown(record)
            fail(problem.lines[0], 1)
