from pathlib import Path
from typing import Any

import pytest

from appliance.base import clock
from appliance.channel.admin import PolicyReload, StatusWanted, TokenAdd
from appliance.channel.answers.token_answers import SignedOn
from appliance.channel.messages.api import RequestMade
from appliance.control.errors import TokenRefusedError, UnavailableError, UnknownThingError
from appliance.control.operators.token_orders import TokenOrders
from appliance.control.rest.rest_proof import RequestAuthenticator, UnprovenError
from appliance.features.sso import requests
from appliance.features.sso.control_part import SessionTable, SsoOrders
from appliance.features.sso.link import SessionKeys, SignedInPerson, SignOnConfirmed, SignOnFailed
from appliance.features.sso.quotas import SESSIONS
from appliance.signing.request_signing import keys_of, reading_key
from appliance.store.state_file import StateStore
from tests.support.core import Core
from tests.support.ends import ends_of
from tests.support.engines import InlineDatabase
from tests.support.virtual_clock import let_time_pass, set_wall

pytestmark = pytest.mark.anyio


def _token(number: int) -> str:
    return f"rosrv_{number:012x}_{'s' * 43}"


def _keys(number: int) -> SessionKeys:
    keys = keys_of(_token(number))
    return SessionKeys(f"{number:012x}", keys.reading, keys.verifying)


def _person(
    subject: str = "u-1", name: str = "alice", role: Any = "operator", doors: tuple[str, ...] = ()
) -> SignedInPerson:
    return SignedInPerson(subject, name, "", role, doors, clock.wall() + 3600)


class World:
    def __init__(self, home: Path) -> None:
        core = Core(home)
        self.trail = core.trail
        self.changes = 0
        self.sso = SsoOrders(core.trail, core.ends, self._changed, configured=True)
        self.tokens = TokenOrders(
            core.store, core.trail, core.ends, lambda: None, sessions=lambda: self.sso.sessions
        )
        self.checks = RequestAuthenticator(self.tokens, require_proof=False)
        self.answer: Any = None
        self.sso.link.ask = self._ask  # type: ignore[method-assign, assignment]  # the process

    def _changed(self) -> None:
        self.changes += 1

    async def _ask(self, _question: Any, _seconds: float) -> Any:
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer

    async def sign_on(self, number: int, person: SignedInPerson | None = None) -> SignedOn:
        self.answer = SignOnConfirmed(1, person or _person(), _keys(number), "10.0.0.9")
        return await self.sso.complete(requests.SignOnComplete("s", "c", "", "10.0.0.9"))

    def events(self) -> list[str]:
        return self.trail.events


@pytest.fixture
def world(tmp_path: Path) -> World:
    return World(tmp_path)


async def test_a_session_has_the_rights_of_its_role_and_is_recorded(world: World) -> None:
    session = await world.sign_on(1, _person(doors=("floor",)))
    shown = reading_key(_token(1))
    assert await world.checks.asker(RequestMade(1, StatusWanted(), shown)) == "sso:alice"
    with pytest.raises(UnprovenError, match="an order without its HTTP request"):
        await world.checks.asker(RequestMade(2, PolicyReload(), shown))
    with pytest.raises(UnprovenError, match="this is for admins; the token sso:alice has the role operator"):
        await world.checks.asker(RequestMade(3, requests.SessionsWanted(), shown))
    assert world.sso.sessions.of(f"{1:012x}") == session
    assert (session.name, session.role, session.groups) == ("sso:alice", "operator", ["floor"])
    detail, *_more = [row for row in world.trail.rows if row["event"] == "signed on"]
    found = [detail[name] for name in ("event", "who", "subject", "host")]
    assert found == ["signed on", "sso:alice", "u-1", "10.0.0.9"]
    assert not {"reading", "verifying", "keys"} & detail.keys()
    assert world.changes == 1


async def test_a_session_ends_in_time_whatever_the_clock_shows(world: World) -> None:
    await world.sign_on(1)
    set_wall(clock.wall() - 7200)
    let_time_pass(3599)
    assert world.tokens.usable_row(f"{1:012x}") is not None
    let_time_pass(2)
    assert world.tokens.usable_row(f"{1:012x}") is None
    with pytest.raises(UnprovenError, match="no valid token"):
        await world.checks.asker(RequestMade(1, StatusWanted(), reading_key(_token(1))))


async def test_a_person_signs_out_of_their_own_session_only(world: World) -> None:
    await world.sign_on(1)
    await world.sign_on(2, _person("u-2", "bob"))
    with pytest.raises(UnknownThingError):
        await world.sso.sign_out(requests.SignOut(f"{1:012x}"), "sso:bob")
    await world.sso.sign_out(requests.SignOut(f"{1:012x}"), "sso:alice")
    ended = await world.sso.end(requests.SessionsEnd("bob"), "first")
    assert [session.name for session in ended.sessions] == ["sso:bob"]
    assert world.tokens.usable() == []
    assert world.events().count("signed off") == 2
    with pytest.raises(UnknownThingError, match=r"^no person is signed in$"):
        await world.sso.end(requests.SessionsEnd("bob"), "first")


async def test_a_session_never_replaces_a_token(world: World) -> None:
    made = await world.tokens.add(TokenAdd("boss", "admin", 3600))
    await world.sign_on(int(made.id, 16))
    assert [kept.name for kept in world.tokens.usable()] == ["boss"]
    row = world.tokens.usable_row(made.id)
    assert row is not None
    assert row.name == "boss"


@pytest.mark.parametrize(
    ("person", "number", "reason"),
    [
        (_person, 1, "the id of another session"),
        (lambda: _person("u-2"), 2, "another person is signed in as sso:alice"),
    ],
    ids=["id", "name"],
)
async def test_no_session_takes_the_place_of_another(
    world: World, person: Any, number: int, reason: str
) -> None:
    await world.sign_on(1)
    with pytest.raises(TokenRefusedError, match=reason):
        await world.sign_on(number, person())
    assert world.events()[-1] == "sign-on refused"


async def test_other_rights_end_the_earlier_sessions_of_the_person(world: World) -> None:
    await world.sign_on(1, _person(role="admin"))
    await world.sign_on(2, _person(role="viewer"))
    assert [kept.role for kept in world.tokens.usable()] == ["viewer"]
    assert world.events()[-2:] == ["signed off", "signed on"]


def test_a_person_and_all_people_have_a_quota_of_sessions(tmp_path: Path) -> None:
    store = StateStore(tmp_path, failed=pytest.fail, kind=InlineDatabase)
    table, bounds = SessionTable(ends_of(store, tmp_path), lambda: None), SESSIONS.bounds
    for number in range(bounds.host + 1):
        table.open(_person(), _keys(number))
    assert [one.id for one in table.sessions()] == [f"{number:012x}" for number in range(1, bounds.host + 1)]
    for number in range(bounds.host, bounds.whole):
        table.open(
            _person(f"p-{number}", f"p-{number}"), SessionKeys(f"f{number:011x}", b"r" * 32, b"v" * 32)
        )
    with pytest.raises(TokenRefusedError, match="500 people's sessions are open"):
        table.open(_person("late", "late"), _keys(9))
    table.open(_person(), _keys(9))  # replaces the person's own oldest one


@pytest.mark.parametrize(
    ("answer", "error", "reason"),
    [
        (SignOnFailed(1, "no role", refused=True), TokenRefusedError, "no role"),
        (SignOnFailed(1, "https://id/token: no answer", refused=False), UnavailableError, "tokens remain valid"),
        (TimeoutError(), UnavailableError, "sign in with a token"),
    ],
    ids=["refused", "provider down", "process down"],
)  # fmt: skip
async def test_a_failure_is_answered_and_recorded(
    world: World, answer: Any, error: type[Exception], reason: str
) -> None:
    world.answer = answer
    with pytest.raises(error, match=reason):
        await world.sso.complete(requests.SignOnComplete("s", "c", "", "10.0.0.9"))
    assert world.events() == ["sign-on refused"]
    assert world.tokens.usable() == []


async def test_no_session_opens_while_the_log_cannot_be_written(world: World) -> None:
    world.trail.log.failure = "the disk is full"
    with pytest.raises(UnavailableError, match="the audit log cannot be written"):
        await world.sign_on(1)
    assert world.tokens.usable() == []
