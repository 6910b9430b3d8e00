"""Who follows: streams and exports that last, each a place of which there are so many, with a share for everybody.

A place is held by a token and by a peer, and each of both has a share: whoever holds a viewer's token takes neither the
places of the others nor those that are kept for operators and admins, from however many connections; and one machine
with many tokens does not, either. Places are given back when the response is over, whatever ended it.
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Iterator
from typing import TypeVar

from starlette.requests import Request
from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from appliance.api.access import Bearer
from appliance.api.problems import ProblemError
from appliance.channel.answers.token_answers import TokenRole
from appliance.quotas.pool import Pool, Standing
from appliance.quotas.table import Share

_PATIENCE_SECONDS = 5.0
A = TypeVar("A", str, bytes)


def peer_of(request: Request) -> str:
    """The machine that a request comes from."""
    return request.client.host if request.client is not None else ""


class Streams:
    """The places of one kind: `tokens` and `peers` are their shares, `whole` is how many there are."""

    def __init__(self, tokens: Share, peers: Share, whole: int) -> None:
        self.roles: dict[str, TokenRole] = {}
        part = whole / tokens.bounds.whole
        self._tokens: Pool[str] = Pool(
            "of these", tokens.bounds.sized(whole, max(1, int(tokens.bounds.host * part))), self._standing
        )
        self._peers: Pool[str] = Pool(
            "of these",
            peers.bounds.sized(whole, max(1, int(peers.bounds.host * part))),
            lambda _peer: Standing.REGISTERED,
        )

    def take(self, bearer: Bearer, peer: str, what: str) -> Callable[[], None]:
        """Take a place; what is returned gives it back. Raises `ProblemError` (503)."""
        self.roles[bearer.id] = bearer.role
        busy = self._tokens.refusal(bearer.id) or self._peers.refusal(peer)
        if busy:
            self._forget(bearer.id)
            mine, here = self._tokens.held(bearer.id), self._peers.held(peer)
            text = f"too many {what}: of {self._tokens.total} the token {bearer.name} has {mine}, your machine {here}"
            raise ProblemError(503, "busy", text, retry_after=10)
        self._tokens.charge(bearer.id)
        self._peers.charge(peer)

        def give_back() -> None:
            self._tokens.give_back(bearer.id)
            self._peers.give_back(peer)
            self._forget(bearer.id)

        return give_back

    def _standing(self, token: str) -> Standing:
        return Standing.NAMED if self.roles[token] == "viewer" else Standing.REGISTERED

    def _forget(self, token: str) -> None:
        if not self._tokens.held(token):
            self.roles.pop(token, None)


@contextlib.asynccontextmanager
async def turn(turns: asyncio.Semaphore, what: str) -> AsyncIterator[None]:
    """Wait a moment for one of so many at once. Raises `ProblemError` (503)."""
    try:
        async with asyncio.timeout(_PATIENCE_SECONDS):
            await turns.acquire()
    except TimeoutError:
        raise ProblemError(503, "busy", f"too many {what} at once: try again", retry_after=5) from None
    try:
        yield
    finally:
        turns.release()


async def in_thread(pieces: Iterator[A]) -> AsyncIterator[A]:
    """What an iterator gives that takes its time, without the empty pieces."""
    while (piece := await asyncio.to_thread(next, pieces, None)) is not None:
        if piece:
            yield piece


class Held(Response):
    """A response that lasts: its place is given back when it is over."""

    def __init__(self, response: Response, give_back: Callable[[], None]) -> None:
        self._response = response
        self._give_back = give_back
        self.status_code = response.status_code
        self.background = response.background

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send it."""
        try:
            await self._response(scope, receive, send)
        finally:
            self._give_back()
