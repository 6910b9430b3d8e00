"""Build the part of control for evidence."""

from appliance.control.core import ControlPart, Core
from appliance.control.operators.request_method import RequestMethod
from appliance.features.evidence.orders import EvidenceOrders
from appliance.features.evidence.requests import EvidenceExported, LogSealed


async def begin(core: Core) -> ControlPart:
    orders = EvidenceOrders(core.trail.audit, core.trail, core.settings.name)
    return ControlPart(
        (
            RequestMethod(LogSealed, orders.seal),
            RequestMethod(EvidenceExported, orders.exported, who=True),
        )
    )
