"""Define the feature recorder."""

from typing import TYPE_CHECKING, Any

from appliance.cli.verb_table import Group, Verb
from appliance.configuration.sections import Sections
from appliance.features.feature import ConsolePart, Feature, FeatureContext, FeaturePart
from appliance.features.recorder.quotas import ROWS
from appliance.features.recorder.settings import RecorderRules
from appliance.supervisor.role import Role, SharedMemory
from appliance.supervisor.sandbox.sandbox_plan import SandboxPlan

if TYPE_CHECKING:
    from appliance.channel.admin import AdminRequest

ROLE = "recorder"
_VERBS = "appliance.features.recorder.record_verbs"


def _memory(sections: Sections, relays: int) -> SharedMemory | None:
    from appliance.features.recorder.rings import RecorderRings  # noqa: PLC0415  only the supervisor needs it

    rules = sections.of(RecorderRules)
    return RecorderRings(rules, relays) if rules.enabled else None


def _operations() -> "tuple[type[AdminRequest[Any]], ...]":
    from appliance.features.recorder.recording_requests import REQUESTS  # noqa: PLC0415  few processes need it

    return REQUESTS


def _make(core: FeatureContext) -> FeaturePart:
    from appliance.features.recorder.control_part import make  # noqa: PLC0415  only control needs it

    return make(core)


RECORDER = Feature(
    "recorder",
    settings=RecorderRules,
    roles=(
        Role(
            ROLE, "rosrv-recorder", "recordings", "appliance.features.recorder.process:main",
            path=lambda facts: facts.config, links=("control",), ended_early=500, after="control", dispensable=True,
            group="rosrv-api", readable_by="rosrv-api", network=False,
            sandbox=lambda facts: SandboxPlan(allowlist=True, reads=(str(facts.part("control")),)),
            configured=lambda sections: sections.of(RecorderRules).enabled,
        ),
    ),
    operations=_operations,
    routes="appliance.features.recorder.recording_routes:routes",
    memory=_memory,
    quotas=ROWS,
    recorded="appliance.features.recorder.recorder_input:recorded_messages",
    make=_make,
    console=(
        ConsolePart("view", "view.js", "Recordings", "Recordings"),
        ConsolePart("record", "taking.js", "OnTimeline"),
    ),
    verbs={
        "record": Group(
            "Use the flight recorder: messages before and after an event.",
            {
                "now": Verb(f"{_VERBS}:now"),
                "list": Verb(f"{_VERBS}:list_recordings"),
                "show": Verb(f"{_VERBS}:show"),
                "timeline": Verb(f"{_VERBS}:show_timeline"),
                "messages": Verb(f"{_VERBS}:messages"),
                "fetch": Verb(f"{_VERBS}:fetch"),
                "remove": Verb(f"{_VERBS}:remove"),
            },
            after="node",
        ),
    },
)  # fmt: skip
