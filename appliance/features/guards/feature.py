"""The feature guards: `rosrv guard` makes specifications from presets, and changes them."""

from appliance.cli.verb_table import Group, Verb
from appliance.features.feature import Feature

_VERBS = "appliance.features.guards.verbs"

GUARDS = Feature(
    "guards",
    verbs={
        "guard": Group(
            "Stop a robot that runs away: monitors from presets, without editing a file.",
            {
                "list": Verb(f"{_VERBS}:list_guards"),
                "suggest": Verb(f"{_VERBS}:suggest"),
                "new": Verb(f"{_VERBS}:new"),
                "set": Verb(f"{_VERBS}:set_values"),
                "enforce": Verb(f"{_VERBS}:enforce"),
                "remove": Verb(f"{_VERBS}:remove"),
            },
            after="monitor",
        )
    },
)
