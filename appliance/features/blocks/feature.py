"""Define the feature blocks. The policy of the core denies the requests of blocked hosts."""

from appliance.cli.verb_table import Group, Verb
from appliance.features.feature import Feature

_PLACE = "appliance.features.blocks."


FEATURE = Feature(
    verbs={
        "host": Group(
            "Block hosts; enrol, list and revoke hosts that connect through IPsec tunnels.",
            {
                "block": Verb(f"{_PLACE}verbs:block"),
                "blocks": Verb(f"{_PLACE}verbs:list_blocks"),
                "unblock": Verb(f"{_PLACE}verbs:unblock"),
            },
            after="config",
        )
    },
)
