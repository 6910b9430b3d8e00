"""Define the feature guards."""

from typing import TYPE_CHECKING, Any

from appliance.cli.verb_table import Group, Verb
from appliance.features.feature import ConsolePart, Feature, FeaturePart, OperatorContext

if TYPE_CHECKING:
    from appliance.channel.admin import AdminRequest

_VERBS = "appliance.features.guards.verbs"


def _operations() -> "tuple[type[AdminRequest[Any]], ...]":
    from appliance.features.guards.guard_requests import REQUESTS  # noqa: PLC0415  few processes need it

    return REQUESTS


def _operate(context: OperatorContext) -> FeaturePart:
    from appliance.features.guards.driver_check import DriverChecks  # noqa: PLC0415  only control needs it
    from appliance.features.guards.guard_orders import GuardOrders  # noqa: PLC0415  only control needs it

    orders = GuardOrders(context.monitors, context.graph, context.connections, context.core.trail)
    checks = DriverChecks(context.monitors, context.core.trail, context.graph, context.processes)
    return FeaturePart(
        methods=(*orders.methods(), *checks.methods()),
        status_fields=lambda: {"guards": orders.state()},
        work={
            "the guards": orders.watch,
            "the place of guards": orders.placement.watch,
            "the check of a driver": checks.watch,
        },
    )


GUARDS = Feature(
    "guards",
    operations=_operations,
    operate=_operate,
    console=(
        ConsolePart("situation", "situation.js", "Stops", order=2),
        ConsolePart("robot", "panel.js", "Guards", order=2),
    ),
    verbs={
        "guard": Group(
            "Stop a robot that runs away: monitors from presets, without editing a file.",
            {
                "list": Verb(f"{_VERBS}:list_guards"),
                "suggest": Verb(f"{_VERBS}:suggest"),
                "new": Verb(f"{_VERBS}:new"),
                "set": Verb(f"{_VERBS}:set_values"),
                "enforce": Verb(f"{_VERBS}:enforce"),
                "upgrade": Verb(f"{_VERBS}:upgrade"),
                "remove": Verb(f"{_VERBS}:remove"),
                "check-driver": Verb("appliance.features.guards.driver_verb:check_driver"),
            },
            after="monitor",
        )
    },
)
