"""Build the part of control for the limits."""

from appliance.control.core import ControlPart, Core
from appliance.control.operators.request_method import RequestMethod
from appliance.features.limits.requests import LimitList, LimitsWanted


async def begin(core: Core) -> ControlPart:
    async def use(_request: LimitsWanted) -> LimitList:
        return LimitList(core.limits.uses())

    return ControlPart((RequestMethod(LimitsWanted, use, order=False),))
