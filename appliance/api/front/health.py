"""Answer `/healthz` (whether REST answers) and `/readyz` (whether nodes are served) from the last sampled state."""

from typing import Annotated, Literal

import msgspec

from appliance.api.front.control import ControlLink
from appliance.api.front.history import SampleHistory
from appliance.api.front.problems import ProblemError
from appliance.api.front.routing import Responses, Routes
from appliance.channel.answers.field_docs import doc
from appliance.channel.status_summary import why_unserved

_PATIENCE_SECONDS = 1.0


class Health(msgspec.Struct, frozen=True):
    """The probe's answer."""

    status: Annotated[Literal["live", "ready"], doc("result of the probe")]


def routes(control: ControlLink, history: SampleHistory) -> Routes:
    router = Routes(tags=["status"])

    async def live() -> Health:
        """Whether REST answers at all; no token needed."""
        return Health("live")

    async def ready() -> Health:
        """Whether nodes are served: 503 while they are not. Without a token, so the answer does not give the reason."""
        if control.paused:
            raise ProblemError(
                503, "not-served", "nodes are not served: the appliance is paused", retry_after=1
            )
        if not control.connected:
            raise ProblemError(503, "not-available", "RVMaster is being restarted", retry_after=1)
        seen = history.seen
        if seen.status is None or why_unserved(seen.status) is not None:
            seen = await history.again(_PATIENCE_SECONDS)
        if seen.status is None or why_unserved(seen.status) is not None:
            raise ProblemError(
                503, "not-served", "nodes are not served: GET /v1/status says why", retry_after=1
            )
        return Health("ready")

    unready: Responses = {503: {"description": "Not in service."}}
    for prefix, name in (("", ""), ("/v1", "_v1")):
        router.add_api_route(f"{prefix}/healthz", live, operation_id=f"live{name}")
        router.add_api_route(f"{prefix}/readyz", ready, operation_id=f"ready{name}", responses=unready)

    return router
