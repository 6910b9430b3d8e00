"""`/v1/whoami`, `/v1/challenge`: what the token in hand may do, and what its next order is signed under."""

from typing import Literal

from fastapi import APIRouter
from pydantic import BaseModel, ConfigDict, Field

from appliance.api.roles import Viewer, ask
from appliance.api.services import Services
from appliance.channel.admin import ChallengeWanted


class Holder(BaseModel):
    """The token's name and role; `expires` is seconds since the epoch."""

    model_config = ConfigDict(extra="forbid")
    name: str
    role: Literal["viewer", "operator", "admin"] = Field(
        description="each may do all that those before it may"
    )
    expires: float


class Challenge(BaseModel):
    """What the next order is signed under."""

    model_config = ConfigDict(extra="forbid")
    challenge: str
    seconds: float = Field(description="so long it is good, for one order")


def routes(services: Services) -> APIRouter:
    """The routes."""
    router = APIRouter(prefix="/v1", tags=["status"])

    @router.get("/whoami", operation_id="whoami")
    async def whoami(bearer: Viewer) -> Holder:
        """The name and role of the token that asks, and when it ends."""
        return Holder.model_validate(
            {"name": bearer.name, "role": bearer.role.name.lower(), "expires": bearer.expires}
        )

    @router.get("/challenge", operation_id="challenge")
    async def challenge(bearer: Viewer) -> Challenge:
        """A challenge: an order that changes something is signed under one, and each is good once."""
        return Challenge.model_validate(await ask(services.control, ChallengeWanted(), bearer))

    return router
