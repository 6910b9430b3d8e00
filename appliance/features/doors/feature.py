"""Define the feature doors, which is off until a door is added."""

from appliance.cli.verb_table import Group, Verb
from appliance.features.doors.quotas import ROWS
from appliance.features.doors.settings import MAX_DOORS, Doors
from appliance.features.feature import ConsolePart, Feature
from appliance.supervisor.role import Role
from appliance.supervisor.sandbox.sandbox_plan import SandboxPlan

_VERBS = "appliance.features.doors.verbs"
_PART = "appliance.features.doors.control_part"


FEATURE = Feature(
    settings=Doors,
    roles=(
        Role(
            "door", "rosrv-doors", "doors", "appliance.features.doors.process:main",
            indexed=True, most=MAX_DOORS, links=("control",), ended_early=700, nice=10, dispensable=True,
            on_demand=True, network=False,
            sandbox=lambda _facts: SandboxPlan(allowlist=True),
        ),
    ),
    console=(
        ConsolePart("robot", "own.js", "OwnDoor", order=4),
        ConsolePart("robot", "panel.js", "Doors", order=4),
        ConsolePart("search", "search.js", "doors", "Doors"),
    ),
    verbs={
        "door": Group(
            "Let browsers, Foxglove and agents in, each with its own rights.",
            {
                "add": Verb(f"{_VERBS}:add"),
                "list": Verb(f"{_VERBS}:list_doors"),
                "ticket": Verb(f"{_VERBS}:ticket"),
                "remove": Verb(f"{_VERBS}:remove"),
            },
            after="fleet",
        )
    },
    quotas=ROWS,
)  # fmt: skip
