"""`rosrv monitor revisions|show|diff|rollback|confirm`: revisions of the specifications."""

import difflib
from collections.abc import Callable
from typing import Annotated

import typer

from appliance.channel.admin import (
    MonitorConfirm,
    MonitorRevisions,
    MonitorRevisionWanted,
    MonitorRollback,
    MonitorsWanted,
)
from appliance.channel.answers.monitor_answers import RevisionTexts
from appliance.cli.commit_confirm import verbs_of
from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.monitor_changes import say_replaced, write_switches
from appliance.cli.output import say_diff, say_json, usage_error
from rosmop.tool.terminal import say

_Revision = Annotated[int | None, typer.Argument(help="A kept revision (default: the one in force)")]


def _waiting(appliance: Appliance) -> Callable[[], None]:
    loaded = appliance.ask_or_exit(MonitorsWanted())
    names = [row.name for row in loaded.monitors if loaded.confirm_by or row.confirm_by]
    return lambda: write_switches(appliance, names)


revisions, rollback, confirm = verbs_of(
    "monitor",
    listed=MonitorRevisions(),
    confirmation=MonitorConfirm(),
    back=MonitorRollback,
    say_done=say_replaced,
    waiting=_waiting,
)


@speaks
def show(appliance: Appliance, revision: _Revision = None) -> None:
    """Show the specifications of a revision.

    Example: rosrv monitor show 7
    """
    body = _texts(appliance, revision)
    if appliance.as_json:
        say_json(body)
        return
    for name, text in _named(body).items():
        say(f"# {name}", "bold")
        for line in text.splitlines():
            say(line)


@speaks
def diff(
    appliance: Appliance,
    old: Annotated[int | None, typer.Argument(help="A kept revision (default: the one before NEW)")] = None,
    new: _Revision = None,
) -> None:
    """Compare two revisions of the specifications. Exit status: 0 no difference, 1 differences.

    Example: rosrv monitor diff 6 7
    """
    later = _texts(appliance, new)
    before = old if old is not None else later.revision - 1
    earlier = _named(_texts(appliance, before)) if before else {}
    texts = _named(later)
    lines = [
        line
        for name in sorted(earlier.keys() | texts.keys())
        for line in difflib.unified_diff(
            earlier.get(name, "").splitlines(), texts.get(name, "").splitlines(),
            f"revision {before}: {name}", f"revision {later.revision}: {name}", lineterm="",
        )
    ]  # fmt: skip
    if appliance.as_json:
        say_json({"old": before, "new": later.revision, "lines": lines})
        raise typer.Exit(1 if lines else 0)
    say_diff(lines)
    raise typer.Exit(1 if lines else 0)


def _texts(appliance: Appliance, revision: int | None) -> RevisionTexts:
    if revision is None:
        rows = appliance.ask_or_exit(MonitorRevisions()).revisions
        revision = next((row.revision for row in rows if row.in_force), None)
        if revision is None:
            raise usage_error("no specifications were ever loaded")
    return appliance.ask_or_exit(MonitorRevisionWanted(revision))


def _named(body: RevisionTexts) -> dict[str, str]:
    return body.files | {f"msg/{name}": text for name, text in body.definitions.items()}
