"""`/v1/policy`: try and load another policy, take the file's, go back, confirm.

Loading is for admins, the rest for operators. Every change needs `If-Match` with the ETag of `GET /v1/policy`.
"""

import asyncio
from dataclasses import asdict
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response

from appliance.api.access import Bearer, Role
from appliance.api.bodies import WRONG_TYPE, DryRun, read_body, text_or
from appliance.api.judgement import Judgement, judge_change
from appliance.api.policy import TAGGED
from appliance.api.policy_models import Change, Confirmed, Ended, Loaded, PolicyText, Report, Rollback
from appliance.api.preconditions import IfMatch, etag, expected_revision
from appliance.api.problems import ProblemError
from appliance.api.roles import Operator, ask
from appliance.api.services import Services
from appliance.channel.admin import (
    AdminRequest,
    PolicyConfirm,
    PolicyLoad,
    PolicyReload,
    PolicyRollback,
    PolicyWanted,
    RegistrationsWanted,
)

_CHANGES: dict[int | str, dict[str, Any]] = {
    **TAGGED,
    412: {"description": "Another policy is in force than If-Match names."},
    428: {"description": "If-Match is missing."},
}
Confirm = Annotated[
    float | None,
    Query(
        gt=0,
        le=86_400,
        allow_inf_nan=False,
        description="seconds after which it goes back by itself unless confirmed",
    ),
]


def routes(services: Services) -> APIRouter:
    """The routes."""
    router = APIRouter(prefix="/v1/policy", tags=["policy"])
    changing = _Changing(services)

    @router.post(
        "", operation_id="load_policy", responses=_CHANGES | WRONG_TYPE, openapi_extra=text_or(PolicyText)
    )
    async def load_policy(
        *,
        request: Request,
        response: Response,
        bearer: Operator,
        if_match: IfMatch = None,
        dry_run: DryRun = False,
        confirm_within: Confirm = None,
    ) -> Report:
        """Check, test and load a new text, decide again what is live, and report; for admins.

        A text with an error changes nothing: the answer (422) has every finding with its line and column.
        """
        if not dry_run and bearer.role < Role.ADMIN:
            raise ProblemError(
                403, "not-for-this-role", "loading a policy is for admins; operators may use dry_run=1"
            )
        content_type = request.headers.get("content-type", "")
        posted = read_body(content_type, await request.body(), PolicyText, "the policy")
        expected = None if dry_run and if_match is None else expected_revision(if_match)
        order = PolicyLoad(posted.text, posted.note, confirm_within, expected)
        return await changing.load(order, bearer, response, dry_run=dry_run)

    @router.post("/rollback", operation_id="roll_back_policy", responses=_CHANGES)
    async def rollback(
        to: Rollback, response: Response, bearer: Operator, if_match: IfMatch = None
    ) -> Loaded:
        """Bring a kept revision into force again, as a new one."""
        order = PolicyRollback(to.revision, expected_revision(if_match))
        return Loaded.model_validate(await changing.order(order, bearer, response))

    @router.post("/reload", operation_id="reload_policy", responses=_CHANGES)
    async def reload(
        response: Response, bearer: Operator, if_match: IfMatch = None, confirm_within: Confirm = None
    ) -> Loaded:
        """Read the policy file again."""
        order = PolicyReload(confirm_within, expected_revision(if_match))
        return Loaded.model_validate(await changing.order(order, bearer, response))

    @router.post("/confirm", operation_id="confirm_policy", responses=_CHANGES)
    async def confirm(response: Response, bearer: Operator, if_match: IfMatch = None) -> Confirmed:
        """Keep a policy that was loaded with `confirm_within`."""
        order = PolicyConfirm(expected_revision(if_match))
        return Confirmed.model_validate(await changing.order(order, bearer, response))

    return router


class _Changing:
    """What the routes of changes have in common."""

    def __init__(self, services: Services) -> None:
        self._services = services
        self._control = services.control

    async def order(self, order: AdminRequest, bearer: Bearer, response: Response) -> dict[str, Any]:
        body = await ask(self._control, order, bearer)
        response.headers["ETag"] = etag(body["revision"])
        return body

    async def load(self, order: PolicyLoad, bearer: Bearer, response: Response, *, dry_run: bool) -> Report:
        current = await ask(self._control, PolicyWanted(), bearer)
        if order.expected not in (None, current["revision"]):
            raise ProblemError(
                412,
                "changed-meanwhile",
                f"revision {current['revision']} is in force, not {order.expected}",
            )
        live = (await ask(self._control, RegistrationsWanted(), bearer))["registrations"]
        try:
            async with self._services.judging:
                judgement = await asyncio.to_thread(judge_change, order.text, current, live)
        except ProblemError as refusal:
            if dry_run:
                raise
            return await self._load_refused(order, bearer, response, refusal)
        if not dry_run:
            return _report(judgement, await self.order(order, bearer, response), loaded=True)
        response.headers["ETag"] = etag(current["revision"])
        nothing = {"replaced": None, "revoked": None, "confirm_by": None}
        return _report(judgement, {"revision": current["revision"], **nothing}, loaded=False)

    async def _load_refused(
        self, order: PolicyLoad, bearer: Bearer, response: Response, refusal: ProblemError
    ) -> Report:
        """Have control refuse, and record, what was judged wrong here; its word counts, the places are from here."""
        try:
            body = await self.order(order, bearer, response)
        except ProblemError as said:
            raise refusal if said.kind == "refused" else said from None
        return _report(Judgement([], [], []), body, loaded=True)


def _report(judgement: Judgement, known: dict[str, Any], *, loaded: bool) -> Report:
    changes = [
        Change(
            **one.request.fields(),
            now=one.old.word,
            then=one.new.word,
            reason=one.new.reason,
        )
        for one in judgement.changes
    ]
    return Report(
        loaded=loaded,
        revision=known["revision"],
        replaced=known["replaced"],
        revoked=known["revoked"],
        confirm_by=known["confirm_by"],
        warnings=judgement.warnings,
        changes=changes,
        ends=[Ended.model_validate(asdict(one)) for one in judgement.ends],
    )
