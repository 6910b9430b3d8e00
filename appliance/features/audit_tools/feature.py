"""Define the tool audit tools."""

from appliance.cli.verb_table import Group, Verb
from appliance.features.feature import Tool

_PLACE = "appliance.features.audit_tools."
_VERBS = f"{_PLACE}audit_verbs"

FEATURE = Tool(
    verbs={
        "audit": Group(
            "Review the audit log and verify that it is complete.",
            {
                "search": Verb(f"{_VERBS}:search"),
                "summary": Verb(f"{_PLACE}summary_verb:summarise"),
                "tail": Verb(f"{_VERBS}:tail"),
                "show": Verb(f"{_VERBS}:show"),
                "verify": Verb(f"{_VERBS}:verify"),
                "acknowledge": Verb(f"{_PLACE}acknowledge_verb:acknowledge_log"),
                "checkpoints": Verb(f"{_VERBS}:checkpoints"),
                "export": Verb(f"{_VERBS}:export"),
            },
            after="status",
        )
    },
)
