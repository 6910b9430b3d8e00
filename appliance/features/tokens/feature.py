"""Define the tool tokens."""

from appliance.cli.verb_table import Group, Verb
from appliance.features.feature import Tool

_VERBS = "appliance.features.tokens.verbs"

FEATURE = Tool(
    verbs={
        "token": Group(
            "Create, rotate, list and revoke access tokens for REST.",
            {
                "add": Verb(f"{_VERBS}:add"),
                "rotate": Verb(f"{_VERBS}:rotate"),
                "list": Verb(f"{_VERBS}:list_tokens"),
                "revoke": Verb(f"{_VERBS}:revoke"),
            },
            after="purge",
        )
    },
)
