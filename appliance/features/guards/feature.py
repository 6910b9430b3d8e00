"""Define the feature guards."""

from appliance.cli.verb_table import Group, Verb
from appliance.features.feature import ConsolePart, Feature

_VERBS = "appliance.features.guards.verbs"


FEATURE = Feature(
    console=(
        ConsolePart("situation", "situation.js", "Stops", order=2),
        ConsolePart("robot", "panel.js", "Guards", order=2),
        ConsolePart("search", "search.js", "guards", "Guards"),
    ),
    verbs={
        "guard": Group(
            "Stop a robot that runs away: monitors from presets, without editing a file.",
            {
                "list": Verb(f"{_VERBS}:list_guards"),
                "show": Verb("appliance.features.guards.show_verb:show"),
                "suggest": Verb("appliance.features.guards.suggest_verb:suggest"),
                "new": Verb(f"{_VERBS}:new"),
                "set": Verb(f"{_VERBS}:set_values"),
                "enforce": Verb(f"{_VERBS}:enforce"),
                "upgrade": Verb(f"{_VERBS}:upgrade"),
                "remove": Verb(f"{_VERBS}:remove"),
                "test": Verb("appliance.features.guards.proof_verb:test"),
                "manual": Verb("appliance.features.guards.manual_verb:manual"),
                "check-driver": Verb("appliance.features.guards.driver_verb:check_driver"),
            },
            after="monitor",
        )
    },
)
