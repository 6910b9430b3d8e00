"""Serve the api of a standby: it knows the replicated tokens, and gets the same answers as the admin socket."""

import asyncio
import math
import sqlite3
from collections.abc import Mapping
from contextlib import closing, suppress
from pathlib import Path

import structlog

from appliance.base import clock
from appliance.channel.admin import AdminAnswer, encode
from appliance.channel.channel import Channel, ChannelFullError
from appliance.channel.link import Link
from appliance.channel.messages import Message
from appliance.channel.messages.api import (
    ConnectionAnswered,
    ConnectionPassed,
    RequestAnswered,
    RequestMade,
    RestServed,
    TokenKept,
    TokensStated,
)
from appliance.control.operators.admin_socket import RequestHandler
from appliance.control.operators.token_orders import TOKENS, kept_by_api
from appliance.control.rest.rest_proof import RequestAuthenticator, UnprovenError
from appliance.signing.request_signing import TokenKeys
from appliance.store.access_tokens import TokenRow
from appliance.store.ends import replicated_ends

_MOST_WAITING = 64
_READ_SECONDS = 2.0
_TAKING_OVER = "the appliance is taking over: try again"
_NO_DOORS = "this appliance is the standby: open the door at the active appliance (rosrv standby status)"

_log = structlog.get_logger()


class ReplicatedTokens:
    """The tokens in the replica, read again from time to time."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._rows: dict[str, TokenRow] | None = None
        self._ends: dict[str, tuple[int, float]] = {}  # by token: its stored end, and seconds since the boot
        self._stated: object = None
        self.blocked: list[str] = []
        """The addresses that operators block."""

    @property
    def known(self) -> bool:
        return self._rows is not None

    def read(self) -> bool:
        """Read the replica; return whether the tokens or blocks for the api have changed."""
        with suppress(sqlite3.Error):  # no state yet
            with closing(sqlite3.connect(f"file:{self._path}?mode=ro", uri=True)) as connection:
                connection.execute("BEGIN")  # one snapshot: keys and tokens of the same time
                keys = {row[0]: TokenKeys(*row[1:]) for row in connection.execute("SELECT * FROM token_keys")}
                found = connection.execute("SELECT * FROM token").fetchall()
                self.blocked = [row[0] for row in connection.execute("SELECT address FROM host_block")]
                left = replicated_ends(connection, TOKENS)
            self._rows = {row[0]: TokenRow._make((*row, keys.get(row[0]))) for row in found}
            self._keep_ends(left)
            before, self._stated = self._stated, ([*map(self.usable_row, self._rows)], self.blocked)
            return before != self._stated
        return False

    def _keep_ends(self, left: Mapping[str, tuple[int, float]]) -> None:
        """Keep the earliest known time of each end: an older reading of the clocks gives a token no more time."""
        ends, now = {}, clock.since_boot()
        for name, (at, seconds) in left.items():
            earlier = self._ends.get(name)
            same = earlier is not None and earlier[0] == at
            ends[name] = at, min(now + seconds, earlier[1] if earlier is not None and same else math.inf)
        self._ends = ends

    def usable_row(self, token_id: str) -> TokenRow | None:
        row, end = (self._rows or {}).get(token_id), self._ends.get(token_id)
        lasts = row is not None and row.revoked is None and end is not None and clock.since_boot() < end[1]
        return row if lasts else None

    def usable(self) -> list[TokenKept]:
        now = clock.wall() - clock.since_boot()
        rows = filter(None, map(self.usable_row, self._rows or {}))
        return [kept_by_api(row._replace(expires=now + self._ends[row.id][1])) for row in rows]


class PassiveRest:
    """The link to the api of a standby, and the pin of its key."""

    def __init__(self, administration: RequestHandler, tokens: ReplicatedTokens) -> None:
        self._administration = administration
        self._tokens = tokens
        self._askers = RequestAuthenticator(tokens, require_proof=False)
        self._link = Link(self._received)
        self.pin = ""
        self._serving: dict[int, asyncio.Task[None]] = {}

    def attach(self, channel: Channel) -> None:
        """Until the tokens can be read, the api answers 503: the appliance is starting."""
        self._link.attach(channel)
        self._tokens.read()
        if self._tokens.known:  # with an empty list, the api would tell users that their tokens are revoked
            self._state_tokens()

    def release(self) -> Channel | None:
        for number, task in self._serving.items():
            task.cancel()
            self._answer(number, AdminAnswer(False, error=_TAKING_OVER, trouble="busy"))
        return self._link.release()

    async def run(self) -> None:
        while True:
            if await asyncio.to_thread(self._tokens.read):
                self._state_tokens()
            await asyncio.sleep(_READ_SECONDS)

    def _received(self, message: object) -> None:
        if isinstance(message, RestServed):
            self.pin = message.pin
        if isinstance(message, ConnectionPassed):
            self._send(ConnectionAnswered(message.number, 503, _NO_DOORS))
        if not isinstance(message, RequestMade):
            return  # the standby records no calls: the active appliance records its own
        if len(self._serving) >= _MOST_WAITING:
            text = "too many requests wait for the appliance: try again"
            self._answer(message.number, AdminAnswer(False, error=text, trouble="busy"))
            return
        task = asyncio.get_running_loop().create_task(self._serve(message))
        self._serving[message.number] = task
        task.add_done_callback(lambda _task: self._serving.pop(message.number, None))

    async def _serve(self, made: RequestMade) -> None:
        try:
            who = await self._askers.asker(made)
        except UnprovenError as error:
            self._answer(made.number, AdminAnswer(False, error=str(error), trouble="forbidden"))
            return
        self._answer(made.number, await self._administration.carry_out(made.request, who=who))

    def _answer(self, number: int, answer: AdminAnswer[object]) -> None:
        self._send(RequestAnswered(number, encode(answer)))

    def _state_tokens(self) -> None:
        self._send(TokensStated(self._tokens.usable(), self._tokens.blocked))

    def _send(self, message: Message) -> None:
        try:
            self._link.send(message)
        except ChannelFullError:
            self._link.close()
            _log.error("the api does not read its answers: its link is closed")
