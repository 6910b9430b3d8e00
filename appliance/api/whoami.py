"""`/v1/whoami`: what the token in hand may do, so that a page can say so before something is refused."""

from typing import Literal

from fastapi import APIRouter
from pydantic import BaseModel, ConfigDict, Field

from appliance.api.roles import Viewer


class Holder(BaseModel):
    """The token's name and role; `expires` is seconds since the epoch."""

    model_config = ConfigDict(extra="forbid")
    name: str
    role: Literal["viewer", "operator", "admin"] = Field(
        description="each may do all that those before it may"
    )
    expires: float


def routes() -> APIRouter:
    """The route."""
    router = APIRouter(prefix="/v1", tags=["status"])

    @router.get("/whoami", operation_id="whoami")
    async def whoami(bearer: Viewer) -> Holder:
        """The name and role of the token that asks, and when it ends."""
        return Holder.model_validate(
            {"name": bearer.name, "role": bearer.role.name.lower(), "expires": bearer.expires}
        )

    return router
