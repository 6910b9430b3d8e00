import asyncio
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import pytest

from appliance.api.front import control as module
from appliance.api.front.access import Bearer
from appliance.api.front.control import ControlAwayError, ControlLink
from appliance.base import clock
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
    TokenUsed,
)
from tests.support.answers import example
from tests.support.heard import Heard
from tests.support.memory_channel import memory_link

pytestmark = pytest.mark.anyio


class Control:
    def __init__(self, link: ControlLink, ends: list[Channel]) -> None:
        api, self.channel = memory_link(ApiLink)
        ends += [api, self.channel]
        link.attach(api)
        self._ear = Heard(self.channel)
        self.heard = self._ear.messages

    async def until(self, count: int) -> list[Any]:
        return await self._ear.until(count)


@pytest.fixture
def tokens() -> list[TokenKept]:
    return []


@pytest.fixture
def link(tokens: list[TokenKept]) -> ControlLink:
    return ControlLink(tokens.extend, lambda: None)


@pytest.fixture
def control(link: ControlLink) -> Iterator[Callable[[], Control]]:
    ends: list[Channel] = []
    yield lambda: Control(link, ends)
    for end in ends:
        end.close()


@pytest.fixture
async def there(control: Callable[[], Control]) -> Control:
    return control()


def bearer(shown: str) -> Bearer:
    return Bearer("0", "alice", "admin", 1e12, shown)


def call(number: int) -> RestCalled:
    return RestCalled("h", "w", "GET", f"/{number}", 200, "", 1)


async def test_each_question_gets_its_own_answer(link: ControlLink, there: Control) -> None:
    asked = [asyncio.create_task(link.ask(StatusWanted(), bearer(f"who{one}"))) for one in range(3)]
    for made in reversed(await there.until(3)):
        there.channel.send(
            RequestAnswered(made.number, encode(AdminAnswer(True, example(Status, probe=made.shown))))
        )
    assert [(await one).unwrap().probe for one in asked] == ["who0", "who1", "who2"]


async def test_a_question_ends_with_the_link_or_the_timeout(
    link: ControlLink, control: Callable[[], Control]
) -> None:
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


async def test_an_order_without_an_answer_says_how_to_find_out(
    monkeypatch: pytest.MonkeyPatch, link: ControlLink, there: Control
) -> None:
    monkeypatch.setattr(module, "_GRACE_SECONDS", 0.0)
    with pytest.raises(ControlAwayError, match=r"may have taken effect; .* audit search --since 5m"):
        await link.ask(PolicyConfirm(), bearer("w"), seconds=0.01)
    dying = asyncio.create_task(link.ask(PolicyConfirm(), bearer("w")))
    await there.until(2)
    there.channel.close()
    with pytest.raises(ControlAwayError, match=r"may have taken effect; .* audit search --since 5m"):
        await dying


async def test_an_order_is_withdrawn_when_its_client_disconnects(link: ControlLink, there: Control) -> None:
    gone: asyncio.Future[None] = asyncio.get_running_loop().create_future()
    began = clock.now()
    asking = asyncio.create_task(link.ask(PolicyConfirm(), replace(bearer("w"), gone=gone), seconds=7.0))
    (made,) = await there.until(1)
    assert began + 7.0 <= made.until <= clock.now() + 7.0
    gone.set_result(None)
    assert (await there.until(2))[1] == RequestWithdrawn(made.number)
    there.channel.send(
        RequestAnswered(made.number, encode(AdminAnswer(False, error="withdrawn", trouble="busy")))
    )
    assert (await asking).error == "withdrawn"


async def test_open_questions_are_bounded(link: ControlLink, there: Control) -> None:
    asked = [asyncio.create_task(link.ask(StatusWanted(), bearer("w"), seconds=1)) for _ in range(200)]
    answers = await asyncio.gather(*asked, return_exceptions=True)
    assert all(isinstance(answer, ControlAwayError) for answer in answers)
    assert len(there.heard) == 48


async def test_calls_without_a_control_are_recorded_by_the_next(
    link: ControlLink, control: Callable[[], Control], tokens: list[TokenKept]
) -> None:
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


async def test_a_call_that_cannot_be_encoded_does_not_block_others(
    link: ControlLink, control: Callable[[], Control], tokens: list[TokenKept]
) -> None:
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


async def test_a_use_of_a_token_reaches_control(link: ControlLink, control: Callable[[], Control]) -> None:
    link.token_used("0123456789ab")
    there = control()
    link.token_used("ba9876543210")
    assert await there.until(1) == [TokenUsed("ba9876543210")]
