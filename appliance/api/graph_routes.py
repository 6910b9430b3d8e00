"""`/v1/graph`: who talks to whom, through the appliance or past it, and how much; `/v1/messages`: what is said."""

from typing import Annotated

from fastapi import Query

from appliance.api.route_roles import Operator, add_look, ask
from appliance.api.routing import Responses, Routes
from appliance.api.services import Services
from appliance.channel.admin import GraphWanted, TopicLook
from appliance.channel.answers.graph_answers import TopicMessages

_UNKNOWN: Responses = {404: {"description": "No node publishes or subscribes to it."}}


def routes(services: Services) -> Routes:
    """The route."""
    router = Routes(prefix="/v1", tags=["graph"])

    add_look(router, services.control, GraphWanted)

    @router.get("/messages", operation_id="topic_messages", responses=_UNKNOWN)
    async def messages(
        bearer: Operator,
        topic: Annotated[str, Query(max_length=500, description="its name", examples=["/scan"])],
        messages: Annotated[int, Query(ge=1, le=20, description="how many at most")] = 1,
        seconds: Annotated[float, Query(gt=0, le=10, description="how long they are waited for")] = 2.0,
        latched: Annotated[
            bool, Query(description="a latched message first; false for whoever looks on and has it")
        ] = True,
    ) -> TopicMessages:
        """The next messages of a topic as subscribers get them, read as fields. It is recorded who looked."""
        return await ask(services.control, TopicLook(topic, messages, seconds, latched=latched), bearer)

    return router
