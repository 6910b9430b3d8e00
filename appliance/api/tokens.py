"""`/v1/tokens`: which access tokens there are, and the end of one. None is made here.

Whoever holds an admin's token can end one that was lost from wherever he is. To make one, he must be on the appliance's
machine (`rosrv token add`): a token that was stolen, or an api that fell to a stranger, does not beget others.
"""

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Path
from pydantic import BaseModel, ConfigDict

from appliance.api.roles import Admin, ask
from appliance.api.services import Services
from appliance.channel.admin import TokenList, TokenRevoke

_UNKNOWN: dict[int | str, dict[str, Any]] = {
    422: {"description": "There is no token of this name that can be used."}
}


class Token(BaseModel):
    """A token without its secret; times are seconds since the epoch."""

    model_config = ConfigDict(extra="forbid")
    name: str
    id: str
    role: Literal["viewer", "operator", "admin"]
    created: float
    expires: float
    revoked: float | None


class Tokens(BaseModel):
    """All tokens that were made, the oldest first."""

    model_config = ConfigDict(extra="forbid")
    tokens: list[Token]


def routes(services: Services) -> APIRouter:
    """The routes."""
    router = APIRouter(prefix="/v1/tokens", tags=["tokens"])

    @router.get("", operation_id="tokens")
    async def tokens(bearer: Admin) -> Tokens:
        """All access tokens that were made, without their secrets; for admins."""
        return Tokens.model_validate(await ask(services.control, TokenList(), bearer))

    @router.delete("/{name}", operation_id="revoke_token", responses=_UNKNOWN)
    async def revoke_token(name: Annotated[str, Path(min_length=1, max_length=80)], bearer: Admin) -> Token:
        """End a token now: from then on it is answered with 401, and open streams of its holder end. For admins."""
        return Token.model_validate(await ask(services.control, TokenRevoke(name), bearer))

    return router
