"""Define the feature topics."""

from typing import TYPE_CHECKING, Any

from appliance.cli.verb_table import Group, Verb
from appliance.features.feature import Feature

if TYPE_CHECKING:
    from appliance.channel.admin import AdminRequest

_PLACE = "appliance.features.topics."


def _operations() -> "tuple[type[AdminRequest[Any]], ...]":
    from appliance.features.topics.look_request import REQUESTS  # noqa: PLC0415  few processes need it

    return REQUESTS


TOPICS = Feature(
    "topics",
    operations=_operations,
    inherit=f"{_PLACE}topic_looks:inherit",
    verbs={
        "topic": Group(
            "Show topics of the running robot.",
            {
                "list": Verb(f"{_PLACE}graph_verbs:list_topics"),
                "echo": Verb(f"{_PLACE}topic_verbs:echo"),
                "info": Verb(f"{_PLACE}topic_verbs:info"),
                "publishers": Verb(f"{_PLACE}topic_verbs:publishers"),
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
