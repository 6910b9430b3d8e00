"""Limit the requests of clients that are neither robots nor operators, by address, and check the name in them.

The limit is checked before any route, so logins, wrong tokens and health checks count as well. Robots prove who they
are by a certificate, which no browser sends, so they may use any name.
"""

from starlette.requests import Request
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Receive, Scope, Send

from rosrv_fleet.access import IS_ROBOT, token_of
from rosrv_fleet.connections import ClientConnections, owner_of
from rosrv_fleet.host_names import WRONG_HOST, CollectorNames
from rosrv_fleet.tokens import OperatorTokens


class Door:
    """An ASGI application that passes on the requests within the limits of `ClientConnections` to a name of its own."""

    def __init__(
        self, app: ASGIApp, table: ClientConnections, tokens: OperatorTokens, names: CollectorNames
    ) -> None:
        self._app, self._table, self._tokens, self._names = app, table, tokens, names

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer 429 above the limit, and 421 to another name. The address of a request with a valid token counts as
        proven.
        """
        if scope["type"] == "http" and not scope.get("state", {}).get(IS_ROBOT):
            request = Request(scope)
            owner = owner_of(request.client.host if request.client else "127.0.0.1")
            token, proven = token_of(request), self._table.is_proven(owner)
            # Verifying a token costs as much as an answer, so an unproven address pays for it first.
            paid = not proven and self._table.may_ask(owner)
            operator = bool(token) and (proven or paid) and self._is_held(token)
            if operator:
                self._table.prove(owner)
            elif not (paid or (proven and self._table.may_ask(owner))):
                reason = {
                    "detail": "this address sends too many requests without a valid token or certificate"
                }
                await JSONResponse(reason, 429, {"Retry-After": "1"})(scope, receive, send)
                return
            if not self._names.include(request.headers.getlist("host")):
                await JSONResponse({"detail": WRONG_HOST}, 421)(scope, receive, send)
                return
        await self._app(scope, receive, send)

    def _is_held(self, token: str) -> bool:
        """Return False if the tokens are unreadable: the route then reports the error."""
        try:
            return self._tokens.holder(token) is not None
        except OSError:
            return False
