"""The verbs for revisions and commit-confirm, for `rosrv policy` and `rosrv monitor`."""

from collections.abc import Callable
from typing import Annotated, TypeVar

import typer

from appliance.base.actors import actor
from appliance.base.option_group import GroupedVerb
from appliance.base.timestamps import local_text
from appliance.channel.admin import AdminRequest
from appliance.channel.answers import monitor_answers, policy_answers
from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.durations import bounded_span
from appliance.cli.output import say_json, say_row
from rosmop.tool.terminal import say

_Listed = TypeVar("_Listed", policy_answers.PolicyRevisionList, monitor_answers.MonitorRevisionList)
_Confirmed = TypeVar("_Confirmed", policy_answers.PolicyConfirmed, monitor_answers.MonitorsConfirmed)
_Done = TypeVar("_Done")

ConfirmWithin = Annotated[
    str | None,
    typer.Option(
        help="Commit-confirm: roll back after this time (such as 5m; at most 24h) unless you run `rosrv policy"
        " confirm`, or for monitors and guards `rosrv monitor confirm`"
    ),
]


def seconds_within(text: str | None, noun: str) -> float | None:
    return None if text is None else bounded_span("--confirm-within", text, "1s", "24h", f"rosrv {noun}")


def say_deadline(confirm_by: float | None, noun: str) -> None:
    if confirm_by is not None:
        say(f"rolls back at {_time(confirm_by)} unless you run: rosrv {noun} confirm", "yellow")


def verbs_of(
    noun: str,
    *,
    listed: AdminRequest[_Listed],
    confirmation: AdminRequest[_Confirmed],
    back: Callable[[int | None], AdminRequest[_Done]],
    say_done: Callable[[_Done], None],
    waiting: Callable[[Appliance], Callable[[], None]] = lambda _appliance: lambda: None,
) -> tuple[GroupedVerb, GroupedVerb, GroupedVerb]:
    """`waiting(appliance)` is called before a confirmation, and returns what follows it."""

    def revisions(appliance: Appliance) -> None:
        for row in appliance.ask_or_exit(listed).revisions:
            _say_revision(row, as_json=appliance.as_json)

    def rollback(
        appliance: Appliance,
        revision: Annotated[
            int | None, typer.Argument(help="A kept revision (default: the previous one)")
        ] = None,
    ) -> None:
        say_done(appliance.answer_or_exit(back(revision)))

    def confirm(appliance: Appliance) -> None:
        follow = waiting(appliance)
        body = appliance.ask_or_exit(confirmation)
        if appliance.as_json:
            say_json(body)
        else:
            kept = f"revision {body.revision} stays in force"
            say(kept if body.confirmed else f"nothing to confirm: {kept}")
        if body.confirmed:
            follow()
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
    say_row(
        [
            f"{row.revision:>5}",
            _time(row.loaded),
            f"{actor(row.who)}: {row.note}",
            *filter(None, (files, mark)),
        ]
    )


def _time(seconds: float) -> str:
    return local_text(int(seconds) * 1_000_000_000, digits=0).replace("T", " ")
