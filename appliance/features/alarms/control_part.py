"""Build the part of control for alarms."""

from appliance.control.core import ControlPart, Core
from appliance.control.operators.request_method import RequestMethod
from appliance.features.alarms.orders import AlarmOrders
from appliance.features.alarms.requests import AlarmAcknowledge, AlarmSilence, AlarmsWanted


async def begin(core: Core) -> ControlPart:
    orders = AlarmOrders(core.alarms, core.trail)
    return ControlPart(
        (
            RequestMethod(AlarmsWanted, orders.listed, order=False),
            RequestMethod(AlarmAcknowledge, orders.acknowledge, who=True),
            RequestMethod(AlarmSilence, orders.silence, who=True),
        )
    )
