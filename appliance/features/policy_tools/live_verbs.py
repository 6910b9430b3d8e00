"""`rosrv policy show|reload|rollback|confirm|revisions`: the running appliance's policy."""

from typing import Annotated

import typer

from appliance.base.counted import counted
from appliance.channel.admin import (
    PolicyConfirm,
    PolicyReload,
    PolicyRevisions,
    PolicyRevisionWanted,
    PolicyRollback,
)
from appliance.channel.answers.policy_answers import Loaded
from appliance.cli.commit_confirm import ConfirmWithin, say_deadline, seconds_within, verbs_of
from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.output import loaded_by, say_json
from appliance.cli.standing import WITHIN, WhenStanding, Within, stand_or_exit
from rosmop.tool.terminal import printable, say


@speaks
def show(
    appliance: Appliance,
    revision: Annotated[
        int | None,
        typer.Argument(help="A kept revision (default: the one in force)"),
    ] = None,
) -> None:
    """Print the policy in force, or a revision; on standard error, print who loaded it, and when.

    Example: rosrv policy show > policy.ini
    """
    if revision is None:
        rows = appliance.ask_or_exit(PolicyRevisions()).revisions
        revision = next(row.revision for row in rows if row.in_force)
    body = appliance.ask_or_exit(PolicyRevisionWanted(revision))
    if appliance.as_json:
        say_json(body)
    else:
        for line in body.text.splitlines():
            say(line)
        how = loaded_by(body.who, body.loaded)
        note = f": {body.note}" if body.note else ""
        # A comment, because a terminal of a container mixes both outputs.
        typer.echo(printable(f"# revision {body.revision}, {how}{note}"), err=True)


@speaks
def reload(
    appliance: Appliance,
    confirm_within: ConfirmWithin = None,
    *,
    when_standing: WhenStanding = False,
    within: Within = WITHIN,
) -> None:
    """Reload the policy file: check it, run its tests, enforce it, and revoke rights that it no longer grants.

    An invalid file changes nothing. All errors are shown, with exit status 1. The text in force makes no revision.

    Example: rosrv policy reload --confirm-within 5m
    """
    order = PolicyReload(seconds_within(confirm_within, "policy"))
    if when_standing:
        stand_or_exit(appliance, within, "rosrv policy")
    say_loaded(appliance.answer_or_exit(order))


def say_loaded(body: Loaded) -> None:
    for warning in body.warnings:
        say(warning, "yellow")
    if body.revision == body.replaced:
        say(f"no change: revision {body.revision} stays in force")
    else:
        revoked = counted(body.revoked, "right")
        say(f"revision {body.revision} is in force (was {body.replaced}); {revoked} revoked")
    say_deadline(body.confirm_by, "policy")


revisions, rollback, confirm = verbs_of(
    "policy", listed=PolicyRevisions(), confirmation=PolicyConfirm(), back=PolicyRollback, say_done=say_loaded
)
