"""`rosrv policy reload|rollback|confirm|revisions`: the policy in force of the running appliance."""

from appliance.channel.admin import PolicyConfirm, PolicyReload, PolicyRevisions, PolicyRollback
from appliance.channel.answers.policy_answers import Loaded
from appliance.cli.commit_confirm import ConfirmWithin, say_deadline, seconds_within, verbs_of
from appliance.cli.target import Appliance, speaks
from rosmop.tool.terminal import counted, say


@speaks
def reload(appliance: Appliance, confirm_within: ConfirmWithin = None) -> None:
    """Read the policy file again: check, test, swap at once, and take back what it no longer allows.

    A bad file changes nothing; every error is shown and the exit status is 1.

    Example: rosrv policy reload --confirm-within 5m
    """
    order = PolicyReload(seconds_within(confirm_within, "policy"))
    say_loaded(appliance.answer_or_exit(order))


def say_loaded(body: Loaded) -> None:
    """What a change of the policy did."""
    for warning in body.warnings:
        say(warning, "yellow")
    say(
        f"revision {body.revision} is in force (was {body.replaced}); {counted(body.revoked, 'right')} revoked"
    )
    say_deadline(body.confirm_by, "policy")


revisions, rollback, confirm = verbs_of(
    "policy", listed=PolicyRevisions(), confirmation=PolicyConfirm(), back=PolicyRollback, say_done=say_loaded
)
