import asyncio
import socket
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from appliance.base.clock import wall
from appliance.channel import admin
from appliance.channel.channel import Channel
from appliance.channel.link import Link
from appliance.channel.messages.api import (
    ApiLink,
    ConnectionPassed,
    RequestAnswered,
    RequestMade,
    TokensStated,
)
from appliance.control.operators.token_orders import TOKENS
from appliance.features.standby import passive
from appliance.features.standby.orders import StandbyAdministration
from appliance.features.standby.passive import PassiveRest, ReplicatedTokens
from appliance.signing.request_signing import TokenKeys
from appliance.store.access_tokens import TokenRow, make_token
from appliance.store.host_tables import HostBlockRow
from appliance.store.state_file import StateStore
from tests.support.ends import ends_of
from tests.support.engines import InlineDatabase
from tests.unit.features.standby.parts import Member

pytestmark = [pytest.mark.anyio, pytest.mark.usefixtures("local_sockets")]


def made(name: str) -> tuple[TokenRow, str]:
    return make_token(name, "viewer", now=wall(), seconds=60)


def save(folder: Path, *rows: TokenRow) -> None:
    store = StateStore(folder, failed=pytest.fail, kind=InlineDatabase)
    ends = ends_of(store, folder)
    for row in rows:
        store.save_tokens(row)
        ends.set(TOKENS, row.id, 60.0)
    store.close()


def rest_of(folder: Path) -> PassiveRest:
    tokens = ReplicatedTokens(folder / "state.db")
    return PassiveRest(StandbyAdministration(Member("standby"), orders=False), tokens)


def attached(rest: PassiveRest) -> tuple[Channel, asyncio.Queue[Any]]:
    ours, theirs = socket.socketpair()
    heard: asyncio.Queue[Any] = asyncio.Queue()
    api = Channel(theirs, ApiLink)
    api.attach(
        asyncio.get_running_loop(), lambda message, _descriptors: heard.put_nowait(message), lambda: None
    )
    rest.attach(Channel(ours, ApiLink))
    return api, heard


async def test_a_new_api_learns_the_tokens_at_once(tmp_path: Path) -> None:
    """Until then, its empty list would sign users out."""
    row, token = made("alice")
    save(tmp_path, row)
    rest = rest_of(tmp_path)
    api, heard = attached(rest)
    async with asyncio.timeout(20):
        first = await heard.get()
        assert isinstance(first, TokensStated)
        assert [one.name for one in first.tokens] == ["alice"]
        api.send(RequestMade(7, admin.StatusWanted(), token))
        answer = await heard.get()
    assert isinstance(answer, RequestAnswered)
    assert admin.decode(answer.answer, admin.StatusWanted()).active == "10.0.0.2"
    api.close()


async def test_a_door_is_refused_at_once_and_no_request_is_lost_in_a_takeover(tmp_path: Path) -> None:
    row, token = made("alice")
    save(tmp_path, row)
    rest = rest_of(tmp_path)
    api, heard = attached(rest)
    async with asyncio.timeout(20):
        await heard.get()
        with socket.socket() as viewer:
            api.send(ConnectionPassed(3, "viewer", "ticket", "10.0.0.7"), (viewer.fileno(),))
            assert (await heard.get()).status == 503
        channel = rest.release()
        api.send(RequestMade(7, admin.StatusWanted(), token))
        await asyncio.sleep(0)
        assert channel is not None
        later: asyncio.Queue[Any] = asyncio.Queue()
        Link(later.put_nowait).attach(channel)
        assert (await later.get()).number == 7
    api.close()


@pytest.mark.parametrize("count", [0, 1])
async def test_no_tokens_are_stated_before_they_are_read(tmp_path: Path, count: int) -> None:
    rest = rest_of(tmp_path)
    api, heard = attached(rest)
    async with asyncio.timeout(20):
        api.send(RequestMade(7, admin.StatusWanted(), ""))
        first = await heard.get()
        assert isinstance(first, RequestAnswered), "the list would have come before the answer"
        save(tmp_path, *(made("alice")[0] for _ in range(count)))
        reading = asyncio.create_task(rest.run())
        stated = await heard.get()
        reading.cancel()
    assert isinstance(stated, TokensStated)
    assert len(stated.tokens) == count
    api.close()


def test_keys_and_tokens_are_of_the_same_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = made("alice")[0], made("bob")[0]
    save(tmp_path, first)
    tokens = ReplicatedTokens(tmp_path / "state.db")
    later = iter([second])

    def keys(*columns: bytes) -> TokenKeys:
        for row in later:
            with closing(sqlite3.connect(tmp_path / "state.db")) as database, database:
                assert row.keys
                database.execute("INSERT INTO token_keys VALUES (?, ?, ?)", (row.id, *row.keys))
                database.execute("INSERT INTO token VALUES (?, ?, ?, ?, ?, ?, ?, ?)", row[:-1])
                end = ("token", row.id, 1 << 62, 0, 0, None)
                database.execute("INSERT INTO ends VALUES (?, ?, ?, ?, ?, ?)", end)
        return TokenKeys(*columns)

    monkeypatch.setattr(passive, "TokenKeys", keys)
    seen = []
    for _ in range(2):
        assert tokens.read()
        seen.append(sorted(one.name for one in tokens.usable()))
        assert all(row.keys for row in map(tokens.usable_row, (first.id, second.id)) if row)
    assert seen == [["alice"], ["alice", "bob"]]


def test_a_standby_knows_the_blocked_hosts(tmp_path: Path) -> None:
    save(tmp_path, made("alice")[0])
    tokens = ReplicatedTokens(tmp_path / "state.db")
    assert tokens.read() and tokens.blocked == []
    store = StateStore(tmp_path, failed=pytest.fail, kind=InlineDatabase)
    store.hosts.save_block(HostBlockRow("10.0.0.7", 1.0, "ann", ""))
    store.close()
    assert tokens.read() and tokens.blocked == ["10.0.0.7"]
    assert not tokens.read()
