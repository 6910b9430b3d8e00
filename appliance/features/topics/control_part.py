"""Build the part of control for topics."""

from appliance.control.core import ControlPart, Core
from appliance.control.operators.request_method import RequestMethod
from appliance.features.topics.requests import TopicLook
from appliance.features.topics.topic_looks import TopicLooks


async def begin(core: Core) -> ControlPart:
    looks = TopicLooks(core.graph, core.relay, core.trail)
    return ControlPart((RequestMethod(TopicLook, looks.messages, who=True, order=False),))
