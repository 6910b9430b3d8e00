"""Answer `/v1/history` (the last hour), `/v1/live` (the present state) and `/v1/whoami` (the token's holder).

A page that follows the state makes one request, so the audit log has one record of it.
"""

import asyncio
import json
from collections.abc import AsyncIterator
from typing import Annotated

import msgspec
from fastapi import Query, Request, Response
from sse_starlette import EventSourceResponse, ServerSentEvent

from appliance.api.front.access import Bearer
from appliance.api.front.control import ControlAwayError
from appliance.api.front.history import BUSY_SECONDS, LastSample, Sample
from appliance.api.front.moments import in_full
from appliance.api.front.problems import ProblemError
from appliance.api.front.route_roles import VIEWER, Viewer, ask, only_passive
from appliance.api.front.routing import Routes, file
from appliance.api.front.services import Services
from appliance.api.front.streams import StreamResponse, Streams, peer_of
from appliance.base import clock
from appliance.channel.admin import GraphWanted
from appliance.channel.alarms import Alarm, activity, open_alarms
from appliance.channel.answers.field_docs import Moment, Name, doc
from appliance.channel.answers.status import Status
from appliance.channel.answers.token_answers import TokenRole
from appliance.quotas.table import REST_STREAMS

_PING_SECONDS = 15
_PATIENCE_SECONDS = 1.0
_SHARE = 20  # the pause between two graphs, as a multiple of the time to make one graph
_TEXT = file("text/event-stream", "Events `now`, `graph`, `away`, `end`.")


class Hour(msgspec.Struct, frozen=True):
    """The last hour's samples, the newest last."""

    samples: Annotated[list[Sample], doc("samples, the newest last")]


class Holder(msgspec.Struct, frozen=True):
    """The token's name, role and end."""

    name: Name
    role: Annotated[TokenRole, doc("role of the token")]
    expires: Moment
    left_seconds: Annotated[float, doc("until it ends; a browser's clock may differ from the appliance's")]


class _Now(msgspec.Struct, frozen=True):
    status: Status
    alarms: list[Alarm]
    sample: Sample


def routes(services: Services) -> Routes:
    router = Routes(prefix="/v1", tags=["status"])
    streams = Streams(REST_STREAMS, services.settings.api_limits.streams)

    @router.get("/whoami")
    async def whoami(bearer: Viewer) -> Holder:
        """Return the name, the role and the expiry of the caller's token."""
        return Holder(bearer.name, bearer.role, bearer.expires, bearer.left_seconds)

    @router.get("/history", operation_id="history", dependencies=[VIEWER])
    async def last_hour(
        points: Annotated[int, Query(ge=2, le=1800, description="maximum number of samples")] = 360,
    ) -> Hour:
        """Decisions, relayed messages and actions of monitors over the last hour, as counters."""
        return Hour(services.history.samples(points))

    @router.get("/live", operation_id="live_state", responses=_TEXT, response_class=Response)
    async def live(
        request: Request,
        bearer: Viewer,
        graph: Annotated[bool, Query(description="also the graph, as in `/v1/graph`")] = False,
    ) -> Response:
        """Status, open alarms and a sample every two seconds (server-sent events).

        `now`: `{status, alarms, sample}`; `graph`: as `/v1/graph`; `away`: `{reason}` while RVMaster does not
        answer. The stream ends when the token ends, or when this appliance becomes the standby.
        """
        seen = services.history.seen
        if seen.active:  # the state is at most `history.IDLE_SECONDS` old
            seen = await services.history.again(_PATIENCE_SECONDS)
        if seen.active:
            raise only_passive(seen.away or "", seen.active)
        give_back = streams.take(bearer, "clients follow")
        following = _follow(services, bearer, graph, peer_of(request))
        return StreamResponse(EventSourceResponse(following, ping=_PING_SECONDS), give_back)

    return router


async def _follow(
    services: Services, bearer: Bearer, graph: bool, peer: str
) -> AsyncIterator[ServerSentEvent]:
    history = services.history
    number = max(0, history.seen.number - 1)  # the last sample is sent at once
    graph_due = 0.0
    with history.following():
        while not services.stopping.is_set():
            if reason := services.doorkeeper.end_of(bearer, peer):
                yield ServerSentEvent(event="end", data=json.dumps({"reason": reason}))
                return
            try:
                async with asyncio.timeout(BUSY_SECONDS * 2):
                    seen = await history.after(number)
            except TimeoutError:
                continue  # control is slow; check whether the token is still valid
            number = seen.number
            if seen.active:  # a new request gets the active appliance's address
                return
            yield _state_event(seen)
            if graph and seen.away is None and clock.now() >= graph_due:
                began = clock.now()
                drawn = await _graph(services, bearer)
                graph_due = clock.now() + (clock.now() - began) * _SHARE
                if drawn is not None:
                    yield drawn


def _state_event(seen: LastSample) -> ServerSentEvent:
    if seen.status is None or seen.sample is None:
        return ServerSentEvent(event="away", data=json.dumps({"reason": seen.away}))
    now = _Now(seen.status, [*open_alarms(seen.status), *activity(seen.status)], seen.sample)
    return ServerSentEvent(event="now", data=msgspec.json.encode(in_full(now)).decode())


async def _graph(services: Services, bearer: Bearer) -> ServerSentEvent | None:
    try:
        graph = await ask(services.control, GraphWanted(), bearer)
        return ServerSentEvent(event="graph", data=msgspec.json.encode(in_full(graph)).decode())
    except (ProblemError, ControlAwayError):
        return None  # the next `away` reports it
