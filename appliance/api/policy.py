"""`/v1/policy`: look at the policy in force and at those before it."""

from typing import Annotated

import msgspec
from fastapi import Path

from appliance.api.policy_models import LONGEST_REVISION
from appliance.api.roles import Viewer, ask
from appliance.api.routing import Responses, Routes, Tagged
from appliance.api.services import Services
from appliance.channel.admin import PolicyRevisions, PolicyWanted
from appliance.channel.answers.policy import PolicyInForce, Revisions, RevisionText

_UNKNOWN: Responses = {404: {"description": "There is no such revision."}}


def routes(services: Services) -> Routes:
    """The routes."""
    router = Routes(prefix="/v1/policy", tags=["policy"])
    control = services.control

    @router.get("", operation_id="policy")
    async def policy(bearer: Viewer) -> Tagged[PolicyInForce]:
        """The policy in force, with its ETag."""
        known = await ask(control, PolicyWanted(), bearer)
        return Tagged(msgspec.convert(known, PolicyInForce, from_attributes=True), known.revision)

    @router.get("/revisions", operation_id="policy_revisions")
    async def revisions(bearer: Viewer) -> Revisions:
        """The kept revisions, the newest first."""
        return await ask(control, PolicyRevisions(), bearer)

    @router.get("/revisions/{revision}", operation_id="policy_revision", responses=_UNKNOWN)
    async def revision_text(
        revision: Annotated[int, Path(ge=1, le=LONGEST_REVISION)], bearer: Viewer
    ) -> RevisionText:
        """A kept revision with its text."""
        known = await ask(control, PolicyWanted(revision), bearer)
        return msgspec.convert(known, RevisionText, from_attributes=True)

    return router
