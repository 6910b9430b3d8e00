"""The REST operations of operators on bundles, rollouts and the robots of a group."""

import asyncio
from collections import Counter
from collections.abc import Awaitable, Callable
from typing import Annotated, Any

import msgspec
from fastapi import APIRouter, Depends, HTTPException, Request
from psycopg import Error as DatabaseError
from pydantic import BaseModel, ConfigDict, Field

from appliance.formats.terms import BundlePath, TermsError
from rosrv_fleet.enrolment import RobotGroup
from rosrv_fleet.rollouts.machine import HealthGates
from rosrv_fleet.rollouts.service import BundleService, ConditionKind, RolloutRefusedError

Authorize = Callable[[Request], str | Awaitable[str]]
"""Returns the name of the operator, or raises `HTTPException`."""

_DEFAULTS = HealthGates()
_HISTORY = 20


class Gates(BaseModel):
    """The health gates of a ring; see docs/fleet.md."""

    model_config = ConfigDict(extra="forbid")

    share: Annotated[float, Field(gt=0, le=1)] = _DEFAULTS.share
    tolerance: Annotated[float, Field(ge=0, lt=1)] = _DEFAULTS.tolerance
    healthy_seconds: Annotated[float, Field(ge=0, le=604_800)] = _DEFAULTS.healthy_seconds
    ring_seconds: Annotated[float, Field(gt=0, le=2_592_000)] = _DEFAULTS.ring_seconds
    silent_seconds: Annotated[float, Field(ge=60, le=86_400)] = _DEFAULTS.silent_seconds
    denial_factor: Annotated[float, Field(ge=1, le=1000)] = _DEFAULTS.denial_factor
    least_denials: Annotated[int, Field(ge=1, le=1_000_000)] = _DEFAULTS.least_denials


class NewRollout(BaseModel):
    """A bundle to roll out, `SITE/GROUP/VERSION.tar`, and its health gates."""

    model_config = ConfigDict(extra="forbid")

    bundle: Annotated[str, Field(max_length=160)]
    gates: Gates = Gates()


def operator_routes(service: BundleService, may_read: Authorize, may_change: Authorize) -> APIRouter:
    router = APIRouter(prefix="/v1/rollouts", tags=["rollouts"])
    reader = Annotated[str, Depends(may_read)]
    changer = Annotated[str, Depends(may_change)]

    @router.get("")
    async def overview(_who: reader) -> dict[str, Any]:
        """Return the published bundles, and the last rollout and the robots of each group."""
        groups = sorted({*service.rollouts, *service.robots})
        return {
            "trouble": service.publisher.trouble,
            "expires": service.publisher.expires,
            "published": sorted(service.publisher.bundles),
            "groups": [group_state(service, group) for group in groups],
        }

    @router.get("/{site}/{group}")
    async def one(site: str, group: str, _who: reader) -> dict[str, Any]:
        """Return a group's last rollout, its robots and its earlier rollouts."""
        robot_group = _group(service, site, group)
        history = await _answer(asyncio.to_thread(service.store.history, robot_group, _HISTORY))
        robots, conditions = service.robots.get(robot_group, {}), service.conditions(robot_group)
        return group_state(service, robot_group) | {
            "robots": [
                {"name": name, "condition": conditions[name].kind, "condition_why": conditions[name].why,
                 **msgspec.structs.asdict(seen)}
                for name, seen in robots.items()
            ],
            "history": [
                {"number": stored.number, "bundle": stored.rollout.path, "state": stored.rollout.state,
                 "started": stored.rollout.started, "why": stored.rollout.why,
                 "acts": msgspec.to_builtins(stored.rollout.acts)}
                for stored in history
            ],
        }  # fmt: skip

    @router.post("")
    async def start(body: NewRollout, who: changer) -> dict[str, Any]:
        """Begin the rollout of a published bundle."""
        try:
            path = BundlePath.parse(body.bundle)
        except TermsError as error:
            raise HTTPException(422, str(error)) from error
        await _answer(service.start(path, HealthGates(**body.gates.model_dump()), who))
        return group_state(service, RobotGroup(path.site, path.group))

    @router.post("/{site}/{group}/stop")
    async def stop(site: str, group: str, who: changer) -> dict[str, Any]:
        """Stop the running rollout: no other robot gets the bundle."""
        robot_group = _group(service, site, group)
        await _answer(service.stop(robot_group, who))
        return group_state(service, robot_group)

    @router.post("/{site}/{group}/revert")
    async def revert(site: str, group: str, who: changer) -> dict[str, Any]:
        """Give all robots the bundle that preceded the last rollout."""
        robot_group = _group(service, site, group)
        await _answer(service.revert(robot_group, who))
        return group_state(service, robot_group)

    return router


def group_state(service: BundleService, group: RobotGroup) -> dict[str, Any]:
    stored = service.rollouts.get(group)
    found = Counter(condition.kind for condition in service.conditions(group).values())
    state: dict[str, Any] = {
        "site": group.site,
        "group": group.group,
        "robots_known": found.total(),
        "conditions": {kind: found[kind] for kind in ConditionKind},
        "rollout": None,
    }
    if stored is not None:
        rollout = stored.rollout
        state["rollout"] = {
            "number": stored.number,
            "bundle": rollout.path,
            "before": rollout.before,
            "state": rollout.state,
            "why": rollout.why,
            "started": rollout.started,
            "acts": msgspec.to_builtins(rollout.acts),
            "rings": service.counts(group),
        }
    return state


def _group(service: BundleService, site: str, group: str) -> RobotGroup:
    try:
        return service.group(site, group)
    except RolloutRefusedError as error:
        raise HTTPException(422, str(error)) from error


async def _answer(work: Any) -> Any:
    try:
        return await work
    except RolloutRefusedError as error:
        raise HTTPException(409, str(error)) from error
    except DatabaseError as error:
        raise HTTPException(503, "the database is unreachable: try again later") from error
    except OSError as error:
        raise HTTPException(503, f"the robots cannot be read: {error}") from error
