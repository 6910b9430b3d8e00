"""Control's answers to a compromised api, which is simulated at its end of the link.

The link, the tokens, their keys and the proofs are control's own code. Orders are only recorded.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from appliance.audit.log.record import Severity
from appliance.channel import admin
from appliance.channel.admin import A, AdminAnswer, AdminRequest, TokenAdd, TokenRevoke, decode
from appliance.channel.messages.api import ApiLink, ClientRequest, RequestAnswered, RequestMade
from appliance.channel.operations import AnyRequest
from appliance.control.operators.token_orders import TokenOrders
from appliance.control.rest.rest import RestLink, RestUses
from appliance.signing.request_signing import proof_of, reading_key, statement
from tests.support.core import Core
from tests.support.heard import Heard
from tests.support.memory_channel import memory_link

pytestmark = pytest.mark.anyio

REMOVE = ClientRequest("10.0.0.1", "DELETE", "/v1/monitors/laptop", '"3"', "", "", b"")
LOAD = ClientRequest("10.0.0.1", "POST", "/v1/policy", '"3"', "text/plain", "", b"[Nodes]\n")


class World:
    def __init__(self, directory: Path) -> None:
        self.core = Core(directory)
        self.trail = self.core.trail
        self.done: list[tuple[AnyRequest, str]] = []
        self.apis: list[Api] = []
        self.tokens = TokenOrders(self.core.store, self.trail, self.core.ends, self.token_changed)
        self.begin(require_proof=False)

    def begin(self, *, require_proof: bool) -> None:
        self.tokens = TokenOrders(self.core.store, self.trail, self.core.ends, self.token_changed)
        parts: Any = self
        self.link = RestLink(
            parts,
            self.tokens,
            self.trail,
            served=print,
            certified=print,
            require_proof=require_proof,
            uses=RestUses(),
        )

    def token_changed(self) -> None: ...

    async def carry_out(self, request: AnyRequest, *, who: str) -> AdminAnswer[Any]:
        self.done.append((request, who))
        return AdminAnswer(True)

    @property
    def refusals(self) -> list[dict[str, Any]]:
        return [row for row in self.trail.rows if row["event"] == "order refused"]


class Api:
    def __init__(self, world: World) -> None:
        self.channel, self.control = memory_link(ApiLink)
        world.link.attach(self.control)
        self._ear = Heard(self.channel)
        self._answers = 0
        world.apis.append(self)

    async def ask(
        self, request: AdminRequest[A], shown: str = "", asked: ClientRequest | None = None
    ) -> AdminAnswer[A]:
        self._answers += 1
        self.channel.send(RequestMade(self._answers, request, shown, asked))
        while True:
            for one in await self._ear.until(len(self._ear.messages)):
                if isinstance(one, RequestAnswered) and one.number == self._answers:
                    return decode(one.answer, request)
            await self._ear.until(len(self._ear.messages) + 1)

    async def signed(self, token: str, asked: ClientRequest) -> ClientRequest:
        answer = await self.ask(admin.ChallengeWanted(), reading_key(token))
        challenge = answer.unwrap().challenge
        stated = statement(
            challenge,
            method=asked.method,
            target=asked.target,
            if_match=asked.if_match,
            content_type=asked.content_type,
            body=asked.body,
        )
        return msgspec.structs.replace(asked, proof=proof_of(token, challenge, stated))

    def close(self) -> None:
        self.channel.close()
        self.control.close()


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    world = World(tmp_path)
    yield world
    for api in world.apis:
        api.close()
    world.core.store.close()


@pytest.fixture
async def token(world: World) -> str:
    return (await world.tokens.add(TokenAdd("alice", "admin", 600))).token


@pytest.fixture
async def api(world: World, token: str) -> Api:
    return Api(world)


async def test_public_data_of_a_token_opens_nothing(world: World) -> None:
    row = await world.tokens.add(TokenAdd("alice", "admin", 600))
    api = Api(world)
    [kept] = world.tokens.usable()
    guesses = ["", "alice", row.id, f"rosrv_{row.id}_{'A' * 43}", f"rosrv-read_{row.id}_{'A' * 43}"]
    guesses += [kept.hash.hex(), kept.reading.hex(), f"rosrv-read_{row.id}_{kept.reading.hex()[:43]}"]
    for shown in guesses:
        requests: tuple[tuple[AdminRequest[Any], ClientRequest | None], ...] = (
            (admin.MonitorRemove(["laptop"], "3"), REMOVE),
            (admin.PolicyWanted(), None),
            (admin.ChallengeWanted(), None),
            (admin.TokenList(), None),
        )
        for request, asked in requests:
            answer = await api.ask(request, shown, asked)
            assert (answer.ok, answer.trouble) == (False, "forbidden")
    assert world.done == []
    assert len(world.refusals) == len(guesses) * 4
    assert {refusal["decision"] for refusal in world.refusals} == {"deny"}


async def test_a_signed_order_is_carried_out_unchanged(world: World, token: str, api: Api) -> None:
    answer = await api.ask(
        admin.MonitorRemove(["laptop"], "3"), reading_key(token), await api.signed(token, REMOVE)
    )
    assert answer.ok
    assert world.done == [(admin.MonitorRemove(["laptop"], "3"), "alice")]
    assert world.refusals == []


async def test_a_signed_order_is_valid_once(world: World, token: str) -> None:
    shown = reading_key(token)
    api = Api(world)
    kept_back = await api.signed(token, REMOVE)
    seen = await api.signed(token, REMOVE)
    order = admin.MonitorRemove(["laptop"], "3")
    assert (await api.ask(order, shown, seen)).ok
    again = await api.ask(order, shown, seen)
    assert "already used" in again.error
    api.close()
    api = Api(world)
    assert "already used" in (await api.ask(order, shown, seen)).error
    api.close()
    await world.core.store.until_settled()
    world.begin(require_proof=False)
    api = Api(world)
    for old in (seen, kept_back):
        assert "has not issued this challenge since it started" in (await api.ask(order, shown, old)).error
    assert len(world.done) == 1
    assert [refusal["who"] for refusal in world.refusals] == ["alice"] * 4


@pytest.mark.parametrize(
    "change",
    [
        {"method": "PUT"}, {"target": "/v1/monitors/laptoq"}, {"target": "/v1/monitors/laptop?x=1"}, {"if_match": "*"},
        {"if_match": '"4"'}, {"content_type": "text/plain"}, {"body": b"\x00"}, {"target": "/v1/monitors/laptop\n"},
    ],
)  # fmt: skip
async def test_no_byte_of_an_order_can_change(
    change: dict[str, Any], world: World, token: str, api: Api
) -> None:
    forged = msgspec.structs.replace(await api.signed(token, REMOVE), **change)
    for order in (
        admin.MonitorRemove(["laptop"], "3"),
        admin.MonitorRemove(["laptoq"], "3"),
        admin.MonitorRemove(["laptop"]),
    ):
        assert (await api.ask(order, reading_key(token), forged)).trouble == "forbidden"
    assert world.done == []
    assert len(world.refusals) == 3


@pytest.mark.parametrize(
    "order",
    [
        admin.MonitorRemove(["robot"], "3"), admin.MonitorRemove(["laptop"]), admin.TokenRevoke("bob"),
        admin.PolicyLoad("[Topics]\n* = *\n"), admin.PolicyRollback(1),
    ],
)  # fmt: skip
async def test_another_order_under_a_valid_proof_is_an_alarm(
    order: AdminRequest[Any], world: World, token: str, api: Api
) -> None:
    signed = await api.signed(token, REMOVE)
    assert (await api.ask(order, reading_key(token), signed)).trouble == "forbidden"
    bare = msgspec.structs.replace(REMOVE, proof="")
    assert (await api.ask(order, token, bare)).trouble == "forbidden"
    assert (await api.ask(order, token, None)).trouble == "forbidden"
    assert world.done == []
    assert [refusal["severity"] for refusal in world.refusals] == [Severity.ALARM] * 3
    assert {refusal["verb"] for refusal in world.refusals} == {admin.verb_of(order)}


async def test_a_proof_is_valid_for_its_signer_only(world: World) -> None:
    alice = (await world.tokens.add(TokenAdd("alice", "admin", 600))).token
    bob = (await world.tokens.add(TokenAdd("bob", "operator", 600))).token
    api = Api(world)
    by_bob = await api.signed(bob, REMOVE)
    order = admin.MonitorRemove(["laptop"], "3")
    assert "another request was signed" in (await api.ask(order, reading_key(alice), by_bob)).error
    assert "this is for admins" in (await api.ask(order, reading_key(bob), by_bob)).error
    assert world.done == []
    assert [refusal["who"] for refusal in world.refusals] == ["alice", "bob"]


async def test_orders_of_a_revoked_token_are_refused(world: World, token: str, api: Api) -> None:
    kept_back = await api.signed(token, REMOVE)
    await world.tokens.revoke(TokenRevoke("alice"))
    for shown in (reading_key(token), token):
        answer = await api.ask(admin.MonitorRemove(["laptop"], "3"), shown, kept_back)
        assert (answer.ok, answer.trouble) == (False, "forbidden")
        assert not (await api.ask(admin.PolicyWanted(), shown)).ok
    assert world.done == []
    assert len(world.refusals) == 4


async def test_a_reading_key_changes_nothing(world: World, token: str, api: Api) -> None:
    assert (await api.ask(admin.PolicyWanted(), reading_key(token))).ok
    refused = await api.ask(admin.PolicyLoad("[Nodes]\n", expected=3), reading_key(token), LOAD)
    assert "needs its proof" in refused.error
    assert [request for request, _who in world.done] == [admin.PolicyWanted()]
    assert len(world.refusals) == 1


@pytest.mark.parametrize("require_proof", [False, True])
async def test_bare_tokens_are_accepted_by_configuration_only(
    world: World, token: str, *, require_proof: bool
) -> None:
    """With `api_require_proof`, a bare token still opens the views."""
    await world.core.store.until_settled()
    world.begin(require_proof=require_proof)
    api = Api(world)
    order = admin.PolicyLoad("[Nodes]\n", expected=3)
    answer = await api.ask(order, token, LOAD)
    assert answer.ok is not require_proof
    assert ("api_require_proof" in answer.error) is require_proof
    assert (await api.ask(admin.PolicyWanted(), token)).ok
    assert (await api.ask(order, reading_key(token), await api.signed(token, LOAD))).ok
    assert len(world.refusals) == require_proof


async def test_a_token_of_an_earlier_version_stays_valid(world: World) -> None:
    row = await world.tokens.add(TokenAdd("alice", "admin", 600))
    token = row.token
    world.core.store.database.delete("token_keys", id=row.id)
    await world.core.store.until_settled()
    world.begin(require_proof=False)
    api = Api(world)
    order = admin.PolicyLoad("[Nodes]\n", expected=3)
    assert (await api.ask(order, token, LOAD)).ok
    assert not (await api.ask(order, token[:-1] + ("A" if token[-1] != "A" else "B"), LOAD)).ok
    assert not (await api.ask(admin.PolicyWanted(), reading_key(token))).ok
    assert (
        "create another one"
        in (await api.ask(order, token, msgspec.structs.replace(LOAD, proof="x y"))).error
    )
