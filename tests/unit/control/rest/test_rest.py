import asyncio
import socket
from collections.abc import Iterator
from typing import Any

import msgspec
import pytest

from appliance.base import clock
from appliance.base.withdrawal import WithdrawnError, take_effect
from appliance.channel import messages
from appliance.channel.admin import AdminAnswer, MonitorLoad, MonitorTry, PolicyLoad, StatusWanted, decode
from appliance.channel.answers.status import Status
from appliance.channel.channel import Channel, ChannelClosedError
from appliance.channel.messages.api import (
    ApiLink,
    ClientRequest,
    RequestAnswered,
    RequestMade,
    RequestWithdrawn,
    RestCalled,
    RestServed,
    TokenKept,
    TokensStated,
    TokenUsed,
)
from appliance.channel.operations import ORDERS, AnyRequest
from appliance.control.rest.rest import RestLink, RestUses
from appliance.control.rest.rest_proof import RequestAuthenticator
from appliance.store.access_tokens import TokenRow, make_token
from tests.support.answers import example
from tests.support.core import FakeTrail
from tests.support.heard import Heard
from tests.support.memory_channel import memory_link

pytestmark = pytest.mark.anyio

VIEWER, VIEWER_TOKEN = make_token("alice", "viewer", now=0.0, seconds=1e10)
ADMIN, TOKEN = make_token("w", "admin", now=0.0, seconds=1e10)


def kept(row: TokenRow) -> TokenKept:
    assert row.keys is not None
    return TokenKept(row.id, row.name, row.role, row.salt, row.hash, row.expires, row.keys.reading)


def loading(number: int, text: str, shown: str = TOKEN) -> RequestMade:
    asked = ClientRequest("10.0.0.1", "POST", "/v1/policy", "*", "text/plain", "", text.encode())
    return RequestMade(number, PolicyLoad(text), shown, asked)


class Everything:
    def __init__(self) -> None:
        self.asked: list[tuple[AnyRequest, str]] = []
        self.trail = FakeTrail()
        self.ends: list[Channel] = []  # closed after the run
        self.uses: list[str] = []
        self.only_slow = False  # whether only requests other than the status wait for `go`
        self.go = asyncio.Event()
        self.go.set()

    async def carry_out(self, request: AnyRequest, *, who: str) -> AdminAnswer[Any]:
        if not isinstance(request, StatusWanted) or not self.only_slow:
            await self.go.wait()
        try:
            take_effect()
        except WithdrawnError as error:
            return AdminAnswer(False, error=str(error), trouble="busy")
        self.asked.append((request, who))
        if isinstance(request, PolicyLoad) and request.text == "defect":
            raise RuntimeError("secret detail")
        return AdminAnswer(True, example(Status, nodes=len(self.asked)))

    def usable(self) -> list[TokenKept]:
        return [kept(VIEWER), kept(ADMIN)]

    def ended(self) -> list[TokenKept]:
        return []

    def usable_row(self, token_id: str) -> TokenRow | None:
        return {VIEWER.id: VIEWER, ADMIN.id: ADMIN}.get(token_id)

    def used(self, token_id: str) -> None:
        self.uses.append(token_id)


class Api:
    def __init__(self, world: Everything, link: RestLink) -> None:
        control, self.channel = memory_link(ApiLink)
        self.closed = asyncio.Event()
        link.attach(control)
        self._ear = Heard(self.channel, self.closed.set)
        self.heard = self._ear.messages

    async def until(self, count: int) -> list[Any]:
        return await self._ear.until(count)


@pytest.fixture
def pins() -> list[str]:
    return []


@pytest.fixture
def world() -> Iterator[Everything]:
    world = Everything()
    yield world
    for end in world.ends:
        end.close()


@pytest.fixture
def link(world: Everything, pins: list[str]) -> RestLink:
    parts: Any = world  # the administration and the tokens
    return RestLink(
        parts,
        parts,
        world.trail,
        served=pins.append,
        certified=lambda _sha256: None,
        require_proof=False,
        uses=RestUses(),
    )


@pytest.fixture
async def api(world: Everything, link: RestLink) -> Api:
    return Api(world, link)


def answer_of(message: RequestAnswered) -> AdminAnswer[Status]:
    return decode(message.answer, StatusWanted())


async def test_tokens_are_sent_at_once_and_after_every_change(link: RestLink, api: Api) -> None:
    assert await api.until(1) == [TokensStated([kept(VIEWER), kept(ADMIN)])]
    link.state_tokens()
    assert len(await api.until(2)) == 2


async def test_requests_that_wait_block_no_other_requests(world: Everything, api: Api) -> None:
    world.only_slow = True
    world.go.clear()
    for number in range(20):
        api.channel.send(RequestMade(number, MonitorTry(MonitorLoad({f"{number}.rv": ""})), TOKEN))
    api.channel.send(RequestMade(99, StatusWanted(), TOKEN))
    heard = (await api.until(6))[1:]
    assert [answer_of(one).trouble for one in heard if one.number != 99] == ["busy"] * 4
    assert [answer_of(one).ok for one in heard if one.number == 99] == [True]
    world.go.set()
    assert sum(answer_of(one).ok for one in (await api.until(22))[1:]) == 17


@pytest.mark.parametrize("kind", sorted(ORDERS, key=str))
async def test_no_order_waits_for_questions_and_blocks_other_requests(
    kind: type[Any], world: Everything, link: RestLink, api: Api, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Viewers look at topics for as long as they like. Orders wait for relays, of which one may hang, for the compiler
    or for charon, and all for the audit log.
    """
    monkeypatch.setattr(RequestAuthenticator, "asker", _is_admin)
    world.only_slow = True
    world.go.clear()
    order = kind(**{field.name: None for field in msgspec.structs.fields(kind) if field.required})
    for number in range(16):
        link._on_message(RequestMade(number, MonitorTry(MonitorLoad({f"{number}.rv": ""})), TOKEN))
    link._on_message(RequestMade(16, order, TOKEN))
    link._on_message(RequestMade(17, StatusWanted(), TOKEN))
    assert [one.number for one in (await api.until(2))[1:]] == [17]
    world.go.set()
    answers = {one.number: answer_of(one).trouble for one in (await api.until(19))[1:]}
    assert answers == dict.fromkeys(range(18), "")


async def _is_admin(_authenticator: RequestAuthenticator, _made: RequestMade) -> str:
    return "w"


async def test_the_pin_of_the_api_is_passed_on(link: RestLink, api: Api, pins: list[str]) -> None:
    pin = "sha256//" + "A" * 43 + "="
    api.channel.send(RestServed(pin))
    api.channel.send(RequestMade(1, StatusWanted(), TOKEN))
    await api.until(2)
    assert pins == [pin]
    api.channel.send(RestServed("$(reboot)"))
    async with asyncio.timeout(20):
        await api.closed.wait()
    assert pins == [pin]


async def test_answers_are_in_order_with_their_numbers(world: Everything, api: Api) -> None:
    for number in (7, 3, 9):
        api.channel.send(RequestMade(number, StatusWanted(), VIEWER_TOKEN if number == 3 else TOKEN))
    heard = await api.until(4)
    assert [one.number for one in heard[1:]] == [7, 3, 9]
    assert [answer_of(one).unwrap().nodes for one in heard[1:]] == [1, 2, 3]
    assert [who for _request, who in world.asked] == ["w", "alice", "w"]


async def test_a_flood_is_answered_busy_at_once(world: Everything, api: Api) -> None:
    world.go.clear()
    for number in range(200):
        api.channel.send(RequestMade(number, StatusWanted(), TOKEN))
    heard = await api.until(1 + 200 - 65)
    assert {answer_of(one).trouble for one in heard[1:]} == {"busy"}
    world.go.set()
    heard = await api.until(201)
    assert sum(answer_of(one).ok for one in heard[1:]) == len(world.asked) <= 65


async def test_abandoned_orders_do_not_take_effect(world: Everything, api: Api, pins: list[str]) -> None:
    world.go.clear()
    api.channel.send(loading(1, "answered"))
    api.channel.send(msgspec.structs.replace(loading(2, "late"), until=clock.now() - 1.0))
    api.channel.send(loading(3, "gone"))
    api.channel.send(RequestWithdrawn(3))
    api.channel.send(RequestWithdrawn(77))
    api.channel.send(RequestMade(4, StatusWanted(), "nobody's"))
    api.channel.send(RestServed("sha256//" + "A" * 43 + "="))
    async with asyncio.timeout(20):
        while not pins:  # the last message: the others are read as well
            await asyncio.sleep(0)
    world.go.set()
    heard = {one.number: answer_of(one) for one in (await api.until(5))[1:]}
    assert [heard[number].trouble for number in (1, 2, 3)] == ["", "busy", "busy"]
    assert "nothing was changed" in heard[2].error
    assert [request.text for request, _who in world.asked if isinstance(request, PolicyLoad)] == ["answered"]


async def test_a_defect_costs_one_answer(api: Api) -> None:
    api.channel.send(loading(1, "defect"))
    api.channel.send(RequestMade(2, StatusWanted(), TOKEN))
    _tokens, failed, served = await api.until(3)
    assert (answer_of(failed).ok, answer_of(failed).trouble) == (False, "failed")
    assert "secret" not in answer_of(failed).error
    assert answer_of(served).ok


async def test_a_change_with_a_wrong_name_is_refused(world: Everything, api: Api) -> None:
    for number, shown in enumerate(("operator", "disk", "", VIEWER_TOKEN)):
        api.channel.send(loading(number, "[Nodes]", shown))
    api.channel.send(RequestMade(8, StatusWanted(), VIEWER_TOKEN))
    api.channel.send(loading(9, "[Nodes]"))
    answers = (await api.until(7))[1:]
    assert [answer_of(answer).trouble for answer in answers] == ["forbidden"] * 4 + ["", ""]
    assert [who for _request, who in world.asked] == ["alice", "w"]


async def test_invalid_messages_end_the_link(world: Everything, link: RestLink) -> None:
    token = {"message": "RequestMade", "number": 1, "shown": TOKEN, "request": {"verb": "token add"}}
    for body in (
        msgspec.msgpack.encode(token),
        msgspec.msgpack.encode(messages.Stop()),
        b"\xc1nonsense",
        msgspec.msgpack.encode(TokensStated([])),
    ):
        api = Api(world, link)
        await api.until(1)
        api.channel.send_raw(body)
        async with asyncio.timeout(20):
            await api.closed.wait()
    assert world.asked == []
    api = Api(world, link)
    api.channel.send(RequestMade(1, StatusWanted(), TOKEN))
    assert answer_of((await api.until(2))[1]).ok


async def test_a_new_api_does_not_wait_for_the_old_ones_request(world: Everything, link: RestLink) -> None:
    world.go.clear()
    first = Api(world, link)
    for number in range(3):
        first.channel.send(RequestMade(number, StatusWanted(), VIEWER_TOKEN))
    await first.until(1)
    first.channel.close()
    second = Api(world, link)
    second.channel.send(RequestMade(9, StatusWanted(), TOKEN))
    await second.until(1)
    world.go.set()
    assert (await second.until(2))[1].number == 9
    assert [who for _request, who in world.asked].count("alice") <= 1


@pytest.mark.nightly
async def test_an_api_that_does_not_read_loses_its_link(world: Everything, link: RestLink) -> None:
    here, there = socket.socketpair()
    control = Channel(here, ApiLink, limit=100_000)
    link.attach(control)
    for _ in range(5000):
        link.state_tokens()
    peer = Channel(there, ApiLink)
    world.ends += [control, peer]
    heard = 0
    async with asyncio.timeout(20):
        while True:
            try:
                heard += len(peer.receive())
            except ChannelClosedError:
                break
            await asyncio.sleep(0)
    assert 0 < heard < 5000


async def test_calls_are_recorded_with_their_outcome(world: Everything, api: Api) -> None:
    api.channel.send(RestCalled("10.0.0.1", "alice", "GET", "/v1/policy", 200, "", 12))
    api.channel.send(RestCalled("10.0.0.2", "", "GET", "/" + "x" * 5000, 401, "no token", 5, 3))
    api.channel.send(RequestMade(1, StatusWanted(), TOKEN))
    await api.until(2)
    served, refused = world.trail.rows
    assert (served["event"], served["decision"], served["who"]) == ("rest call", "allow", "alice")
    assert (refused["decision"], refused["who"], refused["count"]) == ("deny", None, 3)
    assert len(refused["resource"]) <= 300


async def test_uses_of_tokens_are_not_recorded(world: Everything, api: Api) -> None:
    api.channel.send(TokenUsed(VIEWER.id))
    api.channel.send(RequestMade(1, StatusWanted(), TOKEN))
    await api.until(2)
    assert (world.uses, world.trail.rows) == ([VIEWER.id], [])
