"""`/v1/policy`: the policy in force, revisions, explanations, its tests, and the report of a load."""

import asyncio

import msgspec
from msgspec.structs import replace

from appliance.api.front.problems import ProblemError
from appliance.api.front.route_roles import Viewer, ask
from appliance.api.front.routing import Responses, Routes, Tagged, tagged
from appliance.api.front.services import Services
from appliance.api.routes.named_hosts import HostLabels, labels_of
from appliance.api.routes.operation_routes import Answer, OperationCall
from appliance.channel import admin
from appliance.channel.answers.policy_answers import PolicyInForce
from appliance.features.policy_tools.dry_run_policy import judge_change
from appliance.features.policy_tools.policy_models import Report

_UNKNOWN: Responses = {404: {"description": "There is no such revision."}}


def routes(services: Services) -> Routes:
    router = Routes(prefix="/policy", tags=["policy"])
    control = services.control

    @router.get("")
    async def policy(bearer: Viewer) -> Tagged[PolicyInForce]:
        """Return the policy in force, with its ETag."""
        known = await ask(control, admin.PolicyWanted(), bearer)
        return tagged(msgspec.convert(known, PolicyInForce, from_attributes=True))

    @router.get("/hosts")
    async def host_names(bearer: Viewer) -> HostLabels:
        """Return the names of hosts: enrolled hosts, `robot` and groups of the policy in force, with their networks."""
        known = await ask(control, admin.PolicyWanted(), bearer)
        return await asyncio.to_thread(labels_of, known)

    return router


async def _load(call: OperationCall[admin.PolicyLoad]) -> Tagged[Report]:
    order, services = call.order, call.services
    current = await call.ask(admin.PolicyWanted())
    if order.expected not in (None, current.revision):
        text = f"revision {current.revision} is in force, not {order.expected}"
        raise ProblemError(412, "changed-meanwhile", text)
    live = (await call.ask(admin.RegistrationsWanted())).registrations
    try:
        async with services.judging.turn(call.bearer) if call.dry_run else services.ordering:
            report = await asyncio.to_thread(judge_change, order, current, live)
    except ProblemError as refusal:
        if call.dry_run:
            raise
        # Control decides and records the rejection; this process adds the findings with their places.
        try:
            loaded = await call.ask(order)
        except ProblemError as said:
            raise refusal if said.kind == "refused" else said from None
        report = Report(loaded=False, revision=0, warnings=[], changes=[], ends=[])
    else:
        if call.dry_run:
            return tagged(report)
        loaded = await call.ask(order)
    return tagged(
        replace(
            report,
            loaded=True,
            revision=loaded.revision,
            replaced=loaded.replaced,
            revoked=loaded.revoked,
            confirm_by=loaded.confirm_by,
        )
    )


ANSWERS = {"load_policy": Answer(_load)}
