"""Build the recorder's part of control: plan, orders, and the link to the process."""

from appliance.audit.log.ids import IdSource
from appliance.control.core import ControlPart, Core
from appliance.control.operators.request_method import RequestMethod
from appliance.features.recorder import requests
from appliance.features.recorder.feature import ROLE
from appliance.features.recorder.orders import RecordingOrders
from appliance.features.recorder.recorder_link import RecorderLink
from appliance.features.recorder.recording_plan import RecordingPlan
from appliance.features.recorder.settings import RecorderRules


async def begin(core: Core) -> ControlPart:
    rules = core.settings.of(RecorderRules)
    plan = RecordingPlan(rules, core.policy.charged_to, IdSource().next)
    orders = RecordingOrders(
        rules,
        core.trail,
        lambda: (core.trail.revision, core.specifications.revision),
        plan,
        core.settings.publish_as,
    )
    core.links.attach(ROLE, orders.link, RecorderLink)
    core.limits.provide(orders.limits)
    core.trail.add_details(plan.detail)
    core.own_services.provide("record_now", orders.called)
    return ControlPart(request_methods(orders), status=lambda: {"recorder": orders.state()})


def request_methods(orders: RecordingOrders) -> tuple[RequestMethod[object], ...]:
    """Orders are accepted on a full disk, because the recorder checks its own disk space."""
    return (
        RequestMethod(requests.RecordingsWanted, orders.recordings),
        RequestMethod(requests.RecordingWanted, orders.recording),
        RequestMethod(requests.RecordNow, orders.now, who=True, full_disk=True),
        RequestMethod(requests.RecordingFetch, orders.fetch, who=True),
        RequestMethod(requests.RecordingRead, orders.read, who=True),
        RequestMethod(requests.RecordingOfMemory, orders.of_memory, who=True, full_disk=True),
        RequestMethod(requests.RecordingRemove, orders.remove, who=True, full_disk=True),
    )
