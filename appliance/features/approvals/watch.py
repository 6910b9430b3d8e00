"""Show calls that wait for an operator as they come, until Ctrl-C: `rosrv approve --watch`."""

import sys
import threading
from collections.abc import Callable, Iterable, Iterator

import msgspec

from appliance.cli.audit.audit_errors import note
from appliance.cli.connection.admin_client import AccessDeniedError, NotRunningError
from appliance.cli.connection.target import Appliance
from appliance.cli.output import say_json
from appliance.features.approvals.requests import Approval, ApprovalsWanted
from rosmop.tool.terminal import printable, say

_EVERY_SECONDS = 0.5
_BELL = "\a"


def show_held_calls(appliance: Appliance, line: Callable[[Approval], tuple[str, str]]) -> None:
    """Print each change; `line` returns the text of an approval, and its style."""
    known: dict[int, Approval] = {}
    away, pause = False, threading.Event()
    try:
        while True:
            try:
                rows = appliance.body_or_exit(appliance.ask(ApprovalsWanted())).approvals
                away = False
            except AccessDeniedError:
                raise
            except NotRunningError as error:  # it may be restarting, which ends all approvals
                if not away:
                    note(f"{printable(str(error))}; trying again")
                rows, away = [], True
            for one in changes(known, rows):
                _say(appliance, one, line)
            known = {one.number: one for one in rows}
            sys.stdout.flush()
            pause.wait(_EVERY_SECONDS)
    except KeyboardInterrupt:
        return


def changes(known: dict[int, Approval], rows: Iterable[Approval]) -> Iterator[Approval]:
    """Return new and changed approvals, and those that ended, with no time left."""
    left = dict(known)
    for one in rows:
        before = left.pop(one.number, None)
        if before is None or (before.state, before.who) != (one.state, one.who):
            yield one
    yield from (msgspec.structs.replace(one, left_seconds=0.0) for one in left.values())


def _say(appliance: Appliance, one: Approval, line: Callable[[Approval], tuple[str, str]]) -> None:
    waits = one.state == "waits" and one.left_seconds > 0
    if appliance.as_json:
        say_json(msgspec.structs.asdict(one))
        return
    if not one.left_seconds:
        say(f"{one.number}: has ended")
        return
    if waits and sys.stdout.isatty():
        sys.stdout.write(_BELL)
    say(*line(one))
    if waits:
        say(f"    rosrv approve {one.number} --for 30s    rosrv approval refuse {one.number}")
