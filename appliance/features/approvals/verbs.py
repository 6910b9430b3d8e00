"""The commands `rosrv approve` and `rosrv approval refuse`."""

import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from typing import Annotated

import msgspec
import typer

from appliance.base.counted import counted
from appliance.cli.audit.audit_errors import note
from appliance.cli.connection.admin_client import AccessDeniedError, NotRunningError
from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.durations import bounded_span
from appliance.cli.output import say_json, say_row, usage_error
from appliance.features.approvals.requests import (
    WITHHELD,
    Approval,
    ApprovalsWanted,
    ApproveCall,
    RefuseCall,
)
from rosmop.tool.terminal import printable, say
from roswire.errors import DefinitionError
from roswire.message_view import read_bytes, read_fields, rest_of
from roswire.standard import standard_definitions

# Show calls that wait for an operator as they come, until Ctrl-C: `rosrv approve --watch`.

_EVERY_SECONDS = 0.5
_BELL = "\a"


def show_held_calls(appliance: Appliance, line: Callable[[Approval], tuple[str, str]]) -> None:
    """Print each change; `line` returns the text of an approval, and its style."""
    known: dict[int, Approval] = {}
    away, pause = False, threading.Event()
    try:
        while True:
            try:
                rows = appliance.body_now(appliance.ask(ApprovalsWanted())).approvals
                away = False
            except AccessDeniedError:
                raise
            except (
                NotRunningError
            ) as error:  # it may be restarting or the standby now, which ends all approvals
                if not away:
                    note(f"{printable(str(error))}; trying again")
                rows, away = [], True
            for change in changes(known, rows):
                _announce(appliance, change, line)
            known = {row.number: row for row in rows}
            sys.stdout.flush()
            pause.wait(_EVERY_SECONDS)
    except KeyboardInterrupt:
        return


def changes(known: dict[int, Approval], rows: Iterable[Approval]) -> Iterator[Approval]:
    """Return new and changed approvals, and those that ended, with no time left."""
    left = dict(known)
    for row in rows:
        before = left.pop(row.number, None)
        if before is None or (before.state, before.who) != (row.state, row.who):
            yield row
    yield from (msgspec.structs.replace(one, left_seconds=0.0) for one in left.values())


def _announce(appliance: Appliance, approval: Approval, line: Callable[[Approval], tuple[str, str]]) -> None:
    waits = approval.state == "waits" and approval.left_seconds > 0
    if appliance.as_json:
        say_json(msgspec.structs.asdict(approval))
        return
    if not approval.left_seconds:
        say(f"{approval.number}: has ended")
        return
    if waits and sys.stdout.isatty():
        sys.stdout.write(_BELL)
    say(*line(approval))
    if waits:
        say(f"    rosrv approve {approval.number} --for 30s    rosrv approval refuse {approval.number}")


@speaks
def approve(
    appliance: Appliance,
    number: Annotated[
        int | None, typer.Argument(metavar="NUMBER", help="The number in the denial", show_default=False)
    ] = None,
    *,
    last: Annotated[
        str | None,
        typer.Option("--for", help="Approve all calls of this name by this host for this time, 1s to 1h"),
    ] = None,
    watch: Annotated[
        bool, typer.Option("--watch", help="Show calls as they come, with a bell, until interrupted")
    ] = False,
) -> None:
    """Approve a call that the policy holds for an operator. Without a number, list all calls and approvals.

    Without --for, a call of a service is approved once, with the same arguments; publishing a topic or writing a
    parameter is approved for 60 s.

    Example: rosrv approve 48213 --for 30s
    """
    if watch:
        if number is not None or last is not None:
            raise usage_error("--watch takes no call: approve in another terminal", "rosrv approve")
        show_held_calls(appliance, lambda one: _line(appliance, one))
        return
    if number is None:
        if last is not None:
            raise usage_error("name the call: rosrv approve NUMBER", "rosrv approve")
        _list(appliance)
        return
    seconds = None if last is None else bounded_span("--for", last, "1s", "1h", "rosrv approve")
    _say(appliance, appliance.answer_or_exit(ApproveCall(number, seconds)))


@speaks
def refuse(
    appliance: Appliance,
    number: Annotated[int, typer.Argument(help="The number in the denial", show_default=False)],
) -> None:
    """Refuse a call that waits for an approval, or end an approval early.

    Example: rosrv approval refuse 48213
    """
    _say(appliance, appliance.answer_or_exit(RefuseCall(number)))


def _list(appliance: Appliance) -> None:
    rows = appliance.answer_or_exit(ApprovalsWanted()).approvals
    for row in rows:
        _say(appliance, row)
    if not rows and not appliance.as_json:
        say("no call waits for an approval")


def _say(appliance: Appliance, approval: Approval) -> None:
    if appliance.as_json:
        say_json(msgspec.structs.asdict(approval))
    else:
        line, style = _line(appliance, approval)
        say_row([line], style)


def _line(appliance: Appliance, one: Approval) -> tuple[str, str]:
    who = f" by {one.who}" if one.who else ""
    host = appliance.host_in_words(one.host)
    what = f"{one.number}: {host} {one.category} {one.resource}{_arguments(one)}"
    state = "approved" if one.state == "lease" else one.state
    return f"{what}: {state}{who}, {one.left_seconds:g} s left", "yellow" if one.state == "waits" else ""


def _arguments(approval: Approval) -> str:
    if not approval.sha256:
        return " with any arguments" if approval.category == "call" else ""
    if approval.sha256 == WITHHELD:
        return f" with {counted(approval.size, 'byte')} of arguments, which viewers do not see"
    data = bytes.fromhex(approval.arguments)
    fields, rest = _fields(approval.type, data)
    shown = f"{data!r} ({approval.type}, sha256 {approval.sha256[:12]})" if fields is None else str(fields)
    if rest:  # the service may read them, and the approval is for all bytes
        shown = f"{shown}, and {counted(len(rest), 'byte')} behind the last field: {read_bytes(rest)}"
    hidden = approval.size - len(data)
    return f" {shown}{f', and {hidden} more bytes, which are not shown' if hidden else ''}"


def _fields(service: str, data: bytes) -> tuple[dict[str, object] | None, bytes]:
    """Return the fields of a request, and the bytes behind the last one; None for a type that is not known."""
    try:
        definitions = standard_definitions()
        name = definitions.service(service).request.name
    except DefinitionError:
        return (None if data else {}), b""
    return read_fields(definitions, name, data), rest_of(definitions, name, data)
