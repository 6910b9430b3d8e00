"""`rosrv policy reload|rollback|confirm|revisions`: the policy in force of the running appliance."""

from typing import Annotated

import typer

from appliance.channel.admin import PolicyConfirm, PolicyReload, PolicyRevisions, PolicyRollback
from appliance.channel.answers.policy import Loaded
from appliance.cli.output import Json, counted, say
from appliance.cli.running import Appliance, speaks
from appliance.cli.trials import ConfirmWithin, say_confirmed, say_deadline, say_revisions, seconds_within


@speaks
def reload(
    appliance: Appliance,
    confirm_within: ConfirmWithin = None,
    as_json: Json = False,
) -> None:
    """Read the policy file again: check, test, swap at once, and take back what it no longer allows.

    A bad file changes nothing; every error is shown and the exit status is 1.

    Example: rosrv policy reload --confirm-within 5m
    """
    order = PolicyReload(seconds_within(confirm_within, "policy"))
    say_loaded(appliance.answer_or_exit(order, as_json=as_json))


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
    say_loaded(appliance.answer_or_exit(PolicyRollback(revision), as_json=as_json))


@speaks
def confirm(appliance: Appliance, as_json: Json = False) -> None:
    """Keep a policy that was loaded with --confirm-within; exit status 1 when there is nothing to confirm.

    Example: rosrv policy confirm
    """
    say_confirmed(appliance.ask_or_exit(PolicyConfirm(), as_json=as_json), as_json=as_json)


@speaks
def revisions(appliance: Appliance, as_json: Json = False) -> None:
    """List the kept revisions, the newest first.

    Example: rosrv policy revisions
    """
    body = appliance.ask_or_exit(PolicyRevisions(), as_json=as_json)
    say_revisions(body.revisions, as_json=as_json)


def say_loaded(body: Loaded) -> None:
    """What a change of the policy did."""
    for warning in body.warnings:
        say(warning, "yellow")
    say(
        f"revision {body.revision} is in force (was {body.replaced}); {counted(body.revoked, 'right')} revoked"
    )
    say_deadline(body.confirm_by, "policy")
