"""`/v1/whoami`, `/v1/challenge`: what the token in hand may do, and what its next order is signed under."""

from typing import Annotated

import msgspec

from appliance.api.route_roles import Viewer, add_look
from appliance.api.routing import Routes
from appliance.api.services import Services
from appliance.channel.admin import ChallengeWanted
from appliance.channel.answers.field_docs import Moment, told
from appliance.channel.answers.token_answers import TokenRole


class Holder(msgspec.Struct, frozen=True):
    """The token's name and role; `expires` is seconds since the epoch."""

    name: str
    role: Annotated[TokenRole, told("each may do all that those before it may")]
    expires: Moment


def routes(services: Services) -> Routes:
    """The routes."""
    router = Routes(prefix="/v1", tags=["status"])

    @router.get("/whoami")
    async def whoami(bearer: Viewer) -> Holder:
        """The name and role of the token that asks, and when it ends."""
        return Holder(bearer.name, bearer.role, bearer.expires)

    add_look(router, services.control, ChallengeWanted)
    return router
