"""`/v1/tokens`: which access tokens there are, and the end of one. None is made here.

Whoever holds an admin's token can end one that was lost from wherever he is. To make one, he must be on the appliance's
machine (`rosrv token add`): a token that was stolen, or an api that fell to a stranger, does not beget others.
"""

from typing import Annotated

from fastapi import Path

from appliance.api.route_roles import Admin, add_look, ask
from appliance.api.routing import Responses, Routes
from appliance.api.services import Services
from appliance.channel.admin import TokenList, TokenRevoke
from appliance.channel.answers.token_answers import Token

_UNKNOWN: Responses = {422: {"description": "There is no token of this name that can be used."}}


def routes(services: Services) -> Routes:
    """The routes."""
    router = Routes(prefix="/v1/tokens", tags=["tokens"])
    add_look(router, services.control, TokenList)

    @router.delete("/{name}", responses=_UNKNOWN)
    async def revoke_token(
        name: Annotated[str, Path(min_length=1, max_length=80, examples=["shift"])], bearer: Admin
    ) -> Token:
        """End a token now: from then on it is answered with 401, and open streams of its holder end. For admins."""
        return await ask(services.control, TokenRevoke(name), bearer)

    return router
