"""Define the feature approvals."""

from typing import TYPE_CHECKING, Any

from appliance.cli.verb_table import Verb
from appliance.features.approvals.quotas import ROWS
from appliance.features.feature import ConsolePart, Feature

if TYPE_CHECKING:
    from appliance.channel.admin import AdminRequest

_PLACE = "appliance.features.approvals."


def _operations() -> "tuple[type[AdminRequest[Any]], ...]":
    from appliance.features.approvals.approval_requests import REQUESTS  # noqa: PLC0415  few processes need it

    return REQUESTS


APPROVALS = Feature(
    "approvals",
    operations=_operations,
    console=(
        ConsolePart("banner", "bar.js", "WaitingCalls"),
        ConsolePart("situation", "panel.js", "Waits", order=3),
        ConsolePart("robot", "panel.js", "Approvals", order=3),
    ),
    verbs={"approve": Verb(f"{_PLACE}approval_verbs:approve", after="drive")},
    quotas=ROWS,
    inherit=f"{_PLACE}control_part:inherit",
)
