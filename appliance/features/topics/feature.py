"""Define the feature topics."""

from appliance.cli.verb_table import Group, Verb
from appliance.features.feature import Feature

_PLACE = "appliance.features.topics."


FEATURE = Feature(
    verbs={
        "topic": Group(
            "Show topics of the running robot.",
            {
                "list": Verb(f"{_PLACE}graph_verbs:list_topics"),
                "echo": Verb(f"{_PLACE}verbs:echo"),
                "info": Verb(f"{_PLACE}verbs:info"),
                "publishers": Verb(f"{_PLACE}verbs:publishers"),
            },
            after="monitor",
        ),
        "node": Group(
            "Show nodes of the running robot.",
            {"list": Verb(f"{_PLACE}graph_verbs:list_nodes")},
            after="topic",
        ),
    },
)
