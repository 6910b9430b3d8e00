"""`/v1/graph`: who talks to whom, through the appliance or past it, and how much."""

from appliance.api.roles import Viewer, ask
from appliance.api.routing import Routes
from appliance.api.services import Services
from appliance.channel.admin import GraphWanted
from appliance.channel.answers.graph import Graph


def routes(services: Services) -> Routes:
    """The route."""
    router = Routes(prefix="/v1", tags=["graph"])

    @router.get("/graph", operation_id="graph")
    async def graph(bearer: Viewer) -> Graph:
        """Nodes, topics and services, who is mediated, and rates."""
        return await ask(services.control, GraphWanted(), bearer)

    return router
