"""Define the feature limits. Each part states the use of its own resources."""

from typing import TYPE_CHECKING, Any

from appliance.cli.verb_table import Verb
from appliance.features.feature import Feature

if TYPE_CHECKING:
    from appliance.channel.admin import AdminRequest

_PLACE = "appliance.features.limits."


def _operations() -> "tuple[type[AdminRequest[Any]], ...]":
    from appliance.features.limits.limit_requests import REQUESTS  # noqa: PLC0415  few processes need it

    return REQUESTS


LIMITS = Feature(
    "limits",
    operations=_operations,
    verbs={"limits": Verb(f"{_PLACE}limits_verb:limits", after="status")},
    inherit=f"{_PLACE}limit_use:inherit",
)
