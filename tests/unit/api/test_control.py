"""Tests of `appliance.api.control` over a real link."""

import asyncio
import socket
import time
from collections.abc import Awaitable, Callable
from dataclasses import replace
from typing import Any

import pytest

from appliance.api import control as module
from appliance.api.access import Bearer
from appliance.api.control import ControlAwayError, ControlLink
from appliance.channel.admin import AdminAnswer, PolicyConfirm, StatusWanted, encode
from appliance.channel.answers.status import Status
from appliance.channel.channel import Channel
from appliance.channel.messages.api import (
    ApiLink,
    RequestAnswered,
    RequestWithdrawn,
    RestCalled,
    TokenKept,
    TokensStated,
)
from tests.support.answers import example
from tests.support.heard import Heard


class Control:
    """Control's end: hears, and answers when told to."""

    def __init__(self, link: ControlLink, ends: list[Channel]) -> None:
        here, there = socket.socketpair()
        api, self.channel = Channel(here, ApiLink), Channel(there, ApiLink)
        ends += [api, self.channel]
        link.attach(api)
        self._ear = Heard(self.channel)
        self.heard = self._ear.messages

    async def until(self, count: int) -> list[Any]:
        """What was heard, once it is so much."""
        return await self._ear.until(count)


def run(play: Callable[[ControlLink, Callable[[], Control], list[TokenKept]], Awaitable[None]]) -> None:
    """Play one conversation; `play` gets the link, a way to make a control, and the tokens that were heard."""

    async def whole() -> None:
        ends: list[Channel] = []
        tokens: list[TokenKept] = []
        link = ControlLink(tokens.extend, lambda: None)
        try:
            await play(link, lambda: Control(link, ends), tokens)
        finally:
            for end in ends:
                end.close()

    asyncio.run(whole())


def bearer(shown: str) -> Bearer:
    """Somebody who showed this."""
    return Bearer("0", "alice", "admin", 1e12, shown)


def call(number: int) -> RestCalled:
    """A call to be recorded."""
    return RestCalled("h", "w", "GET", f"/{number}", 200, "", 1)


def test_each_question_gets_its_own_answer() -> None:
    """Answers that come in another order are paired by number."""

    async def play(link: ControlLink, control: Callable[[], Control], _tokens: list[TokenKept]) -> None:
        there = control()
        asked = [asyncio.create_task(link.ask(StatusWanted(), bearer(f"who{one}"))) for one in range(3)]
        for made in reversed(await there.until(3)):
            there.channel.send(
                RequestAnswered(made.number, encode(AdminAnswer(True, example(Status, probe=made.shown))))
            )
        assert [(await one).given().probe for one in asked] == ["who0", "who1", "who2"]

    run(play)


def test_a_question_ends_with_the_link_or_in_time() -> None:
    """Without a control, with one that dies, is replaced or is silent, the asker is told; nothing waits for ever."""

    async def play(link: ControlLink, control: Callable[[], Control], _tokens: list[TokenKept]) -> None:
        with pytest.raises(ControlAwayError, match="restarted"):
            await link.ask(StatusWanted(), bearer("w"))
        there = control()
        with pytest.raises(ControlAwayError, match=r"within 0\.01 s"):
            await link.ask(StatusWanted(), bearer("w"), seconds=0.01)
        dying = asyncio.create_task(link.ask(StatusWanted(), bearer("w")))
        await there.until(2)
        there.channel.close()
        with pytest.raises(ControlAwayError, match="restarted before it answered: try again"):
            await dying
        there = control()
        replaced = asyncio.create_task(link.ask(StatusWanted(), bearer("w")))
        await there.until(1)
        control()
        with pytest.raises(ControlAwayError):
            await replaced

    run(play)


def test_an_order_without_an_answer_says_how_to_find_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """A silent or dying control may have carried an order out: the answer says so, and names the command."""
    monkeypatch.setattr(module, "_GRACE_SECONDS", 0.0)

    async def play(link: ControlLink, control: Callable[[], Control], _tokens: list[TokenKept]) -> None:
        there = control()
        with pytest.raises(ControlAwayError, match=r"may have taken effect; .* audit search --since 5m"):
            await link.ask(PolicyConfirm(), bearer("w"), seconds=0.01)
        dying = asyncio.create_task(link.ask(PolicyConfirm(), bearer("w")))
        await there.until(2)
        there.channel.close()
        with pytest.raises(ControlAwayError, match=r"may have taken effect; .* audit search --since 5m"):
            await dying

    run(play)


def test_an_order_is_withdrawn_when_its_client_is_gone() -> None:
    """Control hears at once that a client disconnected, and until when the order may take effect."""

    async def play(link: ControlLink, control: Callable[[], Control], _tokens: list[TokenKept]) -> None:
        there = control()
        gone: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        began = time.monotonic()
        asking = asyncio.create_task(link.ask(PolicyConfirm(), replace(bearer("w"), gone=gone), seconds=7.0))
        (made,) = await there.until(1)
        assert began + 7.0 <= made.until <= time.monotonic() + 7.0
        gone.set_result(None)
        assert (await there.until(2))[1] == RequestWithdrawn(made.number)
        there.channel.send(
            RequestAnswered(made.number, encode(AdminAnswer(False, error="withdrawn", trouble="busy")))
        )
        assert (await asking).error == "withdrawn"

    run(play)


def test_open_questions_are_bounded() -> None:
    """A flood of questions costs a silent control no more than so many."""

    async def play(link: ControlLink, control: Callable[[], Control], _tokens: list[TokenKept]) -> None:
        there = control()
        asked = [asyncio.create_task(link.ask(StatusWanted(), bearer("w"), seconds=1)) for _ in range(200)]
        answers = await asyncio.gather(*asked, return_exceptions=True)
        assert all(isinstance(one, ControlAwayError) for one in answers)
        assert len(there.heard) == 48

    run(play)


def test_what_happened_meanwhile_is_told_to_the_next_control() -> None:
    """Calls answered while control was away are recorded when it is back, in order; the oldest go when too many."""

    async def play(link: ControlLink, control: Callable[[], Control], tokens: list[TokenKept]) -> None:
        for number in range(1100):
            link.tell(call(number))
        there = control()
        assert not link.connected
        token = TokenKept("0123456789ab", "a", "viewer", b"", b"", 1.0)
        there.channel.send(TokensStated([token]))
        heard = await there.until(1000)
        assert [one.path for one in heard] == [f"/{number}" for number in range(100, 1100)]
        assert tokens == [token]
        assert link.connected

    run(play)


def test_what_cannot_be_told_keeps_nothing_else_from_being_told() -> None:
    """A call whose text no message can hold is left out; tokens are known, and the calls after it are told."""

    async def play(link: ControlLink, control: Callable[[], Control], tokens: list[TokenKept]) -> None:
        link.tell(call(1))
        link.tell(RestCalled("h", "w", "GET", "/\ud800", 200, "", 1))
        link.tell(call(2))
        there = control()
        token = TokenKept("0123456789ab", "a", "viewer", b"", b"", 1.0)
        there.channel.send(TokensStated([token]))
        assert [one.path for one in await there.until(2)] == ["/1", "/2"]
        assert tokens == [token]
        link.tell(call(3))
        assert [one.path for one in await there.until(3)][-1] == "/3"

    run(play)
