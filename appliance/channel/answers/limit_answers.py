"""The use of a finite resource."""

from typing import Annotated

import msgspec

from appliance.channel.answers.field_docs import doc


class LimitUse(msgspec.Struct, frozen=True):
    """A finite resource: how much all hosts together use, and who uses most of a quota."""

    resource: Annotated[str, doc("the resource with its unit")]
    used: Annotated[int, doc("by all hosts together")]
    allowed: Annotated[int | None, doc("for all hosts together, or null if only each host has a limit")]
    setting: Annotated[str, doc("the setting that changes the limit, or empty if there is none")]
    host: Annotated[
        str,
        doc(
            "the host, or the hosts with one limit together, that are nearest to it; empty without such limits"
        ),
    ] = ""
    host_used: Annotated[int, doc("by them")] = 0
    host_allowed: Annotated[int, doc("their limit")] = 0
