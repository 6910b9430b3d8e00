import asyncio
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from appliance.audit.search.query import Filter
from appliance.audit.search.search import search
from appliance.base.clock import using, wall
from appliance.channel.admin import TokenAdd, TokenList, TokenRevoke, TokenRotate
from appliance.channel.answers.token_answers import RotatedToken
from appliance.control.errors import TokenRefusedError
from appliance.control.operators import token_orders
from appliance.control.operators.token_orders import TokenOrders
from appliance.signing.request_signing import keys_of
from appliance.store.access_tokens import is_secret, parse_token
from appliance.store.state_file import StateStore
from appliance.store.writer_thread import StoreError
from appliance.telemetry.audit_trail import AuditTrail
from tests.support.ends import ends_of
from tests.support.engines import InlineDatabase, open_log
from tests.support.virtual_clock import VirtualClock, let_time_pass, set_wall

pytestmark = pytest.mark.anyio


class Lives:
    def __init__(self, home: Path) -> None:
        self.home = home
        self.log = open_log(home / "audit.db")
        self.trail = AuditTrail(self.log, strict=False, deny_when_failed=False)
        self.store = self._opened()

    def records(self, event: str) -> list[dict[str, Any]]:
        found = search(self.home / "audit.db", Filter(event=event), newest_first=False)
        return [entry.record.detail for entry in found.entries]

    def next(self) -> TokenOrders:
        self.store.close()
        self.store = self._opened()
        return TokenOrders(self.store, self.trail, ends_of(self.store, self.home), lambda: None)

    def _opened(self) -> StateStore:
        return StateStore(self.home, failed=pytest.fail, kind=InlineDatabase)


@pytest.fixture
def lives(tmp_path: Path) -> Iterator[Lives]:
    lives = Lives(tmp_path)
    yield lives
    lives.store.close()
    lives.log.close()


def opens(tokens: TokenOrders, text: str | None) -> bool:
    assert text is not None
    parsed = parse_token(text)
    assert parsed is not None
    return any(one.id == parsed[0] and is_secret(parsed[1], one.salt, one.hash) for one in tokens.usable())


async def test_an_unannounced_token_is_replaced(lives: Lives) -> None:
    lost = await lives.next().first()
    tokens = lives.next()
    assert opens(tokens, lost)
    text = await tokens.first()
    assert opens(tokens, text)
    assert not opens(tokens, lost)
    assert [one.name for one in tokens.usable()] == ["first"]


async def test_an_announced_token_stays(lives: Lives) -> None:
    tokens = lives.next()
    text = await tokens.first()
    tokens.first_token_shown()
    await lives.store.until_settled()
    later = lives.next()
    assert await later.first() is None
    assert opens(later, text)


async def test_a_late_notice_of_the_announcement_counts(lives: Lives) -> None:
    text = await lives.next().first()
    tokens = lives.next()
    tokens.first_token_shown()
    assert await tokens.first() is None
    assert opens(tokens, text)


async def test_an_old_state_gets_no_first_token(lives: Lives) -> None:
    tokens = lives.next()
    await tokens.add(TokenAdd("alice", "admin", 60))
    assert await lives.next().first() is None


async def test_a_token_that_cannot_be_stored_is_void(lives: Lives, monkeypatch: pytest.MonkeyPatch) -> None:
    tokens = lives.next()

    async def full() -> None:
        raise StoreError("the disk is full")

    with monkeypatch.context() as patched:
        patched.setattr(lives.store, "until_settled", full)
        with pytest.raises(StoreError, match="full"):
            await tokens.add(TokenAdd("alice", "admin", 60))
    assert tokens.usable() == []
    assert (await tokens.add(TokenAdd("alice", "admin", 60))).token


async def test_a_rotated_token_keeps_its_name_and_role(lives: Lives) -> None:
    tokens = lives.next()
    old = await tokens.add(TokenAdd("alice", "operator", 3600))
    new = await tokens.rotate(TokenRotate("alice"), "operator")
    assert (new.name, new.role) == ("alice", "operator")
    assert new.expires - new.created == pytest.approx(old.expires - old.created)
    assert not opens(tokens, old.token)
    assert opens(tokens, new.token)
    assert [one.reading for one in tokens.usable()] == [keys_of(new.token).reading]
    row = tokens.usable_row(new.id)
    assert row is not None
    assert row.keys == keys_of(new.token)
    assert tokens.usable_row(old.id) is None
    assert [(one.id, one.revoked is not None) for one in new.earlier] == [(old.id, True)]
    await lives.trail.durable()
    [record] = lives.records("token rotated")
    assert (record["id"], record["earlier"], record["who"]) == (new.id, [old.id], "operator")
    assert not opens(lives.next(), old.token), "the end survives a restart"


async def test_earlier_tokens_are_valid_for_the_grace_time(lives: Lives) -> None:
    tokens = lives.next()
    old = await tokens.add(TokenAdd("alice", "viewer", 3600))
    new = await tokens.rotate(TokenRotate("alice", 7200, grace=600))
    newest = await tokens.rotate(TokenRotate("alice", grace=6000))
    assert newest.expires - newest.created == pytest.approx(7200), "as long as the last one"
    now = wall()
    for seconds, valid in ((500, [old, new, newest]), (700, [new, newest]), (6500, [newest])):
        with using(VirtualClock(wall=now + seconds)):
            later = lives.next()
            assert {one.id for one in later.usable()} == {one.id for one in valid}


async def test_the_list_shows_an_end_as_the_door_judges_it(lives: Lives) -> None:
    tokens = lives.next()
    await tokens.add(TokenAdd("alice", "viewer", 3600))
    await tokens.add(TokenAdd("bob", "viewer", 7200))
    let_time_pass(3601)
    set_wall(wall() - 86_400)
    assert {row.name: row.valid for row in (await tokens.list_tokens(TokenList())).tokens} == {
        "alice": False,
        "bob": True,
    }


async def test_revoking_a_name_ends_its_earlier_tokens_too(lives: Lives) -> None:
    tokens = lives.next()
    await tokens.add(TokenAdd("alice", "admin", 3600))
    await tokens.rotate(TokenRotate("alice", grace=600))
    await tokens.revoke(TokenRevoke("alice"), "bob")
    assert tokens.usable() == []
    await lives.trail.durable()
    assert [record["who"] for record in lives.records("token revoked")] == ["bob", "bob"]


async def test_only_a_valid_token_can_be_rotated(lives: Lives) -> None:
    tokens = lives.next()
    for name, seconds in (("alice", 3600), ("bob", 3600), ("carol", 1)):
        await tokens.add(TokenAdd(name, "viewer", seconds))
    await tokens.revoke(TokenRevoke("bob"))
    let_time_pass(2.0)
    for name in ("bob", "carol", "dave", "x" * 500):
        with pytest.raises(TokenRefusedError, match=r"that is valid; there are: alice$"):
            await tokens.rotate(TokenRotate(name))
    assert len((await tokens.list_tokens(TokenList())).tokens) == 3


@pytest.mark.parametrize(
    "order", [TokenRotate("alice", -1), TokenRotate("alice", 1e12), TokenRotate("alice", grace=-1)]
)
async def test_impossible_times_of_a_rotation_change_nothing(lives: Lives, order: TokenRotate) -> None:
    tokens = lives.next()
    old = await tokens.add(TokenAdd("alice", "viewer", 3600))
    with pytest.raises(TokenRefusedError):
        await tokens.rotate(order)
    assert [one.id for one in tokens.usable()] == [old.id]


async def test_one_of_two_simultaneous_rotations_is_rejected(lives: Lives) -> None:
    tokens = lives.next()
    await tokens.add(TokenAdd("alice", "viewer", 3600))
    done = await asyncio.gather(
        *(tokens.rotate(TokenRotate("alice")) for _ in range(2)), return_exceptions=True
    )
    assert [type(one) for one in done] == [RotatedToken, TokenRefusedError]
    assert opens(tokens, done[0].token)  # type: ignore[union-attr]  # checked above


async def test_a_rotation_that_cannot_be_stored_leaves_the_earlier_token(
    lives: Lives, monkeypatch: pytest.MonkeyPatch
) -> None:
    tokens = lives.next()
    old = await tokens.add(TokenAdd("alice", "viewer", 3600))

    async def full() -> None:
        raise StoreError("the disk is full")

    with monkeypatch.context() as patched:
        patched.setattr(lives.store, "until_settled", full)
        with pytest.raises(StoreError, match="full"):
            await tokens.rotate(TokenRotate("alice"))
    assert [one.id for one in tokens.usable()] == [old.id]
    assert [one.id for one in lives.next().usable()] == [old.id]


async def test_a_failed_rotation_does_not_bring_back_a_revoked_token(
    lives: Lives, monkeypatch: pytest.MonkeyPatch
) -> None:
    tokens = lives.next()
    await tokens.add(TokenAdd("alice", "viewer", 3600))

    async def revoked_meanwhile() -> None:
        monkeypatch.undo()
        await tokens.revoke(TokenRevoke("alice"))
        raise StoreError("the disk is full")

    monkeypatch.setattr(lives.store, "until_settled", revoked_meanwhile)
    with pytest.raises(StoreError, match="full"):
        await tokens.rotate(TokenRotate("alice"))
    assert tokens.usable() == []


@pytest.mark.nightly
async def test_a_killed_control_has_rotated_or_not(lives: Lives) -> None:
    tokens = lives.next()
    old = await tokens.add(TokenAdd("alice", "viewer", 3600))
    await lives.store.until_settled()
    assert lives.log.close() is None  # a thread in SQLite would leave its locks to the child
    child = os.fork()
    if not child:
        try:
            asyncio.run(_rotate_and_die(lives))
        finally:
            os._exit(1)
    assert os.WTERMSIG(os.waitpid(child, 0)[1]) == signal.SIGKILL
    lives.store.close()
    ahead = lives.home / "state.ahead"
    whole, seen = ahead.read_bytes(), set()
    state = {path: path.read_bytes() for path in lives.home.glob("state.db*")}
    for length in (*range(0, len(whole), 11), len(whole)):
        for path in lives.home.glob("state.db*"):
            path.unlink()
        for path, data in state.items():
            path.write_bytes(data)
        ahead.write_bytes(whole[:length])
        store = StateStore(lives.home, failed=pytest.fail, kind=InlineDatabase)
        usable = [
            row.id
            for row in TokenOrders(store, lives.trail, ends_of(store, lives.home), lambda: None).usable()
        ]
        store.close()
        assert len(usable) == 1
        seen.add(usable[0] == old.id)
    assert seen == {True, False}
    lives.next()


async def _rotate_and_die(lives: Lives) -> None:
    store = StateStore(lives.home, failed=pytest.fail, kind=InlineDatabase)
    # The writer never gets to it.
    pytest.MonkeyPatch().setattr(store.database, "_commit", lambda _statements: None)

    async def killed() -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    store.until_settled = killed  # type: ignore[method-assign]  # killed instead of answering
    trail = AuditTrail(lives.log, strict=False, deny_when_failed=False)
    lives.log.record = lambda record: record.id  # type: ignore[method-assign]  # its thread is in the parent
    await TokenOrders(store, trail, ends_of(store, lives.home), lambda: None).rotate(TokenRotate("alice"))


async def uses(tokens: TokenOrders) -> dict[str, float | None]:
    return {token.name: token.last_used for token in (await tokens.list_tokens(TokenList())).tokens}


async def test_the_last_use_survives_a_restart(lives: Lives) -> None:
    tokens = lives.next()
    alice = await tokens.add(TokenAdd("alice", "viewer", 60))
    await tokens.add(TokenAdd("bob", "viewer", 60))
    tokens.used(alice.id)
    tokens.used("0123456789ab")
    known = await uses(tokens)
    assert known["alice"] == pytest.approx(wall())
    assert known["bob"] is None
    listed = await tokens.list_tokens(TokenList())
    again = lives.next()
    assert await uses(again) == known
    assert (await again.list_tokens(TokenList())).uses_since == listed.uses_since


async def test_uses_are_stored_at_most_once_in_half_a_minute(
    lives: Lives, monkeypatch: pytest.MonkeyPatch
) -> None:
    tokens = lives.next()
    alice = await tokens.add(TokenAdd("alice", "viewer", 600))
    stored: list[float] = []
    monkeypatch.setattr(lives.store, "save_token_use", lambda _token, used: stored.append(used))
    start, machine = float(int(wall())), VirtualClock()
    with using(machine):
        for ahead, passed in ((0, 0.0), (10, 10.0), (-3600, 21.0), (-3590, 10.0), (-3530, 21.0)):
            machine.advance(passed)
            machine.set_wall(start + ahead)
            tokens.used(alice.id)
            assert await uses(tokens) == {"alice": start + ahead}
    assert stored == [start, start - 3600, start - 3530]


async def test_a_full_disk_keeps_no_use_and_harms_no_request(
    lives: Lives, monkeypatch: pytest.MonkeyPatch
) -> None:
    tokens = lives.next()
    alice = await tokens.add(TokenAdd("alice", "viewer", 600))

    def full() -> None:
        raise StoreError("the disk is full")

    with monkeypatch.context() as patched:
        patched.setattr(lives.store.database, "require_room", full)
        tokens.used(alice.id)
        assert (await uses(tokens))["alice"] is not None
        assert lives.store.token_uses() == {}
    tokens.used(alice.id)
    assert lives.store.token_uses().keys() == {alice.id}


async def test_a_rotation_needs_room_only_for_a_further_token(
    lives: Lives, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(token_orders, "_MAX", 2)
    tokens = lives.next()
    for name in ("alice", "bob"):
        await tokens.add(TokenAdd(name, "viewer", 600))
    with pytest.raises(TokenRefusedError, match="there are 2 tokens already"):
        await tokens.rotate(TokenRotate("alice", grace=60))
    await tokens.rotate(TokenRotate("alice"))
    assert sorted(one.name for one in tokens.usable()) == ["alice", "bob"]


async def test_a_warning_comes_a_week_before_each_lasting_token_ends(lives: Lives) -> None:
    day = 86_400.0
    with using(VirtualClock()):
        tokens = lives.next()
        for name, days in (("alice", 90), ("script", 90), ("guest", 3)):
            await tokens.add(TokenAdd(name, "admin", days * day))
        let_time_pass(2.9 * day)
        assert tokens.ending() == [], "guest was made for three days"
        let_time_pass(80.2 * day)
        assert [(one.name, one.role) for one in tokens.ending()] == [("alice", "admin"), ("script", "admin")]
        await tokens.rotate(TokenRotate("script", 90 * day, 2 * day))
        assert [one.name for one in tokens.ending()] == ["alice"]
        await tokens.revoke(TokenRevoke("alice"))
        assert tokens.ending() == []


async def test_only_expired_tokens_are_called_ended(lives: Lives) -> None:
    with using(VirtualClock()):
        tokens = lives.next()
        for name in ("alice", "bob", "carol"):
            await tokens.add(TokenAdd(name, "viewer", 3600.0 if name == "alice" else 7200.0))
        await tokens.revoke(TokenRevoke("bob"))
        assert tokens.ended() == []
        let_time_pass(3601.0)
        for one in (tokens, lives.next()):
            assert [(kept.name, kept.ended) for kept in one.ended()] == [("alice", True)]
            assert [kept.name for kept in one.usable()] == ["carol"]
