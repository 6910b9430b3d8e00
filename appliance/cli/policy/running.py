"""`rosrv policy reload|rollback|confirm|revisions`: the policy in force of the running appliance."""

import datetime
from typing import Annotated

import typer

from appliance.channel.admin import PolicyConfirm, PolicyReload, PolicyRevisions, PolicyRollback
from appliance.channel.answers.policy import Loaded
from appliance.cli.output import Json, counted, say, say_json
from appliance.cli.running import Appliance, speaks
from appliance.cli.spans import span_given


@speaks
def reload(
    appliance: Appliance,
    confirm_within: Annotated[
        str | None,
        typer.Option(
            help="Go back by itself after this time (30s, 5m, 1h) unless `rosrv policy confirm` comes"
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Read the policy file again: check, test, swap at once, and take back what it no longer allows.

    A bad file changes nothing; every error is shown and the exit status is 1.

    Example: rosrv policy reload --confirm-within 5m
    """
    seconds = (
        span_given("--confirm-within", confirm_within, "30s, 5m or 1h", "rosrv policy")
        if confirm_within is not None
        else None
    )
    _say_loaded(appliance.answer_or_exit(PolicyReload(seconds), as_json=as_json))


@speaks
def rollback(
    appliance: Appliance,
    revision: Annotated[
        int | None, typer.Argument(help="A kept revision; without it, the one before")
    ] = None,
    as_json: Json = False,
) -> None:
    """Bring a kept revision into force again.

    Example: rosrv policy rollback 7
    """
    _say_loaded(appliance.answer_or_exit(PolicyRollback(revision), as_json=as_json))


@speaks
def confirm(appliance: Appliance, as_json: Json = False) -> None:
    """Keep a policy that was loaded with --confirm-within; exit status 1 when there is nothing to confirm.

    Example: rosrv policy confirm
    """
    body = appliance.ask_or_exit(PolicyConfirm(), as_json=as_json)
    if as_json:
        say_json(body)
    else:
        kept = f"revision {body.revision} stays in force"
        say(kept if body.confirmed else f"nothing waits to be confirmed: {kept}")
    raise typer.Exit(0 if body.confirmed else 1)


@speaks
def revisions(appliance: Appliance, as_json: Json = False) -> None:
    """List the kept revisions, the newest first.

    Example: rosrv policy revisions
    """
    for row in appliance.ask_or_exit(PolicyRevisions(), as_json=as_json).revisions:
        if as_json:
            say_json(row)
            continue
        loaded = datetime.datetime.fromtimestamp(row.loaded, datetime.UTC).isoformat(timespec="seconds")
        mark = "in force" if row.in_force else ""
        say(f"{row.revision:>5}  {loaded}  {row.who}: {row.note}  {row.file}  {mark}".rstrip())


def _say_loaded(body: Loaded) -> None:
    for warning in body.warnings:
        say(warning, "yellow")
    say(
        f"revision {body.revision} is in force (was {body.replaced}); {counted(body.revoked, 'right')} revoked"
    )
    if body.confirm_by is not None:
        until = datetime.datetime.fromtimestamp(body.confirm_by, datetime.UTC).isoformat(timespec="seconds")
        say(f"it goes back by itself at {until} unless you say: rosrv policy confirm", "yellow")
