"""`/healthz`, `/readyz`, `/v1/status`: is the process alive, are nodes served, how does it stand.

The probes ask control nothing: whether nodes are served was seen at most `history.IDLE_SECONDS` ago, and is looked at
anew when they were not, at most so often however many ask.
"""

from typing import Any, Literal

from fastapi import APIRouter
from pydantic import BaseModel, ConfigDict, Field

from appliance.api.problems import ProblemError
from appliance.api.roles import Viewer, ask
from appliance.api.services import Services
from appliance.channel.admin import StatusWanted
from appliance.channel.serving import unserved

_PATIENCE_SECONDS = 1.0


class _Model(BaseModel):
    # What control says more than is named here is passed on: a part of the appliance adds its own.
    model_config = ConfigDict(extra="allow")


class Health(_Model):
    """The probe's answer."""

    status: Literal["live", "ready"]


class Process(_Model):
    """One process of the appliance; `since` is RFC 3339 UTC."""

    role: str
    pid: int
    since: str
    restarts: int
    walls: str = Field(description="what limits its calls of the kernel, its files and ports")
    lacks: list[str] = Field(description="what this machine's kernel lacks of them")


class PolicyState(_Model):
    """The policy in force; `confirm_by` (seconds since the epoch) is when it goes back unless confirmed."""

    revision: int
    file: str
    source: str
    who: str
    differs_from_file: bool
    warnings: int
    confirm_by: float | None


class AuditState(_Model):
    """How far the audit log is behind, why it cannot be written, and what becomes of requests then."""

    lag_records: int
    lag_seconds: float
    failed: str | None
    on_failure: Literal["deny", "allow"]
    degraded: str | None


class Status(_Model):
    """The running appliance, as `rosrv status --json` shows it; `since` is seconds since the epoch."""

    version: str
    since: float
    master: str = Field(description="where nodes find their master")
    processes: list[Process]
    isolation: str
    relaying: str = Field(
        description="`all`, or `monitored`: then what no monitor is on passes the appliance by"
    )
    mediation: str = Field(
        description="`full`, or `monitored`: then nodes are told each other's own addresses"
    )
    firewall: dict[str, Any]
    probe: str
    policy: PolicyState
    rosmaster: str
    relay: str
    nodes: int
    shadows: int
    topics: int
    services: int
    connections: int
    messages: int
    dropped: int
    audit: AuditState


def routes(services: Services) -> APIRouter:
    """The routes."""
    router = APIRouter(tags=["status"])

    async def live() -> Health:
        """Whether REST answers at all; no token needed."""
        return Health(status="live")

    async def ready() -> Health:
        """Whether nodes are served: 503 while they are not; no token needed, so it does not say why."""
        if not services.control.connected:
            raise ProblemError(503, "not-available", "RVMaster is being restarted", retry_after=1)
        seen = services.history.seen
        if seen.status is None or unserved(seen.status) is not None:
            seen = await services.history.again(_PATIENCE_SECONDS)
        if seen.status is None or unserved(seen.status) is not None:
            raise ProblemError(503, "not-served", "nodes are not served: /v1/status says why", retry_after=1)
        return Health(status="ready")

    unready: dict[int | str, dict[str, Any]] = {503: {"description": "Not in service."}}
    for prefix, name in (("", ""), ("/v1", "_v1")):
        router.add_api_route(f"{prefix}/healthz", live, operation_id=f"live{name}")
        router.add_api_route(f"{prefix}/readyz", ready, operation_id=f"ready{name}", responses=unready)

    @router.get("/v1/status", operation_id="status")
    async def status(bearer: Viewer) -> Status:
        """The running appliance: processes, isolation, policy, graph, audit log."""
        return Status.model_validate(await ask(services.control, StatusWanted(), bearer))

    return router
