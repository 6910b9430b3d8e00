"""Define the tool logbook: `rosrv report interventions` and `rosrv who-drove`."""

from appliance.cli.verb_table import Group, Verb
from appliance.features.feature import Tool

_PLACE = "appliance.features.logbook."

FEATURE = Tool(
    verbs={
        "report": Group(
            "Print the robot's logbook: interventions in its safety settings.",
            {"interventions": Verb(f"{_PLACE}report_verb:report_interventions")},
            after="audit",
        ),
        "who-drove": Verb(f"{_PLACE}who_drove_verb:who_drove", after="report"),
    },
)
