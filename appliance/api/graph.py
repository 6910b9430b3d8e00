"""`/v1/graph`: who talks to whom, through the appliance or past it, and how much."""

from typing import Literal

from fastapi import APIRouter
from pydantic import BaseModel, ConfigDict, Field

from appliance.api.roles import Viewer, ask
from appliance.api.services import Services
from appliance.channel.admin import GraphWanted


class _Model(BaseModel):
    # What control says more than is named here is passed on: a part of the appliance adds its own.
    model_config = ConfigDict(extra="allow", serialize_by_alias=True, validate_by_name=True)


class Node(_Model):
    """A node; `lost`: it does not answer, its registrations are kept back until it returns."""

    name: str
    host: str
    state: Literal["live", "lost"]
    publishes: list[str]
    subscribes: list[str]
    offers: list[str]


class Flow(_Model):
    """What went through since RVMaster started, and what goes through now (a second's average)."""

    messages: int
    bytes: int
    dropped: int = Field(description="messages that slow subscribers did not get")
    messages_per_second: float
    bytes_per_second: float
    delay_seconds: float = Field(
        description="that the relay added to a message of the last second, on average; of services 0"
    )


class Publisher(Flow):
    """A publisher of a topic, with what came from it."""

    node: str


class Connection(_Model):
    """A subscriber or client that is connected through the appliance to a node."""

    from_: str = Field(alias="from")
    to: str
    host: str


class Topic(_Model):
    """A topic; `mediated`: its messages go through the appliance."""

    name: str
    type: str
    mediated: bool
    publishers: list[Publisher]
    subscribers: list[str]
    connections: list[Connection]


class Service(Flow):
    """A service and the node that offers it."""

    name: str
    node: str
    mediated: bool
    connections: list[Connection]


class Graph(_Model):
    """The graph at one moment, without the appliance's own nodes."""

    nodes: list[Node]
    topics: list[Topic]
    services: list[Service]


def routes(services: Services) -> APIRouter:
    """The route."""
    router = APIRouter(prefix="/v1", tags=["graph"])

    @router.get("/graph", operation_id="graph")
    async def graph(bearer: Viewer) -> Graph:
        """Nodes, topics and services, who is mediated, and rates."""
        return Graph.model_validate(await ask(services.control, GraphWanted(), bearer))

    return router
