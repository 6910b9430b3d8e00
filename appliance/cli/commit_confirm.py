"""What `rosrv policy` and `rosrv monitor` say of revisions, and of changes that go back unless they are confirmed."""

import datetime
from collections.abc import Callable
from typing import Annotated, TypeVar

import typer

from appliance.channel.admin import AdminRequest
from appliance.channel.answers import monitor_answers, policy_answers
from appliance.cli.durations import span_given
from appliance.cli.output import say_json
from appliance.cli.target import Appliance, speaks
from rosmop.tool.terminal import say

_Listed = TypeVar("_Listed", policy_answers.PolicyRevisionList, monitor_answers.MonitorRevisionList)
_Confirmed = TypeVar("_Confirmed", policy_answers.PolicyConfirmed, monitor_answers.MonitorsConfirmed)
_Done = TypeVar("_Done")

ConfirmWithin = Annotated[
    str | None,
    typer.Option(
        help="Go back by itself after this time (30s, 5m, 1h) unless it is confirmed (the verb confirm)"
    ),
]


def seconds_within(text: str | None, noun: str) -> float | None:
    """What --confirm-within of a verb of `rosrv noun` says. Ends the program with 2 when it is no time."""
    return None if text is None else span_given("--confirm-within", text, "30s, 5m or 1h", f"rosrv {noun}")


def say_deadline(confirm_by: float | None, noun: str) -> None:
    """Until when `rosrv noun confirm` is awaited; nothing when it is not."""
    if confirm_by is not None:
        say(f"it goes back by itself at {_time(confirm_by)} unless you say: rosrv {noun} confirm", "yellow")


def verbs_of(
    noun: str,
    *,
    listed: AdminRequest[_Listed],
    confirmation: AdminRequest[_Confirmed],
    back: Callable[[int | None], AdminRequest[_Done]],
    say_done: Callable[[_Done], None],
) -> tuple[Callable[..., None], Callable[..., None], Callable[..., None]]:
    """The verbs `revisions`, `rollback` and `confirm` of `rosrv noun`; what they do says the table of verbs.

    `listed`, `confirmation` and `back(revision)` are what each asks; `say_done` says what a rollback did.
    """

    def revisions(appliance: Appliance) -> None:
        for row in appliance.ask_or_exit(listed).revisions:
            _say_revision(row, as_json=appliance.as_json)

    def rollback(
        appliance: Appliance,
        revision: Annotated[
            int | None, typer.Argument(help="A kept revision; without it, the one before")
        ] = None,
    ) -> None:
        say_done(appliance.answer_or_exit(back(revision)))

    def confirm(appliance: Appliance) -> None:
        body = appliance.ask_or_exit(confirmation)
        if appliance.as_json:
            say_json(body)
        else:
            kept = f"revision {body.revision} stays in force"
            say(kept if body.confirmed else f"nothing waits to be confirmed: {kept}")
        raise typer.Exit(0 if body.confirmed else 1)

    for verb, example in ((revisions, "revisions"), (rollback, "rollback 7"), (confirm, "confirm")):
        verb.__doc__ = f"Example: rosrv {noun} {example}"
    return speaks(revisions), speaks(rollback), speaks(confirm)


def _say_revision(
    row: policy_answers.PolicyRevision | monitor_answers.MonitorRevision, *, as_json: bool
) -> None:
    if as_json:
        say_json(row)
        return
    files = row.file if isinstance(row, policy_answers.PolicyRevision) else " ".join(row.names)
    mark = "in force" if row.in_force else ""
    say(f"{row.revision:>5}  {_time(row.loaded)}  {row.who}: {row.note}  {files}  {mark}".rstrip())


def _time(seconds: float) -> str:
    return datetime.datetime.fromtimestamp(seconds, datetime.UTC).isoformat(timespec="seconds")
