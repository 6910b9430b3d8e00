import asyncio
from typing import Any

import msgspec
import pytest

from appliance.api.front.access import Bearer, TokenAuthenticator
from appliance.api.front.journal import Journal
from appliance.api.front.problems import ProblemError
from appliance.api.front.request_gate import RequestGate
from appliance.api.front.websockets import ShownTickets
from appliance.base import clock
from appliance.base.clock import using
from appliance.channel.messages.api import TokenKept
from appliance.configuration.settings import ApiLimits
from appliance.signing.bearer_secrets import hash_of
from appliance.signing.request_signing import reading_key
from appliance.store import access_tokens
from appliance.store.access_tokens import TokenRow, make_token
from tests.support.asgi import requested
from tests.support.inline_loop import run
from tests.support.virtual_clock import VirtualClock


def kept(row: TokenRow) -> TokenKept:
    return TokenKept(row.id, row.name, row.role, row.salt, row.hash, row.expires)


def recognise(door: TokenAuthenticator, header: str | None, host: str = "10.0.0.1") -> Any:
    try:
        return run(door.recognise(header, host))
    except ProblemError as problem:
        return problem.status


def test_a_token_has_the_name_role_and_expiry_it_was_made_with() -> None:
    row, text = make_token("alice", "operator", now=clock.wall(), seconds=60)
    door = TokenAuthenticator(10, lambda _token: None)
    door.state([kept(row)])
    for scheme in ("Bearer", "bearer"):
        bearer = recognise(door, f"{scheme} {text}")
        assert (bearer.name, bearer.role, bearer.expires) == ("alice", "operator", row.expires)
    assert not door.end_of(bearer, "10.0.0.9")
    door.state([])
    assert door.end_of(bearer, "10.0.0.9")
    assert recognise(door, f"Bearer {text}") == 401


def test_no_token_is_called_revoked_before_control_has_stated_the_tokens() -> None:
    row, text = make_token("alice", "viewer", now=clock.wall(), seconds=60)
    door = TokenAuthenticator(10, lambda _token: None)
    assert recognise(door, f"Bearer {text}") == 503
    assert recognise(door, None) == 401
    door.state([])
    assert recognise(door, f"Bearer {text}") == 401
    door.state([kept(row)])
    assert recognise(door, f"Bearer {text}").name == "alice"


def test_a_step_back_of_the_clock_revives_no_token() -> None:
    with using(machine := VirtualClock()):
        row, text = make_token("alice", "viewer", now=clock.wall(), seconds=60)
        door = TokenAuthenticator(10, lambda _token: None)
        door.state([kept(row)])
        bearer = Bearer(row.id, row.name, "viewer", row.expires, text)
        machine.set_wall(clock.wall() - 86_400)
        machine.advance(59)
        assert not door.end_of(bearer, "10.0.0.9")
        machine.advance(2)
        door.state([kept(row)])
        assert door.end_of(bearer, "10.0.0.9")


def test_a_request_without_a_token_is_refused_for_that_and_counts_as_no_wrong_one() -> None:
    door = TokenAuthenticator(1, lambda _token: None)
    door.state([])
    for header in (None, "", "Basic dTpw", "Bearer", "Bearer  ", "Basic dTpw"):
        with pytest.raises(ProblemError, match="no token: "):
            run(door.recognise(header, "10.0.0.1"))
    assert [recognise(door, "Bearer x") for _ in range(2)] == [401, 429]


def test_an_expired_token_is_refused() -> None:
    row, text = make_token("a", "viewer", now=clock.wall() - 100, seconds=50)
    door = TokenAuthenticator(10, lambda _token: None)
    door.state([kept(row)])
    assert recognise(door, f"Bearer {text}") == 401


@pytest.mark.parametrize("back", [0.0, 86_400.0])
def test_the_owner_of_an_ended_token_learns_that_it_has_ended(back: float) -> None:
    with using(machine := VirtualClock(wall=1_795_164_925.0)):
        row, text = make_token("alice", "admin", now=clock.wall() - 100, seconds=50)
        machine.set_wall(clock.wall() - back)
        door = TokenAuthenticator(10, lambda _token: None)
        door.state([msgspec.structs.replace(kept(row), ended=True)])
        for _ in range(2):
            with pytest.raises(ProblemError, match="the token alice ended at 2026-11-20 08:54:35") as refused:
                run(door.recognise(f"Bearer {text}", "10.0.0.1"))
            assert refused.value.status == 401
        wrong = text[:-4] + ("aaaa" if text[-4:] != "aaaa" else "bbbb")
        with pytest.raises(ProblemError, match="wrong or revoked"):
            run(door.recognise(f"Bearer {wrong}", "10.0.0.1"))


def test_the_costly_check_runs_once_for_a_good_token(monkeypatch: pytest.MonkeyPatch) -> None:
    row, text = make_token("a", "viewer", now=clock.wall(), seconds=60)
    checks: list[str] = []

    def counted(secret: str, salt: bytes) -> bytes:
        checks.append(secret)
        return real(secret, salt)

    real = access_tokens.hash_secret
    monkeypatch.setattr(access_tokens, "hash_secret", counted)
    door = TokenAuthenticator(10, lambda _token: None)
    door.state([kept(row)])
    for _ in range(3):
        assert recognise(door, f"Bearer {text}").name == "a"
    assert len(checks) == 1


def test_a_token_with_many_requests_delays_the_check_of_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [make_token(name, "viewer", now=clock.wall(), seconds=60) for name in ("eve", "adam")]
    door = TokenAuthenticator(10, lambda _token: None)
    door.state([kept(row) for row, _text in rows])
    checked: list[bytes] = []

    async def check(_function: object, _secret: str, salt: bytes, _kept: bytes) -> bool:
        checked.append(salt)
        await asyncio.sleep(0)  # lets the other requests come
        return True

    monkeypatch.setattr(asyncio, "to_thread", check)
    (eve, hers), (adam, his) = rows

    async def all_at_once() -> list[str]:
        asked = [*[hers] * 60, his]
        return [
            one.name
            for one in await asyncio.gather(*(door.recognise(f"Bearer {text}", "") for text in asked))
        ]

    assert run(all_at_once()) == [*["eve"] * 60, "adam"]
    assert checked == [eve.salt, adam.salt]


def test_guessing_a_secret_is_cut_short(monkeypatch: pytest.MonkeyPatch) -> None:
    row, text = make_token("a", "viewer", now=clock.wall(), seconds=60)
    checks: list[str] = []

    def counted(secret: str, salt: bytes) -> bytes:
        checks.append(secret)
        return b"never"

    monkeypatch.setattr(access_tokens, "hash_secret", counted)
    door = TokenAuthenticator(5, lambda _token: None)
    door.state([kept(row)])
    wrong = f"Bearer rosrv_{row.id}_" + "A" * 43
    assert [recognise(door, wrong) for _ in range(8)] == [401] * 5 + [429] * 3
    assert len(checks) == 5
    assert recognise(door, wrong, "10.0.0.2") == 401
    monkeypatch.undo()
    assert recognise(door, f"Bearer {text}", "10.0.0.3").name == "a"


def test_unknown_tokens_do_not_lock_out_a_neighbour() -> None:
    row, text = make_token("a", "viewer", now=clock.wall(), seconds=60)
    door = TokenAuthenticator(5, lambda _token: None)
    door.state([kept(row)])
    statuses = [recognise(door, f"Bearer nonsense{number}") for number in range(8)]
    assert statuses == [401] * 5 + [429] * 3
    assert recognise(door, f"Bearer {text}").name == "a"


def test_a_use_is_reported_at_once_and_then_once_a_minute(monkeypatch: pytest.MonkeyPatch) -> None:
    row, text = make_token("a", "viewer", now=clock.wall(), seconds=600)
    ended, late = make_token("b", "viewer", now=clock.wall() - 100, seconds=50)
    used: list[str] = []
    door = TokenAuthenticator(10, used.append)
    door.state([kept(row), kept(ended)])
    for header in (
        None,
        f"Bearer {late}",
        f"Bearer {text[:-1]}!",
        f"Bearer {make_token('c', 'viewer', now=0, seconds=1)[1]}",
    ):
        recognise(door, header)
    assert used == []
    machine = VirtualClock()
    with using(machine):
        for passed, reports in ((0.0, 1), (59.0, 1), (2.0, 2), (1.0, 2)):
            machine.advance(passed)
            assert recognise(door, f"Bearer {text}").name == "a"
            assert used == [row.id] * reports
        door.state([kept(row)])
        recognise(door, f"Bearer {text}")
    assert used == [row.id] * 3


def test_a_stream_ends_with_the_grace_time_of_its_token() -> None:
    row, text = make_token("a", "viewer", now=clock.wall(), seconds=60)
    door = TokenAuthenticator(10, lambda _token: None)
    door.state([kept(row)])
    bearer = recognise(door, f"Bearer {text}")
    door.state([kept(row._replace(expires=clock.wall() + 30))])
    assert not door.end_of(bearer, "10.0.0.9")
    door.state([kept(row._replace(expires=clock.wall() - 1))])
    assert door.end_of(bearer, "10.0.0.9")


def test_a_neighbour_without_a_token_keeps_no_known_credential_out() -> None:
    """A program at the operator's address, as behind NAT, sends as much as it can."""

    async def app(_scope: Any, _receive: Any, send: Any) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b""})

    with using(VirtualClock()):
        row, text = make_token("alice", "viewer", now=clock.wall(), seconds=600)
        door = TokenAuthenticator(10, lambda _token: None)
        door.state([msgspec.structs.replace(kept(row), reading=hash_of(reading_key(text)))])
        gate = RequestGate(
            app, limits=ApiLimits(), doorkeeper=door, journal=Journal(lambda _call: None), names=["api"]
        )

        def status(shown: str) -> int:
            return requested(
                gate, "GET", "/v1/status", headers={"Authorization": f"Bearer {shown}"}
            ).status_code

        def opened(ticket: str) -> int:
            target = f"/door/pad?ticket={ticket}".encode()
            try:
                gate.admit_websocket("10.0.0.1", "/door/", tickets.digest_of(target))
            except ProblemError as problem:
                return problem.status
            return 101

        tickets = ShownTickets(door)
        tickets.answered("10.0.0.1", "pad", "right", valid=True)
        assert status(text) == 200
        while status("wrong") != 429 or opened("wrong") != 429:
            ...
        assert [status(text), status(reading_key(text)), opened("right")] == [200, 200, 101]
        assert 429 in {status(text) for _ in range(200)}  # it has a limit of its own
        assert 429 in {opened("right") for _ in range(200)}
