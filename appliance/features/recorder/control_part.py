"""Build the recorder's part of control: plan, orders, and the link to the process."""

from typing import Any

from appliance.audit.log.ids import IdSource
from appliance.control.operators.request_method import RequestMethod
from appliance.features.feature import FeatureContext, FeaturePart
from appliance.features.recorder import recording_requests
from appliance.features.recorder.recorder_link import RecorderLink
from appliance.features.recorder.recording_orders import RecordingOrders
from appliance.features.recorder.recording_plan import RecordingPlan
from appliance.features.recorder.settings import RecorderRules


def make(core: FeatureContext) -> FeaturePart:
    rules = core.sections.of(RecorderRules)
    plan = RecordingPlan(rules, core.charged_to, IdSource().next)
    orders = RecordingOrders(rules, core.trail, core.in_force, plan)
    return FeaturePart(
        links={"recorder": (orders.link, RecorderLink)},
        methods=request_methods(orders),
        limits=orders.limits,
        details=plan.detail,
        called={"record_now": orders.called},
        status_fields=lambda: {"recorder": orders.state()},
    )


def request_methods(orders: RecordingOrders) -> tuple[RequestMethod[Any], ...]:
    """Orders are accepted on a full disk, because the recorder checks its own disk space."""
    return (
        RequestMethod(recording_requests.RecordingsWanted, orders.recordings),
        RequestMethod(recording_requests.RecordingWanted, orders.recording),
        RequestMethod(recording_requests.RecordNow, orders.now, who=True, full_disk=True),
        RequestMethod(recording_requests.RecordingFetch, orders.fetch, who=True),
        RequestMethod(recording_requests.RecordingRead, orders.read, who=True),
        RequestMethod(recording_requests.RecordingOfMemory, orders.of_memory, who=True, full_disk=True),
        RequestMethod(recording_requests.RecordingRemove, orders.remove, who=True, full_disk=True),
    )
