"""Limit long answers, which are streams and exports, for each token.

Machines have no quota: an office of browsers may share one address, and each of its people has a token or session.
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Iterator
from typing import TypeVar

from starlette.requests import Request
from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from appliance.api.front.access import Bearer
from appliance.api.front.problems import ProblemError
from appliance.channel.answers.token_answers import TokenRole
from appliance.quotas.pool import Pool, QuotaClass
from appliance.quotas.table import REST_WORK, QuotaRow
from appliance.rpc.fair_queue import Turns

_PATIENCE_SECONDS = 5.0
A = TypeVar("A", str, bytes)


def peer_of(request: Request) -> str:
    return request.client.host if request.client is not None else ""


class Streams:
    """Permits `whole` long answers at once, with the quotas of `row` for each token."""

    def __init__(self, row: QuotaRow, whole: int) -> None:
        self.roles: dict[str, TokenRole] = {}
        host = max(1, row.bounds.host * whole // row.bounds.whole)
        self._tokens: Pool[str] = Pool("of these", row.bounds.resize(whole, host), self._quota_class)

    def take(self, bearer: Bearer, what: str) -> Callable[[], None]:
        """Return the function that ends the long answer. Raises `ProblemError` (503)."""
        self.roles[bearer.id] = bearer.role
        if self._tokens.refusal(bearer.id):
            self._forget(bearer.id)
            mine = self._tokens.held(bearer.id)
            text = f"too many {what}: of {self._tokens.total} the token {bearer.name} has {mine}"
            raise ProblemError(503, "busy", text, retry_after=10)
        self._tokens.charge(bearer.id)

        def give_back() -> None:
            self._tokens.give_back(bearer.id)
            self._forget(bearer.id)

        return give_back

    def _quota_class(self, token: str) -> QuotaClass:
        return QuotaClass.NAMED if self.roles[token] == "viewer" else QuotaClass.REGISTERED

    def _forget(self, token: str) -> None:
        if not self._tokens.held(token):
            self.roles.pop(token, None)


class Work:
    """Permits `whole` slow answers at once, in turns of tokens. `what` names them in the refusal."""

    def __init__(self, what: str, whole: int) -> None:
        self._what = what
        self._turns: Turns[tuple[str, TokenRole]] = Turns(
            REST_WORK.bounds.resize(whole, max(1, whole // 2)), _class_of
        )

    @contextlib.asynccontextmanager
    async def turn(self, bearer: Bearer) -> AsyncIterator[None]:
        """Wait briefly, and keep the turn during the block. Raises `ProblemError` (503)."""
        token = bearer.id, bearer.role
        try:
            async with asyncio.timeout(_PATIENCE_SECONDS):
                await self._turns.enter(token)
        except TimeoutError:
            raise ProblemError(
                503, "busy", f"too many {self._what} at once: try again", retry_after=5
            ) from None
        try:
            yield
        finally:
            self._turns.leave(token)


def _class_of(token: tuple[str, TokenRole]) -> QuotaClass:
    return QuotaClass.NAMED if token[1] == "viewer" else QuotaClass.REGISTERED


async def in_thread(pieces: Iterator[A]) -> AsyncIterator[A]:
    """Yield the pieces that a thread makes, except empty ones."""
    while (piece := await asyncio.to_thread(next, pieces, None)) is not None:
        if piece:
            yield piece


class StreamResponse(Response):
    """Ends its long answer in `Streams` when the response ends."""

    def __init__(self, response: Response, give_back: Callable[[], None]) -> None:
        self._response = response
        self._give_back = give_back
        self.status_code = response.status_code
        self.background = response.background

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await self._response(scope, receive, send)
        finally:
            self._give_back()
