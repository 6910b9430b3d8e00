"""`/v1/policy`: try and load another policy, take the file's, go back, confirm.

Loading is for admins, the rest for operators. Every change needs `If-Match` with the ETag of `GET /v1/policy`.
"""

import asyncio
from typing import Annotated

from fastapi import Query
from msgspec.structs import replace

from appliance.api.access import Bearer
from appliance.api.dry_run_policy import judge_change
from appliance.api.policy_models import PolicyText, Report, Rollback
from appliance.api.preconditions import IfMatch, expected_revision
from appliance.api.problems import ProblemError
from appliance.api.route_roles import Operator, ask, problem_of
from appliance.api.routing import Responses, Routes, Tagged, body, tagged
from appliance.api.services import Services
from appliance.channel import admin
from appliance.channel.answers.policy_answers import Loaded, PolicyConfirmed
from appliance.channel.answers.token_answers import may

_CHANGES: Responses = {
    412: {"description": "Another policy is in force than If-Match names."},
    428: {"description": "If-Match is missing."},
}
DryRun = Annotated[bool, Query(description="only say what it would do; for operators, without If-Match")]
Confirm = Annotated[
    float | None,
    Query(
        gt=0,
        le=86_400,
        allow_inf_nan=False,
        description="seconds after which it goes back by itself unless confirmed",
    ),
]


def routes(services: Services) -> Routes:
    """The routes."""
    router = Routes(prefix="/v1/policy", tags=["policy"])

    @router.post("", responses=_CHANGES)
    async def load_policy(
        posted: Annotated[PolicyText, body(PolicyText, text="the policy")],
        bearer: Operator,
        *,
        if_match: IfMatch = None,
        dry_run: DryRun = False,
        confirm_within: Confirm = None,
    ) -> Tagged[Report]:
        """Check, test and load a new text, decide again what is live, and report; for admins.

        A text with an error changes nothing: the answer (422) has every finding with its line and column.
        """
        if not dry_run and not may(bearer.role, "admin"):
            raise problem_of("forbidden", "loading a policy is for admins; operators may use dry_run=1")
        expected = None if dry_run and if_match is None else expected_revision(if_match)
        order = admin.PolicyLoad(posted.text, posted.note, confirm_within, expected, posted.signature)
        return tagged(await _load(services, order, bearer, dry_run=dry_run))

    @router.post("/rollback", operation_id="roll_back_policy", responses=_CHANGES)
    async def rollback(
        to: Annotated[Rollback, body(Rollback)], bearer: Operator, if_match: IfMatch = None
    ) -> Tagged[Loaded]:
        """Bring a kept revision into force again, as a new one."""
        order = admin.PolicyRollback(to.revision, expected_revision(if_match))
        return tagged(await ask(services.control, order, bearer))

    @router.post("/reload", operation_id="reload_policy", responses=_CHANGES)
    async def reload(
        bearer: Operator, if_match: IfMatch = None, confirm_within: Confirm = None
    ) -> Tagged[Loaded]:
        """Read the policy file again."""
        order = admin.PolicyReload(confirm_within, expected_revision(if_match))
        return tagged(await ask(services.control, order, bearer))

    @router.post("/confirm", operation_id="confirm_policy", responses=_CHANGES)
    async def confirm(bearer: Operator, if_match: IfMatch = None) -> Tagged[PolicyConfirmed]:
        """Keep a policy that was loaded with `confirm_within`."""
        return tagged(await ask(services.control, admin.PolicyConfirm(expected_revision(if_match)), bearer))

    return router


async def _load(services: Services, order: admin.PolicyLoad, bearer: Bearer, *, dry_run: bool) -> Report:
    current = await ask(services.control, admin.PolicyWanted(), bearer)
    if order.expected not in (None, current.revision):
        text = f"revision {current.revision} is in force, not {order.expected}"
        raise ProblemError(412, "changed-meanwhile", text)
    live = (await ask(services.control, admin.RegistrationsWanted(), bearer)).registrations
    try:
        async with services.judging if dry_run else services.ordering:
            report = await asyncio.to_thread(judge_change, order, current, live)
    except ProblemError as refusal:
        if dry_run:
            raise
        # Control refuses, and records, what was judged wrong here; its word counts, the places are from here.
        try:
            loaded = await ask(services.control, order, bearer)
        except ProblemError as said:
            raise refusal if said.kind == "refused" else said from None
        report = Report(loaded=False, revision=0, warnings=[], changes=[], ends=[])
    else:
        if dry_run:
            return report
        loaded = await ask(services.control, order, bearer)
    told = {name: getattr(loaded, name) for name in ("revision", "replaced", "revoked", "confirm_by")}
    return replace(report, loaded=True, **told)
