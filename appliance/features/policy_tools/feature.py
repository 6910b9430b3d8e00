"""Define the tool policy tools: `rosrv policy`, and the explanation of records."""

from appliance.cli.verb_table import CONFIRM, FIRST, Group, Verb
from appliance.features.feature import Tool

_PLACE = "appliance.features.policy_tools."

FEATURE = Tool(
    verbs={
        "host": Group("", {"show": Verb(f"{_PLACE}policy_verbs:show_host", after=FIRST)}, after="config"),
        "audit": Group("", {"why": Verb(f"{_PLACE}grant_verb:why", after=FIRST)}),
        "policy": Group(
            "Check, explain, test, compare, learn and change access policies.",
            {
                "learn": Verb(f"{_PLACE}learn_verb:learn_policy"),
                "show": Verb(f"{_PLACE}live_verbs:show"),
                "reload": Verb(f"{_PLACE}live_verbs:reload"),
                "rollback": Verb(
                    f"{_PLACE}live_verbs:rollback", "Return to an earlier revision of the policy."
                ),
                "confirm": Verb(f"{_PLACE}live_verbs:confirm", CONFIRM),
                "revisions": Verb(
                    f"{_PLACE}live_verbs:revisions", "List the kept revisions of the policy, newest first."
                ),
                "grant": Verb(f"{_PLACE}grant_verb:grant"),
                "check": Verb(f"{_PLACE}policy_verbs:check"),
                "explain": Verb(f"{_PLACE}policy_verbs:explain_request"),
                "who-may": Verb(f"{_PLACE}who_may_verb:list_who_may"),
                "test": Verb(f"{_PLACE}policy_verbs:test"),
                "enforce": Verb(f"{_PLACE}enforce_verb:enforce"),
                "unused": Verb(f"{_PLACE}unused_verb:list_unused"),
                "diff": Verb(f"{_PLACE}diff_verb:compare"),
            },
            after="audit",
        ),
    },
)
