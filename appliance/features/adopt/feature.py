"""Define the feature adopt."""

from typing import TYPE_CHECKING, Any

from appliance.cli.verb_table import Verb
from appliance.features.feature import Feature

if TYPE_CHECKING:
    from appliance.channel.admin import AdminRequest

_PLACE = "appliance.features.adopt."


def _operations() -> "tuple[type[AdminRequest[Any]], ...]":
    from appliance.features.adopt.adopt_requests import REQUESTS  # noqa: PLC0415  few processes need it

    return REQUESTS


ADOPT = Feature(
    "adopt",
    operations=_operations,
    verbs={
        "adopt": Verb(f"{_PLACE}adopt_verb:adopt", after="survey"),
        "release": Verb(f"{_PLACE}release_verb:release", after="adopt"),
    },
    machine=f"{_PLACE}machine_side:machine",
    state_files=("adopt.json",),
    inherit=f"{_PLACE}control_part:inherit",
)
