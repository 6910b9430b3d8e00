"""Define the feature authority."""

from typing import TYPE_CHECKING, Any

from appliance.cli.verb_table import Group, Verb
from appliance.features.authority.settings import AuthoritySettings
from appliance.features.feature import ConsolePart, Feature

if TYPE_CHECKING:
    from appliance.channel.admin import AdminRequest

_PLACE = "appliance.features.authority."


def _operations() -> "tuple[type[AdminRequest[Any]], ...]":
    from appliance.features.authority.drive_requests import REQUESTS  # noqa: PLC0415  few processes need it

    return REQUESTS


AUTHORITY = Feature(
    "authority",
    settings=AuthoritySettings,
    operations=_operations,
    console=(
        ConsolePart("situation", "panel.js", "Drives", order=1),
        ConsolePart("robot", "panel.js", "Drive", order=1),
    ),
    verbs={
        "drive": Group(
            "Say which host may drive: one at a time holds each group of [Authority].",
            {
                "status": Verb(f"{_PLACE}drive_verbs:status"),
                "take": Verb(f"{_PLACE}drive_verbs:take"),
                "give": Verb(f"{_PLACE}drive_verbs:give"),
                "ask": Verb(f"{_PLACE}drive_verbs:ask"),
            },
            after="guard",
        )
    },
    inherit=f"{_PLACE}control_part:inherit",
)
