"""`/v1/policy`: look at the policy in force and at those before it."""

from typing import Annotated, Any

from fastapi import APIRouter, Path, Response

from appliance.api.policy_models import LONGEST_REVISION, PolicyInForce, Revisions, RevisionText
from appliance.api.preconditions import etag
from appliance.api.roles import Viewer, ask
from appliance.api.services import Services
from appliance.channel.admin import PolicyRevisions, PolicyWanted

TAGGED: dict[int | str, dict[str, Any]] = {
    200: {"headers": {"ETag": {"description": "of the policy in force", "schema": {"type": "string"}}}}
}
_UNKNOWN: dict[int | str, dict[str, Any]] = {404: {"description": "There is no such revision."}}


def routes(services: Services) -> APIRouter:
    """The routes."""
    router = APIRouter(prefix="/v1/policy", tags=["policy"])
    control = services.control

    @router.get("", operation_id="policy", responses=TAGGED)
    async def policy(bearer: Viewer, response: Response) -> PolicyInForce:
        """The policy in force, with its ETag."""
        body = await ask(control, PolicyWanted(), bearer)
        response.headers["ETag"] = etag(body["revision"])
        return PolicyInForce.model_validate({name: body[name] for name in PolicyInForce.model_fields})

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

    return router
