"""Define the feature blocks. The policy of the core denies the requests of blocked hosts."""

from typing import TYPE_CHECKING, Any

from appliance.cli.verb_table import Group, Verb
from appliance.features.feature import Feature

if TYPE_CHECKING:
    from appliance.channel.admin import AdminRequest

_PLACE = "appliance.features.blocks."


def _operations() -> "tuple[type[AdminRequest[Any]], ...]":
    from appliance.features.blocks.block_requests import REQUESTS  # noqa: PLC0415  few processes need it

    return REQUESTS


BLOCKS = Feature(
    "blocks",
    operations=_operations,
    verbs={
        "host": Group(
            "Block hosts; enrol, list and revoke hosts that connect through IPsec tunnels.",
            {
                "block": Verb(f"{_PLACE}block_verbs:block"),
                "blocks": Verb(f"{_PLACE}block_verbs:list_blocks"),
                "unblock": Verb(f"{_PLACE}block_verbs:unblock"),
            },
            after="config",
        )
    },
    inherit=f"{_PLACE}block_orders:inherit",
)
