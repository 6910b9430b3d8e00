"""Define the feature alarms. The core finds the present alarms (`channel/alarms.py`)."""

from appliance.cli.verb_table import Group, Verb
from appliance.features.feature import Feature

_VERBS = "appliance.features.alarms.verbs"


FEATURE = Feature(
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
