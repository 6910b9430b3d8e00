"""Define the feature policy tools."""

from appliance.cli.verb_table import FIRST, Group, Verb
from appliance.features.feature import Feature

_PLACE = "appliance.features.policy_tools."

POLICY_TOOLS = Feature(
    "policy_tools",
    routes=f"{_PLACE}policy_tool_routes:routes",
    verbs={
        "audit": Group("", {"why": Verb(f"{_PLACE}grant_verb:why", after=FIRST)}),
        "policy": Group(
            "",
            {
                "learn": Verb(f"{_PLACE}learn_verb:learn_policy", after=FIRST),
                "grant": Verb(f"{_PLACE}grant_verb:grant"),
                "check": Verb(f"{_PLACE}policy_verbs:check"),
                "explain": Verb(f"{_PLACE}policy_verbs:explain_request"),
                "who-may": Verb(f"{_PLACE}who_may_verb:list_who_may"),
                "test": Verb(f"{_PLACE}policy_verbs:test"),
                "diff": Verb(f"{_PLACE}diff_verb:compare"),
            },
        ),
    },
)
