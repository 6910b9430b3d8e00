"""The request of `rosrv limits`, and its answer."""

from typing import Annotated

import msgspec

from appliance.channel.admin import AdminRequest
from appliance.channel.answers.field_docs import doc
from appliance.channel.answers.limit_answers import LimitUse
from appliance.channel.rest_operation import rest


class LimitList(msgspec.Struct, frozen=True):
    """The finite resources that hosts can exhaust, with their present use."""

    limits: Annotated[list[LimitUse], doc("one row for each resource")]


@rest("viewer", "GET", "/v1/limits", name="limits", tag="status")
class LimitsWanted(AdminRequest[LimitList], frozen=True, tag="limits"):
    """The finite resources that hosts can exhaust: used, allowed, and the host that uses most of each."""


REQUESTS = (LimitsWanted,)
