"""An api that fell to a stranger, played over its link: what it may say to control, and what comes of it.

Control's own parts are real: the link, the tokens, their keys, the proofs. Noted is what would have been carried out.
"""

import asyncio
import socket
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

from appliance.audit.record import Severity
from appliance.channel import admin
from appliance.channel.admin import A, AdminAnswer, AdminRequest, AnyRequest, TokenAdd, TokenRevoke, decode
from appliance.channel.channel import Channel
from appliance.channel.messages.api import ApiLink, Asked, RequestAnswered, RequestMade
from appliance.control.rest import RestLink
from appliance.control.token_orders import Tokens
from appliance.signing.request_signing import proof_of, reading_key, statement
from appliance.store.state_file import StateStore
from tests.support.heard import Heard

REVOKE = Asked("10.0.0.1", "DELETE", "/v1/hosts/laptop", '"3"', "", "", b"")
LOAD = Asked("10.0.0.1", "POST", "/v1/policy", '"3"', "text/plain", "", b"[Nodes]\n")


class World:
    """What control works with: notes what it is told to do and to record."""

    def __init__(self, directory: Path) -> None:
        self.store = StateStore(directory, failed=lambda _text: None)
        self.done: list[tuple[AnyRequest, str]] = []
        self.recorded: list[dict[str, Any]] = []
        self.obstacle: str | None = None
        self.tokens = Tokens(self.store, self, self.token_changed)  # type: ignore[arg-type]  # stands in for the trail
        self.begin(require_proof=False)

    def begin(self, *, require_proof: bool) -> None:
        """A new life of control, with the tokens it kept."""
        self.tokens = Tokens(self.store, self, self.token_changed)  # type: ignore[arg-type]  # as above
        self.link = RestLink(self, self.tokens, self, served=print, require_proof=require_proof)  # type: ignore[arg-type]  # as above

    def token_changed(self) -> None:
        """Nobody is told."""

    async def carry_out(self, request: AnyRequest, *, who: str) -> AdminAnswer[Any]:
        """Note what would be done."""
        self.done.append((request, who))
        return AdminAnswer(True)

    def happened(self, event: str, reason: str, **fields: Any) -> str:
        """Note a record."""
        self.recorded.append({"event": event, "reason": reason, **fields})
        return "id"

    @property
    def refusals(self) -> list[dict[str, Any]]:
        """The records of refused orders."""
        return [one for one in self.recorded if one["event"] == "order refused"]


class Api:
    """The api's end of the link: says whatever it likes."""

    def __init__(self, world: World) -> None:
        here, there = socket.socketpair()
        self.channel, self.control = Channel(there, ApiLink), Channel(here, ApiLink)
        world.link.attach(self.control)
        self._ear = Heard(self.channel)
        self._answers = 0

    async def ask(
        self, request: AdminRequest[A], shown: str = "", asked: Asked | None = None
    ) -> AdminAnswer[A]:
        """Control's answer."""
        self._answers += 1
        self.channel.send(RequestMade(self._answers, request, shown, asked))
        while True:
            for one in await self._ear.until(len(self._ear.messages)):
                if isinstance(one, RequestAnswered) and one.number == self._answers:
                    return decode(one.answer, request)
            await self._ear.until(len(self._ear.messages) + 1)

    async def signed(self, token: str, asked: Asked) -> Asked:
        """What the holder of a token, who is honest, sends of an order."""
        answer = await self.ask(admin.ChallengeWanted(), reading_key(token))
        challenge = answer.given().challenge
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
        """End both ends."""
        self.channel.close()
        self.control.close()


def play(directory: Path, story: Callable[[World], Awaitable[None]]) -> None:
    """Play one story."""

    async def whole() -> None:
        world = World(directory)
        try:
            await story(world)
        finally:
            world.store.close()

    asyncio.run(whole())


def test_nothing_is_done_for_a_name(tmp_path: Path) -> None:
    """What an api has of tokens that it was not shown, names, ids, hashes and salts, orders and reads nothing."""

    async def story(world: World) -> None:
        row = await world.tokens.add(TokenAdd("alice", "admin", 600))
        api = Api(world)
        [kept] = world.tokens.usable()
        guesses = ["", "alice", row.id, f"rosrv_{row.id}_{'A' * 43}", f"rosrv-read_{row.id}_{'A' * 43}"]
        guesses += [kept.hash.hex(), kept.reading.hex(), f"rosrv-read_{row.id}_{kept.reading.hex()[:43]}"]
        for shown in guesses:
            requests: tuple[tuple[AdminRequest[Any], Asked | None], ...] = (
                (admin.HostRevoke("laptop", 3), REVOKE),
                (admin.PolicyWanted(), None),
                (admin.ChallengeWanted(), None),
                (admin.TokenList(), None),
            )
            for request, asked in requests:
                answer = await api.ask(request, shown, asked)
                assert (answer.ok, answer.trouble) == (False, "forbidden")
        assert world.done == []
        assert len(world.refusals) == len(guesses) * 4
        assert {one["decision"] for one in world.refusals} == {"deny"}
        api.close()

    play(tmp_path, story)


def test_a_signed_order_is_carried_out_as_it_is(tmp_path: Path) -> None:
    """What the holder signed is done once, in his name."""

    async def story(world: World) -> None:
        token = (await world.tokens.add(TokenAdd("alice", "admin", 600))).token
        api = Api(world)
        answer = await api.ask(
            admin.HostRevoke("laptop", 3), reading_key(token), await api.signed(token, REVOKE)
        )
        assert answer.ok
        assert world.done == [(admin.HostRevoke("laptop", 3), "alice")]
        assert world.refusals == []
        api.close()

    play(tmp_path, story)


def test_a_seen_order_is_good_once(tmp_path: Path) -> None:
    """Sent again at once, over a new link or to a new life of control: refused each time, and recorded."""

    async def story(world: World) -> None:
        token = (await world.tokens.add(TokenAdd("alice", "admin", 600))).token
        shown = reading_key(token)
        api = Api(world)
        kept_back = await api.signed(token, REVOKE)
        seen = await api.signed(token, REVOKE)
        order = admin.HostRevoke("laptop", 3)
        assert (await api.ask(order, shown, seen)).ok
        again = await api.ask(order, shown, seen)
        assert "used already" in again.error
        api.close()
        api = Api(world)
        assert "used already" in (await api.ask(order, shown, seen)).error
        api.close()
        await world.store.settled()
        world.begin(require_proof=False)
        api = Api(world)
        for old in (seen, kept_back):
            assert "none that RVMaster gave since it started" in (await api.ask(order, shown, old)).error
        assert len(world.done) == 1
        assert [one["who"] for one in world.refusals] == ["alice"] * 4
        api.close()

    play(tmp_path, story)


@pytest.mark.parametrize(
    "change",
    [
        {"method": "PUT"}, {"target": "/v1/hosts/laptoq"}, {"target": "/v1/hosts/laptop?x=1"}, {"if_match": "*"},
        {"if_match": '"4"'}, {"content_type": "text/plain"}, {"body": b"\x00"}, {"target": "/v1/hosts/laptop\n"},
    ],
)  # fmt: skip
def test_no_byte_of_an_order_can_be_another(tmp_path: Path, change: dict[str, Any]) -> None:
    """A request that is not byte for byte the signed one is refused, whatever order is passed on with it."""

    async def story(world: World) -> None:
        token = (await world.tokens.add(TokenAdd("alice", "admin", 600))).token
        api = Api(world)
        forged = msgspec.structs.replace(await api.signed(token, REVOKE), **change)
        for order in (
            admin.HostRevoke("laptop", 3),
            admin.HostRevoke("laptoq", 3),
            admin.HostRevoke("laptop"),
        ):
            assert (await api.ask(order, reading_key(token), forged)).trouble == "forbidden"
        assert world.done == []
        assert len(world.refusals) == 3
        api.close()

    play(tmp_path, story)


@pytest.mark.parametrize(
    "order",
    [
        admin.HostRevoke("robot", 3), admin.HostRevoke("laptop", None), admin.TokenRevoke("bob"),
        admin.PolicyLoad("[Topics]\n* = *\n"), admin.PolicyRollback(1), admin.MonitorRemove(["safeZone"]),
    ],
)  # fmt: skip
def test_another_order_under_a_good_proof_is_an_alarm(tmp_path: Path, order: AdminRequest[Any]) -> None:
    """The proof holds for the request, not for what the api makes of it; only an api that fell does this."""

    async def story(world: World) -> None:
        token = (await world.tokens.add(TokenAdd("alice", "admin", 600))).token
        api = Api(world)
        signed = await api.signed(token, REVOKE)
        assert (await api.ask(order, reading_key(token), signed)).trouble == "forbidden"
        bare = msgspec.structs.replace(REVOKE, proof="")
        assert (await api.ask(order, token, bare)).trouble == "forbidden"
        assert (await api.ask(order, token, None)).trouble == "forbidden"
        assert world.done == []
        assert [one["severity"] for one in world.refusals] == [Severity.ALARM] * 3
        assert {one["verb"] for one in world.refusals} == {admin.verb_of(order)}
        api.close()

    play(tmp_path, story)


def test_ones_proof_is_not_anothers(tmp_path: Path) -> None:
    """An order that bob signed is not alice's, with her reading key beside it, and counts for his role only."""

    async def story(world: World) -> None:
        alice = (await world.tokens.add(TokenAdd("alice", "admin", 600))).token
        bob = (await world.tokens.add(TokenAdd("bob", "operator", 600))).token
        api = Api(world)
        by_bob = await api.signed(bob, REVOKE)
        order = admin.HostRevoke("laptop", 3)
        assert "signed otherwise" in (await api.ask(order, reading_key(alice), by_bob)).error
        assert "this is for admins" in (await api.ask(order, reading_key(bob), by_bob)).error
        assert world.done == []
        assert [one["who"] for one in world.refusals] == ["alice", "bob"]
        api.close()

    play(tmp_path, story)


def test_a_revoked_token_signs_nothing(tmp_path: Path) -> None:
    """An order that was signed before its token was revoked, and kept back by the api, is refused afterwards."""

    async def story(world: World) -> None:
        token = (await world.tokens.add(TokenAdd("alice", "admin", 600))).token
        api = Api(world)
        kept_back = await api.signed(token, REVOKE)
        await world.tokens.revoke(TokenRevoke("alice"))
        for shown in (reading_key(token), token):
            answer = await api.ask(admin.HostRevoke("laptop", 3), shown, kept_back)
            assert (answer.ok, answer.trouble) == (False, "forbidden")
            assert not (await api.ask(admin.PolicyWanted(), shown)).ok
        assert world.done == []
        assert len(world.refusals) == 4
        api.close()

    play(tmp_path, story)


def test_a_reading_key_changes_nothing(tmp_path: Path) -> None:
    """What an api has seen of a client that signs opens what there is to see, and no order without a proof."""

    async def story(world: World) -> None:
        token = (await world.tokens.add(TokenAdd("alice", "admin", 600))).token
        api = Api(world)
        assert (await api.ask(admin.PolicyWanted(), reading_key(token))).ok
        refused = await api.ask(admin.PolicyLoad("[Nodes]\n", expected=3), reading_key(token), LOAD)
        assert "needs its proof" in refused.error
        assert [request for request, _who in world.done] == [admin.PolicyWanted()]
        assert len(world.refusals) == 1
        api.close()

    play(tmp_path, story)


@pytest.mark.parametrize("require_proof", [False, True])
def test_bare_tokens_change_things_only_where_they_may(tmp_path: Path, *, require_proof: bool) -> None:
    """A script's bare token is proof enough, unless api_require_proof is on; then it still opens the views."""

    async def story(world: World) -> None:
        token = (await world.tokens.add(TokenAdd("alice", "admin", 600))).token
        await world.store.settled()
        world.begin(require_proof=require_proof)
        api = Api(world)
        order = admin.PolicyLoad("[Nodes]\n", expected=3)
        answer = await api.ask(order, token, LOAD)
        assert answer.ok is not require_proof
        assert ("api_require_proof" in answer.error) is require_proof
        assert (await api.ask(admin.PolicyWanted(), token)).ok
        assert (await api.ask(order, reading_key(token), await api.signed(token, LOAD))).ok
        assert len(world.refusals) == require_proof
        api.close()

    play(tmp_path, story)


def test_a_token_of_an_earlier_version_is_good_as_it_was(tmp_path: Path) -> None:
    """Without keys kept of it a token is shown itself, and is recognised by its hash; it proves no more than that."""

    async def story(world: World) -> None:
        row = await world.tokens.add(TokenAdd("alice", "admin", 600))
        token = row.token
        world.store.database.submit("DELETE FROM token_keys WHERE id = ?", (row.id,))
        await world.store.settled()
        world.begin(require_proof=False)
        api = Api(world)
        order = admin.PolicyLoad("[Nodes]\n", expected=3)
        assert (await api.ask(order, token, LOAD)).ok
        assert not (await api.ask(order, token[:-1] + ("A" if token[-1] != "A" else "B"), LOAD)).ok
        assert not (await api.ask(admin.PolicyWanted(), reading_key(token))).ok
        assert (
            "make another one"
            in (await api.ask(order, token, msgspec.structs.replace(LOAD, proof="x y"))).error
        )
        api.close()

    play(tmp_path, story)
