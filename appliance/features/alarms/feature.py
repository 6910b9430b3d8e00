"""Define the feature alarms. The core finds the present alarms (`channel/alarms.py`)."""

from typing import TYPE_CHECKING, Any

from appliance.cli.verb_table import Group, Verb
from appliance.features.feature import Feature, FeaturePart, OperatorContext

if TYPE_CHECKING:
    from appliance.channel.admin import AdminRequest

_VERBS = "appliance.features.alarms.alarm_verbs"


def _operations() -> "tuple[type[AdminRequest[Any]], ...]":
    from appliance.features.alarms.alarm_requests import REQUESTS  # noqa: PLC0415  few processes need it

    return REQUESTS


def _operate(context: OperatorContext) -> FeaturePart:
    from appliance.features.alarms.alarm_orders import operate  # noqa: PLC0415  only control needs it

    return operate(context)


ALARMS = Feature(
    "alarms",
    operations=_operations,
    operate=_operate,
    verbs={
        "alarm": Group(
            "List the present alarms, and record who takes care of them.",
            {
                "list": Verb(f"{_VERBS}:list_alarms"),
                "acknowledge": Verb(f"{_VERBS}:acknowledge"),
                "silence": Verb(f"{_VERBS}:silence"),
            },
            after="status",
        )
    },
)
