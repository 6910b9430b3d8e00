"""Define the feature doors, which is off until a door is added."""

from typing import TYPE_CHECKING, Any

from appliance.cli.verb_table import Group, Verb
from appliance.features.doors.quotas import ROWS
from appliance.features.doors.settings import MOST_DOORS, Doors
from appliance.features.feature import ConsolePart, Feature, FeaturePart, OperatorContext
from appliance.supervisor.role import Role
from appliance.supervisor.sandbox.sandbox_plan import SandboxPlan

if TYPE_CHECKING:
    from appliance.channel.admin import AdminRequest

_VERBS = "appliance.features.doors.door_verbs"
_PART = "appliance.features.doors.control_part"


def _operations() -> "tuple[type[AdminRequest[Any]], ...]":
    from appliance.features.doors.door_requests import REQUESTS  # noqa: PLC0415  few processes need it

    return REQUESTS


def _operate(context: OperatorContext) -> FeaturePart:
    from appliance.features.doors.kept_doors import operate  # noqa: PLC0415  only control needs it

    return operate(context)


DOORS = Feature(
    "doors",
    settings=Doors,
    roles=(
        Role(
            "door", "rosrv-doors", "doors", "appliance.features.doors.process:main",
            indexed=True, most=MOST_DOORS, links=("control",), ended_early=700, nice=10, dispensable=True,
            on_demand=True, network=False,
            sandbox=lambda _facts: SandboxPlan(allowlist=True),
        ),
    ),
    operations=_operations,
    console=(
        ConsolePart("robot", "own.js", "OwnDoor", order=4),
        ConsolePart("robot", "panel.js", "Doors", order=4),
    ),
    verbs={
        "door": Group(
            "Let browsers, viewers and agents in, each with its own rights.",
            {
                "add": Verb(f"{_VERBS}:add"),
                "list": Verb(f"{_VERBS}:list_doors"),
                "ticket": Verb(f"{_VERBS}:ticket"),
                "remove": Verb(f"{_VERBS}:remove"),
            },
            after="fleet",
        )
    },
    operate=_operate,
    quotas=ROWS,
    keep=f"{_PART}:keep",
    inherit=f"{_PART}:inherit",
)  # fmt: skip
