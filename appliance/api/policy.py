"""`/v1/policy`: look at the policy in force, try and load another, go back."""

import asyncio
import json
from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Request, Response
from pydantic import ValidationError

from appliance.api.access import Bearer, Role
from appliance.api.judgement import Judgement, judge, word_of
from appliance.api.policy_models import (
    LONGEST_REVISION,
    Change,
    Confirmed,
    Loaded,
    PolicyInForce,
    PolicyText,
    Report,
    Revisions,
    RevisionText,
    Rollback,
)
from appliance.api.preconditions import IfMatch, etag, expected_revision
from appliance.api.problems import BadInput, ProblemError
from appliance.api.roles import Operator, Viewer, ask
from appliance.api.services import Services
from appliance.channel.admin import (
    PolicyConfirm,
    PolicyLoad,
    PolicyReload,
    PolicyRevisions,
    PolicyRollback,
    PolicyWanted,
    RegistrationsWanted,
)

_TAGGED: dict[int | str, dict[str, Any]] = {
    200: {"headers": {"ETag": {"description": "of the policy in force", "schema": {"type": "string"}}}}
}
_CHANGES: dict[int | str, dict[str, Any]] = {
    **_TAGGED,
    412: {"description": "Another policy is in force than If-Match names."},
    428: {"description": "If-Match is missing."},
}
_UNKNOWN: dict[int | str, dict[str, Any]] = {404: {"description": "There is no such revision."}}

Confirm = Annotated[
    float | None,
    Query(
        gt=0,
        le=86_400,
        allow_inf_nan=False,
        description="seconds after which it goes back by itself unless confirmed",
    ),
]
_TOO: dict[int | str, dict[str, Any]] = {415: {"description": "The body is neither text/plain nor JSON."}}
_BODY = {
    "required": True,
    "content": {
        "application/json": {"schema": PolicyText.model_json_schema()},
        "text/plain": {"schema": {"type": "string", "minLength": 1}},
    },
}


def routes(services: Services) -> APIRouter:
    """The routes."""
    router = APIRouter(prefix="/v1/policy", tags=["policy"])
    control = services.control

    def tag(response: Response, revision: int) -> None:
        response.headers["ETag"] = etag(revision)

    @router.get("", operation_id="policy", responses=_TAGGED)
    async def policy(bearer: Viewer, response: Response) -> PolicyInForce:
        """The policy in force, with its ETag."""
        body = await ask(control, PolicyWanted(), bearer)
        tag(response, body["revision"])
        return PolicyInForce.model_validate({name: body[name] for name in PolicyInForce.model_fields})

    @router.post(
        "", operation_id="load_policy", responses=_CHANGES | _TOO, openapi_extra={"requestBody": _BODY}
    )
    async def load_policy(
        *,
        request: Request,
        response: Response,
        bearer: Operator,
        if_match: IfMatch = None,
        dry_run: Annotated[
            bool, Query(description="only say what it would do; for operators, without If-Match")
        ] = False,
        confirm_within: Confirm = None,
    ) -> Report:
        """Check, test and load a new text, decide again what is live, and report; for admins.

        A text with an error changes nothing: the answer (422) has every finding with its line and column.
        """
        if not dry_run and bearer.role < Role.ADMIN:
            raise ProblemError(
                403, "not-for-this-role", "loading a policy is for admins; operators may use dry_run=1"
            )
        posted = _posted(request.headers.get("content-type", ""), await request.body())
        expected = None if dry_run and if_match is None else expected_revision(if_match)
        current = await ask(control, PolicyWanted(), bearer)
        if expected not in (None, current["revision"]):
            raise ProblemError(
                412, "changed-meanwhile", f"revision {current['revision']} is in force, not {expected}"
            )
        live = (await ask(control, RegistrationsWanted(), bearer))["registrations"]
        async with services.judging:
            judgement = await asyncio.to_thread(judge, posted.text, current, live)
        loaded = None
        if not dry_run:
            order = PolicyLoad(posted.text, posted.note, confirm_within, expected)
            loaded = await ask(control, order, bearer)
        tag(response, loaded["revision"] if loaded else current["revision"])
        return _report(judgement, current["revision"], loaded)

    @router.get("/revisions", operation_id="policy_revisions")
    async def revisions(bearer: Viewer) -> Revisions:
        """The kept revisions, the newest first."""
        return Revisions.model_validate(await ask(control, PolicyRevisions(), bearer))

    @router.get("/revisions/{revision}", operation_id="policy_revision", responses=_UNKNOWN)
    async def revision_text(
        revision: Annotated[int, Path(ge=1, le=LONGEST_REVISION)], bearer: Viewer
    ) -> RevisionText:
        """A kept revision with its text."""
        body = await ask(control, PolicyWanted(revision), bearer)
        return RevisionText.model_validate({name: body[name] for name in RevisionText.model_fields})

    async def change(order: Any, bearer: Bearer, response: Response) -> dict[str, Any]:
        body = await ask(control, order, bearer)
        tag(response, body["revision"])
        return body

    @router.post("/rollback", operation_id="roll_back_policy", responses=_CHANGES)
    async def rollback(
        to: Rollback, response: Response, bearer: Operator, if_match: IfMatch = None
    ) -> Loaded:
        """Bring a kept revision into force again, as a new one."""
        order = PolicyRollback(to.revision, expected_revision(if_match))
        return Loaded.model_validate(await change(order, bearer, response))

    @router.post("/reload", operation_id="reload_policy", responses=_CHANGES)
    async def reload(
        response: Response, bearer: Operator, if_match: IfMatch = None, confirm_within: Confirm = None
    ) -> Loaded:
        """Read the policy file again."""
        order = PolicyReload(confirm_within, expected_revision(if_match))
        return Loaded.model_validate(await change(order, bearer, response))

    @router.post("/confirm", operation_id="confirm_policy", responses=_CHANGES)
    async def confirm(response: Response, bearer: Operator, if_match: IfMatch = None) -> Confirmed:
        """Keep a policy that was loaded with `confirm_within`."""
        order = PolicyConfirm(expected_revision(if_match))
        return Confirmed.model_validate(await change(order, bearer, response))

    return router


def _posted(content_type: str, body: bytes) -> PolicyText:
    kind = content_type.partition(";")[0].strip().lower()
    if kind not in ("application/json", "text/plain"):
        raise ProblemError(
            415, "wrong-type", 'send the policy as Content-Type text/plain, or as JSON {"text": …}'
        )
    try:
        text = body.decode("utf-8")
        fields = json.loads(text) if kind == "application/json" else {"text": text}
        return PolicyText.model_validate(fields)
    except UnicodeDecodeError as error:
        raise ProblemError(422, "bad-input", f"the body is not UTF-8 (byte {error.start})") from None
    except json.JSONDecodeError as error:
        raise ProblemError(
            422, "not-json", f"the body is not JSON: {error.msg}", line=error.lineno, column=error.colno
        ) from None
    except RecursionError:
        raise ProblemError(422, "not-json", "the body is nested too deep") from None
    except ValidationError as error:
        found = [
            BadInput(where=".".join(map(str, ("body", *one["loc"]))), text=one["msg"])
            for one in error.errors()
        ]
        detail = "; ".join(f"{one.where}: {one.text}" for one in found[:5])
        raise ProblemError(422, "bad-input", detail, errors=found) from None


def _report(judgement: Judgement, revision: int, loaded: dict[str, Any] | None) -> Report:
    changes = [
        Change(
            host=str(one.request.host),
            caller_id=one.request.caller_id,
            category=one.request.category.value,
            resource=one.request.resource,
            now=word_of(one.old),
            then=word_of(one.new),
            reason=one.new.reason,
        )
        for one in judgement.changes
    ]
    known = loaded or {"revision": revision, "replaced": None, "revoked": None, "confirm_by": None}
    return Report(
        loaded=loaded is not None,
        revision=known["revision"],
        replaced=known["replaced"],
        revoked=known["revoked"],
        confirm_by=known["confirm_by"],
        warnings=judgement.warnings,
        changes=changes,
    )
