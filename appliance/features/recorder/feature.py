"""Define the feature recorder."""

from appliance.cli.verb_table import Group, Verb
from appliance.features.feature import ConsolePart, Feature
from appliance.features.recorder.quotas import ROWS
from appliance.features.recorder.settings import RecorderRules
from appliance.supervisor.role import Role
from appliance.supervisor.sandbox.sandbox_plan import SandboxPlan

ROLE = "recorder"
_VERBS = "appliance.features.recorder.verbs"


FEATURE = Feature(
    settings=RecorderRules,
    roles=(
        Role(
            ROLE, "rosrv-recorder", "recordings", "appliance.features.recorder.process:main",
            path=lambda facts: facts.config, links=("control",), ended_early=500, after="control", dispensable=True,
            group="rosrv-api", readable_by="rosrv-api", network=False,
            sandbox=lambda facts: SandboxPlan(allowlist=True, reads=(str(facts.part("control")),)),
            configured=lambda sections: sections.of(RecorderRules).enabled,
            memory="appliance.features.recorder.rings:memory_of",
        ),
    ),
    quotas=ROWS,
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
