"""The feature standby: two appliances, of which one stands by to take over (docs/standby.md)."""

from appliance.cli.verb_table import Group, Verb
from appliance.features.feature import Feature

_PLACE = "appliance.features.standby."

STANDBY = Feature(
    "standby",
    may_start=f"{_PLACE}start_gate:StandbyGate",
    inherit=f"{_PLACE}service_begin:inherit",
    verbs={
        "standby": Group(
            "Run two appliances, of which one stands by to take over.",
            {
                "join": Verb(f"{_PLACE}membership_verbs:join"),
                "leave": Verb(f"{_PLACE}membership_verbs:leave"),
                "repair": Verb(f"{_PLACE}membership_verbs:repair"),
                "status": Verb(f"{_PLACE}live_verbs:status"),
                "promote": Verb(f"{_PLACE}live_verbs:promote"),
            },
            after="host",
        ),
    },
)
