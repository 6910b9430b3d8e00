"""Define the feature approvals."""

from appliance.cli.verb_table import Group, Verb
from appliance.configuration.sections import Sections
from appliance.features.approvals.quotas import ROWS
from appliance.features.approvals.settings import ApprovalHook
from appliance.features.feature import ConsolePart, Feature
from appliance.supervisor.role import Facts, RemoteReceiver, Role
from appliance.supervisor.sandbox.folders import folders_of
from appliance.supervisor.sandbox.sandbox_plan import ROUTES, SandboxPlan

_PLACE = "appliance.features.approvals."
HOOK = "hook"


def _configured(sections: Sections) -> bool:
    return sections.of(ApprovalHook).url is not None


def _receiver(sections: Sections) -> RemoteReceiver | None:
    if not _configured(sections):
        return None
    return RemoteReceiver("web hook of approvals", "https", *sections.of(ApprovalHook).destination)


def _sandbox(facts: Facts) -> SandboxPlan:
    wanted = facts.sections.of(ApprovalHook)
    return SandboxPlan(
        allowlist=True,
        families=ROUTES,
        reads=folders_of(*wanted.files),
        connects=(wanted.destination[1],) if wanted.url is not None else None,
    )


FEATURE = Feature(
    settings=ApprovalHook,
    roles=(
        Role(
            HOOK, "rosrv-hook", "hook", f"{_PLACE}hook_process:main",
            path=lambda facts: facts.config, links=("control",), ended_early=700, nice=10, after="control",
            dispensable=True, inputs=lambda facts: facts.sections.of(ApprovalHook).files, sandbox=_sandbox,
            configured=_configured, receiver=_receiver,
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
