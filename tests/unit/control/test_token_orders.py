"""Tests of `appliance.control.token_orders`: the first token reaches its owner, whichever process dies first."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from appliance.audit.log import AuditLog
from appliance.channel.admin import TokenAdd
from appliance.control.token_orders import TokenOrders
from appliance.store.access_tokens import is_secret, parse_token
from appliance.store.state_file import StateStore
from appliance.store.writer_thread import StoreError
from appliance.telemetry.audit_trail import AuditTrail

pytestmark = pytest.mark.anyio


class Lives:
    """Several runs of control on one state."""

    def __init__(self, home: Path) -> None:
        self.home = home
        self.log = AuditLog(home / "audit.db")
        self.trail = AuditTrail(self.log, strict=False, deny_when_failed=False, recordings=lambda *_: {})
        self.store: StateStore | None = None

    def next(self) -> TokenOrders:
        """Start control after the previous one died."""
        if self.store is not None:
            self.store.close()
        self.store = StateStore(self.home, failed=pytest.fail)
        return TokenOrders(self.store, self.trail, lambda: None)


@pytest.fixture
def lives(tmp_path: Path) -> Iterator[Lives]:
    """Return a state directory."""
    lives = Lives(tmp_path)
    yield lives
    assert lives.store is not None
    lives.store.close()
    lives.log.close()


def opens(tokens: TokenOrders, text: str | None) -> bool:
    """Whether a token is valid."""
    assert text is not None
    parsed = parse_token(text)
    assert parsed is not None
    return any(one.id == parsed[0] and is_secret(parsed[1], one.salt, one.hash) for one in tokens.usable())


async def test_an_unannounced_token_is_replaced(lives: Lives) -> None:
    """Control dies before it could announce the first token: the next control replaces and revokes the lost token."""
    lost = await lives.next().first()
    tokens = lives.next()
    assert opens(tokens, lost)
    text = await tokens.first()
    assert opens(tokens, text)
    assert not opens(tokens, lost)
    assert [one.name for one in tokens.usable()] == ["first"]


async def test_an_announced_token_stays(lives: Lives) -> None:
    """No later control makes a new token, whether or not it knows of the announcement."""
    tokens = lives.next()
    text = await tokens.first()
    tokens.first_token_shown()
    assert lives.store is not None
    await lives.store.settled()
    later = lives.next()
    assert await later.first() is None
    assert opens(later, text)


async def test_a_late_notice_of_the_announcement_counts(lives: Lives) -> None:
    """Control died before the supervisor's notice: the next control gets the notice first and makes no new token."""
    text = await lives.next().first()
    tokens = lives.next()
    tokens.first_token_shown()
    assert await tokens.first() is None
    assert opens(tokens, text)


async def test_an_old_state_gets_no_first_token(lives: Lives) -> None:
    """Tokens from a version without this mark count as announced."""
    tokens = lives.next()
    await tokens.add(TokenAdd("alice", "admin", 60))
    assert await lives.next().first() is None


async def test_a_token_that_cannot_be_stored_is_void(lives: Lives, monkeypatch: pytest.MonkeyPatch) -> None:
    """The text of such a token is never announced, and a later token may use its name."""
    tokens = lives.next()
    assert lives.store is not None

    async def full() -> None:
        raise StoreError("the disk is full")

    with monkeypatch.context() as patched:
        patched.setattr(lives.store, "settled", full)
        with pytest.raises(StoreError, match="full"):
            await tokens.add(TokenAdd("alice", "admin", 60))
    assert tokens.usable() == []
    assert (await tokens.add(TokenAdd("alice", "admin", 60))).token
