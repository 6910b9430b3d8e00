"""Define the feature evidence."""

from appliance.cli.verb_table import Group, Verb
from appliance.features.feature import Feature

_VERBS = "appliance.features.evidence.verbs"


FEATURE = Feature(
    verbs={
        "evidence": Group(
            "Export and verify signed evidence of an incident.",
            {
                "export": Verb(f"{_VERBS}:export_evidence"),
                "verify": Verb(f"{_VERBS}:verify"),
                "verifier": Verb(f"{_VERBS}:verifier"),
            },
            after="audit",
        )
    },
)
