"""What `rosrv policy` and `rosrv monitor` say of revisions, and of changes that go back unless they are confirmed."""

import datetime
from collections.abc import Sequence
from typing import Annotated

import typer

from appliance.channel.answers import monitors, policy
from appliance.cli.output import say, say_json
from appliance.cli.spans import span_given

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


def say_confirmed(body: policy.PolicyConfirmed | monitors.MonitorsConfirmed, *, as_json: bool) -> None:
    """Whether there was something to confirm. Ends the program: with 1 when there was not."""
    if as_json:
        say_json(body)
    else:
        kept = f"revision {body.revision} stays in force"
        say(kept if body.confirmed else f"nothing waits to be confirmed: {kept}")
    raise typer.Exit(0 if body.confirmed else 1)


def say_revisions(
    rows: Sequence[policy.PolicyRevision] | Sequence[monitors.MonitorRevision], *, as_json: bool
) -> None:
    """The kept revisions, a line each."""
    for row in rows:
        if as_json:
            say_json(row)
            continue
        files = row.file if isinstance(row, policy.PolicyRevision) else " ".join(row.names)
        mark = "in force" if row.in_force else ""
        say(f"{row.revision:>5}  {_time(row.loaded)}  {row.who}: {row.note}  {files}  {mark}".rstrip())


def _time(seconds: float) -> str:
    return datetime.datetime.fromtimestamp(seconds, datetime.UTC).isoformat(timespec="seconds")
