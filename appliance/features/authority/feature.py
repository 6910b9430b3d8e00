"""Define the feature authority."""

from appliance.cli.verb_table import Group, Verb
from appliance.features.authority.settings import AuthoritySettings
from appliance.features.feature import ConsolePart, Feature

_PLACE = "appliance.features.authority."


FEATURE = Feature(
    settings=AuthoritySettings,
    console=(
        ConsolePart("situation", "situation.js", "Drives", order=1),
        ConsolePart("robot", "panel.js", "Drive", order=1),
    ),
    verbs={
        "drive": Group(
            "Assign the command groups in [Authority] of the policy. At most one host drives a group.",
            {
                "status": Verb(f"{_PLACE}verbs:status"),
                "assign": Verb(f"{_PLACE}verbs:assign"),
                "free": Verb(f"{_PLACE}verbs:free"),
                "ask": Verb(f"{_PLACE}verbs:ask"),
            },
            after="guard",
        )
    },
)
