"""Define the feature approvals."""

from appliance.cli.verb_table import Group, Verb
from appliance.features.approvals.quotas import ROWS
from appliance.features.approvals.settings import ApprovalHook
from appliance.features.feature import ConsolePart, Feature
from appliance.supervisor.role import RemoteReceiver, sender

_PLACE = "appliance.features.approvals."
HOOK = "hook"


def _receiver(hook: ApprovalHook) -> RemoteReceiver | None:
    return None if hook.url is None else RemoteReceiver("web hook of approvals", "https", *hook.destination)


FEATURE = Feature(
    settings=ApprovalHook,
    roles=(
        sender(
            HOOK, "rosrv-hook", "hook", f"{_PLACE}hook_process:main", section=ApprovalHook, receiver=_receiver,
            ended_early=700,
        ),
    ),
    console=(
        ConsolePart("banner", "bar.js", "WaitingCalls"),
        ConsolePart("situation", "situation.js", "Waits", order=3),
        ConsolePart("robot", "panel.js", "Approvals", order=3),
    ),
    verbs={
        "approve": Verb(f"{_PLACE}verbs:approve", after="drive"),
        "approval": Group(
            "Refuse a call that waits for an approval, or end an approval.",
            {"refuse": Verb(f"{_PLACE}verbs:refuse")},
            after="approve",
        ),
    },
    quotas=ROWS,
)  # fmt: skip
