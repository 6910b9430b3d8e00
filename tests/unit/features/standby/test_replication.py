import asyncio
import contextlib
import random
import socket
import sqlite3
import ssl
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

from appliance.features.standby import replication, replication_frames, replication_sender
from appliance.features.standby.link_certificates import (
    CERTIFICATE,
    KEY,
    LinkCertificate,
    link_context,
    make_link_certificate,
)
from appliance.features.standby.replica import Replica
from appliance.features.standby.replication_frames import (
    Changes,
    FromActive,
    FromStandby,
    Introduction,
    Refused,
    ReplicationError,
    ReplicationLink,
    SnapshotBegin,
    SnapshotEnd,
    SnapshotRows,
    Stored,
)
from appliance.features.standby.replication_receiver import ReplicationReceiver
from appliance.features.standby.replication_sender import ReplicationSender
from appliance.specifications.switches import SWITCHES
from appliance.store.access_tokens import make_token
from appliance.store.changes import Put
from appliance.store.host_tables import HostBlockRow, HostRow, RevokedCertificateRow
from appliance.store.state_file import SCHEMA as STATE_SCHEMA
from appliance.store.state_file import (
    IncarnationRow,
    MonitorRevisionRow,
    PermissionRow,
    RegistrationRow,
    RevisionRow,
    StateStore,
)
from tests.support.engines import InlineDatabase
from tests.support.features.standby.replication import (
    SCHEMA,
    ActiveSide,
    CuttingProxy,
    StandbySide,
    certificates,
    change_randomly,
    replicated,
    tables_of,
)
from tests.support.processes import LIMIT
from tests.support.sources import ROOT
from tests.support.waiting import allowed, until

pytestmark = [pytest.mark.anyio, pytest.mark.usefixtures("sockets")]
SECONDS = 2 * LIMIT
OF_LAST_RELEASE = ROOT / "tests" / "integration" / "state-0.4.1.sql"


@contextlib.asynccontextmanager
async def active_side(directory: Path, **options: Any) -> AsyncIterator[ActiveSide]:
    """Have an active appliance whose standby is the test."""
    active = ActiveSide(directory / "active.db", certificates(directory)[0], **options)
    async with asyncio.timeout(SECONDS):
        yield active
    await active.close()


@contextlib.asynccontextmanager
async def standby_side(directory: Path, active: ActiveSide) -> AsyncIterator[StandbySide]:
    standby = StandbySide(directory / "standby.db", certificates(directory)[1], lambda: active.port)
    yield standby
    await standby.close()


async def require_equal(directory: Path, active: ActiveSide) -> None:
    """Check the tables. The standby may have rows before the active appliance has them on its disk."""
    await active.database.until_settled()
    assert tables_of(directory / "standby.db") == tables_of(directory / "active.db")


async def test_a_standby_of_an_earlier_version_says_why_it_cannot_follow_until_it_is_upgraded(
    tmp_path: Path,
) -> None:
    """On each link it refuses a table of a later version, and looks connected until then."""
    server, client = certificates(tmp_path)
    active = ActiveSide(tmp_path / "active.db", server, schema=STATE_SCHEMA)
    why = "a change does not fit: the state has no table 'ends'"
    try:
        async with asyncio.timeout(SECONDS):
            active.database.put("ends", "token", "a", 1, 2, 0, None)
            for schema, told in ((STATE_SCHEMA.replace("ends (", "earlier ("), why), (STATE_SCHEMA, "")):
                standby = StandbySide(tmp_path / "standby.db", client, lambda: active.port, schema=schema)
                await until(lambda: standby.ends or active.sender.lag().caught_up)  # noqa: B023  ends in this turn
                seen = set()
                for _ in range(50):
                    seen.add((active.sender.lag().refusal, standby.receiver.refusal.reason))
                    await asyncio.sleep(0.005)
                await standby.close()
                assert seen == {(told, told)}
    finally:
        await active.close()


async def test_a_pair_is_upgraded_from_the_state_of_the_last_release(tmp_path: Path) -> None:
    """The upgraded standby follows the older appliance, then takes over, then the other one, upgraded, follows it."""
    for name in ("active.db", "standby.db"):
        with contextlib.closing(sqlite3.connect(tmp_path / name)) as database:
            database.executescript(OF_LAST_RELEASE.read_text())
    for turn in (1, 2):
        pair = replicated(tmp_path, schema=STATE_SCHEMA, epoch=turn)
        async with asyncio.timeout(SECONDS), pair as (active, standby):
            active.database.put("setting", f"turn {turn}", "done")
            await active.sender.until_acknowledged(active.database.number)
            await active.database.until_settled()
            assert not standby.ends
        dumps = []
        for name in ("active.db", "standby.db"):
            with contextlib.closing(sqlite3.connect(tmp_path / name)) as database:
                dumps.append({line for line in database.iterdump() if '"journal"' not in line})
        assert dumps[0] == dumps[1]
        (tmp_path / "active.db").rename(tmp_path / "before")
        (tmp_path / "standby.db").rename(tmp_path / "active.db")
        (tmp_path / "before").rename(tmp_path / "standby.db")


async def test_changes_arrive_and_are_acknowledged(tmp_path: Path) -> None:
    async with asyncio.timeout(SECONDS), replicated(tmp_path) as (active, standby):
        chosen = random.Random(1)  # noqa: S311  draws examples
        for _ in range(30):
            for _ in range(20):
                change_randomly(active.database, chosen)
            await active.sender.until_acknowledged(active.database.number)
            assert standby.replica.position.number == active.database.number
            assert active.sender.lag()[:4] == (True, 0, 0, None)
            assert active.sender.lag().caught_up
            await require_equal(tmp_path, active)
        assert not standby.ends


@pytest.mark.parametrize(
    "seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in range(2, 6))]
)
async def test_nothing_is_lost_however_often_the_link_is_cut(tmp_path: Path, seed: int) -> None:
    chosen = random.Random(seed)  # noqa: S311  draws examples
    server, client = certificates(tmp_path)
    active = ActiveSide(tmp_path / "active.db", server, room=20_000)
    proxy = CuttingProxy(lambda: active.port, random.Random(seed))  # noqa: S311  draws examples
    port = await proxy.start()
    standby = StandbySide(tmp_path / "standby.db", client, lambda: port)
    step = 0
    async with asyncio.timeout(SECONDS):
        while step < 60 or proxy.cuts <= 3:
            for _ in range(chosen.randrange(1, 15)):
                change_randomly(active.database, chosen)
            step += 1
            active.database.put("mark", step)
            if step % 3 == 0:
                await active.sender.until_acknowledged(active.database.number)
                assert (step,) in tables_of(tmp_path / "standby.db")["mark"]
            if step % 20 == 13:
                await standby.close()
                standby = StandbySide(tmp_path / "standby.db", client, lambda: port)
            if step % 20 == 17:
                await active.close()
                active = ActiveSide(tmp_path / "active.db", server, room=20_000)
        proxy.cutting = False
        await active.sender.until_acknowledged(active.database.number)
        await require_equal(tmp_path, active)
    await standby.close()
    await active.close()
    await proxy.close()


async def test_a_standby_that_was_away_for_long_gets_a_snapshot(tmp_path: Path) -> None:
    chosen = random.Random(2)  # noqa: S311  draws examples
    async with active_side(tmp_path, room=10_000) as active:
        for number in range(3000):
            active.database.put("thing", f"away {number}", number, "x" * 1000)
        lag = active.sender.lag()
        assert (lag.connected, lag.changes, lag.caught_up) == (False, 3000, False)
        assert 0 < lag.bytes <= 10_000
        async with standby_side(tmp_path, active) as standby:
            await until(lambda: active.sender.lag().connected)
            while standby.replica.position.number < 3000:
                change_randomly(active.database, chosen)
                await asyncio.sleep(0)
            await active.sender.until_acknowledged(active.database.number)
            await require_equal(tmp_path, active)


async def test_a_standby_that_was_away_shortly_gets_only_the_changes(tmp_path: Path) -> None:
    async with active_side(tmp_path) as active:
        async with standby_side(tmp_path, active) as standby:
            active.database.put("thing", "a", 1, None)
            await active.sender.until_acknowledged(1)
        for number in range(500):
            active.database.put("thing", f"row {number}", number, "x" * 1000)
        async with connected(tmp_path, active) as link:
            await link.send(standby.replica.position)
            received = 0
            while received < 500:
                message = await link.receive(10)
                assert isinstance(message, Changes)
                assert message.first == 2 + received
                received += len(message.changes)
                await link.send(Stored(1, message.history, 1 + received))


@contextlib.asynccontextmanager
async def connected(directory: Path, active: ActiveSide) -> AsyncIterator[ReplicationLink[FromActive]]:
    _server, client = certificates(directory)
    reader, writer = await asyncio.open_connection("127.0.0.1", active.port, ssl=client)
    link: ReplicationLink[FromActive] = ReplicationLink(reader, writer, FromActive)
    try:
        yield link
    finally:
        await link.close()


async def require_closed(link: ReplicationLink[FromActive]) -> None:
    with pytest.raises(ReplicationError, match=r"closed the link|lost"):
        while True:
            await link.receive(10)


async def take_snapshot(link: ReplicationLink[FromActive]) -> SnapshotBegin:
    begin = await link.receive(10)
    assert isinstance(begin, SnapshotBegin)
    await link.send(Stored(0, "other", 1))
    while not isinstance(await link.receive(10), SnapshotEnd):
        await link.send(Stored(0, "other", 1))
    return begin


async def test_an_acknowledgement_of_an_unsent_change_is_not_counted(tmp_path: Path) -> None:
    async with active_side(tmp_path) as active:
        active.database.put("thing", "a", 1, None)
        history = active.database.history
        waiting = asyncio.create_task(active.sender.until_acknowledged(1))
        for lie in (Stored(1, history, 2), Stored(1, history, 1 << 61)):
            async with connected(tmp_path, active) as link:
                await link.send(Stored(0, "", 0))
                await take_snapshot(link)
                assert not waiting.done()
                await link.send(lie)
                await require_closed(link)
            assert not waiting.done()
        active.database.put("thing", "b", 1, None)
        async with connected(tmp_path, active) as link:
            await link.send(Stored(1, history, 2))  # what was never sent is of another state
            begin = await take_snapshot(link)
            assert begin.number == 2
            assert not waiting.done()
            await link.send(Stored(1, history, 2))
            await waiting
            await link.send(Stored(1, history, 0))
            await require_closed(link)


async def test_a_standby_that_lost_what_it_acknowledged_is_not_believed_any_longer(tmp_path: Path) -> None:
    async with active_side(tmp_path) as active:
        history = active.database.history
        async with connected(tmp_path, active) as link:
            await link.send(Stored(0, "", 0))
            await take_snapshot(link)
            await link.send(Stored(1, history, 0))
            for number in (1, 2, 3):
                active.database.put("thing", str(number), 1, None)
            number = 0
            while number < 3:
                message = await link.receive(10)
                assert isinstance(message, Changes)
                number = message.first + len(message.changes) - 1
                await link.send(Stored(1, history, number))
            await active.sender.until_acknowledged(3)
        async with connected(tmp_path, active) as link:
            await link.send(Stored(1, history, 1))
            await take_snapshot(link)
            assert active.sender.lag().changes == 3


async def test_an_earlier_active_appliance_is_refused(tmp_path: Path) -> None:
    async with asyncio.timeout(SECONDS), replicated(tmp_path, epoch=5) as (active, standby):
        active.database.put("thing", "a", 1, None)
        await active.sender.until_acknowledged(1)
        active.epoch = 4
        active.database.put("thing", "b", 1, None)
        await until(lambda: "epoch 4 has ended: epoch 5 has begun" in standby.ends)
        assert [row[0] for row in tables_of(tmp_path / "standby.db")["thing"]] == ["a"]
        reason = "the standby has seen epoch 5, and this appliance is active in 4"
        await until(lambda: f"the active appliance refuses: {reason}" in standby.ends)
        assert active.sender.lag().reason == reason
        active.epoch = 6
        await active.sender.until_acknowledged(2)
        await require_equal(tmp_path, active)
        assert standby.replica.position.epoch == 6


async def test_a_new_link_ends_the_earlier_one(tmp_path: Path) -> None:
    async with active_side(tmp_path) as active, connected(tmp_path, active) as silent:
        await silent.send(Stored(0, "", 0))
        await silent.receive(10)
        async with standby_side(tmp_path, active):
            active.database.put("thing", "a", 1, None)
            await active.sender.until_acknowledged(1)
            with pytest.raises(ReplicationError):
                while True:
                    await silent.receive(10)


async def test_a_quiet_link_stays_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replication_sender, "_HEARTBEAT_SECONDS", 0.05)
    async with active_side(tmp_path) as active, connected(tmp_path, active) as link:
        await link.send(Stored(0, "", 0))
        await take_snapshot(link)
        for _ in range(5):
            await link.send(Stored(1, active.database.history, 0))
            assert await link.receive(10) == Changes(1, active.database.history, 1, [])


async def test_a_silent_standby_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replication_sender, "_SILENCE_SECONDS", 0.5)
    async with active_side(tmp_path) as active:
        for number in range(20):
            active.database.put("tree", 1, bytes(1 << 20), float(number))
        async with connected(tmp_path, active) as link:
            await link.send(Stored(0, "", 0))
            await until(lambda: active.sender.lag().connected)
            await until(lambda: not active.sender.lag().connected)


async def test_a_caller_who_waits_learns_of_the_end(tmp_path: Path) -> None:
    async with active_side(tmp_path) as active:
        active.database.put("thing", "a", 1, None)
        waiting = asyncio.create_task(active.sender.until_acknowledged(1))
        await until(lambda: active.sender.lag().waiting_since is not None)
        async with connected(tmp_path, active) as link:
            await link.send(Stored(0, "", 0))
            await link.receive(10)
            active.sender.close()
            with pytest.raises(ReplicationError, match="no longer active"):
                await waiting
            await until(lambda: not active.sender.lag().connected)
        size = active.sender.lag().bytes
        active.database.put("thing", "b", 1, None)
        assert active.sender.lag().bytes == size
        assert active.sender.lag().waiting_since is None


@pytest.mark.parametrize("receiving", [True, False])
async def test_an_appliance_that_reads_nothing_does_not_hold_the_link(
    monkeypatch: pytest.MonkeyPatch, *, receiving: bool
) -> None:
    monkeypatch.setattr(replication_frames, "_WRITE_SECONDS", 0.1)
    link, other = await a_link()
    with pytest.raises(ReplicationError, match=f"{'sent' if receiving else 'took'} nothing for 0.1 s"):
        if receiving:
            await link.receive(0.1)
        else:
            await link.send(bytes(64 << 20))
    await link.close()
    other.close()


async def test_only_the_known_certificate_is_accepted(tmp_path: Path) -> None:
    certificates(tmp_path)
    homes = {name: tmp_path / name for name in ("strange", "old", "mistrusting")}
    for home in homes.values():
        home.mkdir()
    strange = make_link_certificate()
    theirs = (tmp_path / "certificates-active" / CERTIFICATE).read_text()
    files = (tmp_path / "certificates-standby" / name for name in (CERTIFICATE, KEY))
    own = LinkCertificate(*(file.read_text() for file in files))
    other = link_context(strange, theirs, homes["strange"], server=False)
    none = ssl.create_default_context(cadata=theirs)
    none.check_hostname = False
    old = link_context(own, theirs, homes["old"], server=False)
    old.minimum_version, old.maximum_version = ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_2
    mistrusting = link_context(own, strange.certificate, homes["mistrusting"], server=False)
    async with active_side(tmp_path) as active:
        for context in (other, none, old, mistrusting, None):
            with pytest.raises((ReplicationError, OSError)):
                reader, writer = await asyncio.open_connection("127.0.0.1", active.port, ssl=context)
                link: ReplicationLink[FromActive] = ReplicationLink(reader, writer, FromActive)
                try:
                    await link.send(Stored(0, "", 0))
                    await link.receive(10)
                finally:
                    await link.close()
            assert not active.sender.lag().connected
        async with standby_side(tmp_path, active):
            await active.sender.until_acknowledged(0)
            await until(lambda: active.sender.lag().caught_up)


async def test_connections_without_a_handshake_are_limited(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(replication, "_HANDSHAKE_SECONDS", 0.5)
    async with active_side(tmp_path) as active:
        idle = [socket.create_connection(("127.0.0.1", active.port)) for _ in range(40)]
        async with standby_side(tmp_path, active):
            loop = asyncio.get_running_loop()
            for connection in idle[-20:]:
                connection.setblocking(False)
                assert await loop.sock_recv(connection, 1) == b""
            assert not active.sender.lag().connected
            await until(lambda: active.sender.lag().caught_up)
            for connection in idle:
                connection.close()


Streams = tuple[asyncio.StreamReader, asyncio.StreamWriter]


async def pair_of_streams() -> tuple[Streams, Streams]:
    here, there = socket.socketpair()
    return await asyncio.open_connection(sock=here), await asyncio.open_connection(sock=there)


async def a_link() -> tuple[ReplicationLink[FromActive], asyncio.StreamWriter]:
    """Return a link, and the other end's writer."""
    ends, (_, other) = await pair_of_streams()
    return ReplicationLink(*ends, FromActive), other


async def test_a_standby_follows_only_an_accepted_epoch(tmp_path: Path) -> None:
    replica = Replica(tmp_path / "standby.db", SCHEMA, failed=pytest.fail)
    for message in (Changes(7, "", 1, [Put("mark", [(1,)])]), SnapshotBegin(7, "h", 1)):
        ends, others = await pair_of_streams()
        link: ReplicationLink[Stored | Refused] = ReplicationLink(*others, Stored | Refused)
        receiver = ReplicationReceiver(replica, lambda epoch: epoch == 8)
        following = asyncio.create_task(receiver.follow(*ends))
        async with asyncio.timeout(SECONDS):
            assert await link.receive(10) == Stored(0, "", 0)
            await link.send(message)
            reason = "an appliance of epoch 7 is not accepted as the active one"
            assert await link.receive(10) == Refused(reason)
            with pytest.raises(ReplicationError, match=reason):
                await following
        await link.close()
    assert replica.position == Stored(0, "", 0)
    replica.close()


async def test_a_link_that_ends_in_a_snapshot_leaves_nothing_open(tmp_path: Path) -> None:
    replica = Replica(tmp_path / "standby.db", SCHEMA, failed=pytest.fail)
    ends, others = await pair_of_streams()
    link: ReplicationLink[Stored] = ReplicationLink(*others, Stored)
    following = asyncio.create_task(ReplicationReceiver(replica, lambda _epoch: True).follow(*ends))
    async with asyncio.timeout(SECONDS):
        for message in (SnapshotBegin(7, "h", 1), SnapshotRows([Put("mark", [(1,)])])):
            await link.receive(10)
            await link.send(message)
        await link.receive(10)
        await link.close()
        with pytest.raises(ReplicationError, match="closed the link"):
            await following
    with contextlib.closing(sqlite3.connect(tmp_path / "standby.db", timeout=0)) as other:
        other.execute("INSERT INTO mark VALUES (2)")
    assert replica.position == Stored(0, "", 0)
    replica.close()


def two_states(directory: Path) -> tuple[StateStore, Replica]:
    for name in ("active", "standby"):
        (directory / name).mkdir()
    store = StateStore(directory / "active", failed=pytest.fail, kind=InlineDatabase)
    return store, Replica(directory / "standby" / "state.db", STATE_SCHEMA, failed=pytest.fail)


async def test_a_standby_can_take_over_the_whole_state(tmp_path: Path) -> None:
    store, replica = two_states(tmp_path)
    node = IncarnationRow("k", "/n", "10.0.0.1", "http://r:1/", "10.0.0.2", 1, 2, True, "live", 1.5, (3, 4))
    token, _text = make_token("alice", "viewer", now=1000.0, seconds=60)

    def save(key: str) -> None:
        store.save_incarnation(node._replace(key=key))
        store.save_registration(RegistrationRow(key, "publication", "/a", "*", 1))
        store.save_permission(PermissionRow(key, "topic", "/a", "10.0.0.9", "/listener"))
        store.note_parameter(f"/{key}", [1.5, {"c": b"x"}])
        store.parameter_owned(f"/{key}/x", "10.0.0.8")
        store.parameters_disowned(f"/{key}")
        store.save_tokens(token)
        store.save_token_use(token.id, 5)
        store.save_setting(key, "value")
        store.hosts.save(HostRow(key, f"10.1.0.{key}", "ab", 5.0, 1.0, None))
        store.hosts.save_revoked(RevokedCertificateRow(key, "n", 4.0, 9.0))
        store.hosts.forget_revoked("0")
        store.hosts.save_block(HostBlockRow(f"10.1.0.{key}", 4.0, "alice", ""))
        store.save_revision(RevisionRow(int(key), "text", "p.ini", 1.0, "disk", "note"))

    save("1")
    store.save_parameters({"1": [1.5]})
    sender = ReplicationSender(store.database, lambda: 1)
    ends, others = await pair_of_streams()
    tasks = [
        asyncio.create_task(sender.serve(*ends)),
        asyncio.create_task(ReplicationReceiver(replica, lambda _epoch: True).follow(*others)),
    ]
    async with asyncio.timeout(SECONDS):
        await sender.until_acknowledged(store.database.number)
        save("2")
        store.forget_incarnation("1")
        await sender.until_acknowledged(store.database.number)
    sender.close()
    await asyncio.gather(*tasks, return_exceptions=True)
    replica.close()
    await asyncio.to_thread(store.close)
    expected, found = (
        StateStore(tmp_path / name, failed=pytest.fail, kind=InlineDatabase) for name in ("active", "standby")
    )
    for table in found.database.tables:
        query = f"SELECT * FROM {table}"  # noqa: S608  a table of the schema
        assert found.database.query(query) == expected.database.query(query), table
    assert found.load_registry()[0] == [node._replace(key="2")]
    assert found.load_parameters() == {"1": [1.5]}
    assert found.database.number == expected.database.number
    expected.close()
    found.close()


async def test_an_obstacle_to_a_takeover_is_reported_while_the_link_is_open(tmp_path: Path) -> None:
    store, replica = two_states(tmp_path)
    sender = ReplicationSender(store.database, lambda: 1)
    revisions: list[int] = []
    obstacles: list[str] = [""]

    def revised() -> None:
        revisions.append(replica.position.number)
        obstacles.append(f"check {len(revisions)}")

    ends, others = await pair_of_streams()
    receiver = ReplicationReceiver(
        replica, lambda _epoch: True, obstacle=lambda: obstacles[-1], revised=revised
    )
    tasks = [asyncio.create_task(sender.serve(*ends)), asyncio.create_task(receiver.follow(*others))]
    changes: list[Callable[[], None]] = [
        lambda: None,  # the snapshot
        lambda: store.save_revision(RevisionRow(1, "text", "p.ini", 1.0, "disk", "note")),
        lambda: store.save_monitor_revision(MonitorRevisionRow(1, "{}", 1.0, "disk", "note")),
        lambda: store.save_setting(SWITCHES, "{}"),
    ]
    async with asyncio.timeout(SECONDS):
        for number, change in enumerate(changes, 1):
            store.save_setting("name", "value")
            change()
            await sender.until_acknowledged(store.database.number)
            assert sender.lag().obstacle == f"check {number}"  # with what it acknowledges
            assert (len(revisions), revisions[-1]) == (number, store.database.number)
        for obstacle in ("other keys", "x" * 600, ""):
            obstacles.append(obstacle)
            store.save_setting("name", obstacle)
            await until(lambda expected=obstacle[:500]: sender.lag().obstacle == expected)  # type: ignore[misc]  # mypy infers no type for a lambda's default
        before = len(revisions)
        obstacles.append("a port")
        store.save_setting("name", "")
        await until(lambda: sender.lag().obstacle == "a port")
        assert len(revisions) == before
        tasks[1].cancel()
        await until(lambda: not sender.lag().connected)
        assert sender.lag().obstacle == ""
    sender.close()
    await asyncio.gather(*tasks, return_exceptions=True)
    replica.close()
    await asyncio.to_thread(store.close)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"\xff\xff\xff\xff", "a frame of 4294967295 bytes"),
        (b"\x08\x00\x00\x01", "a frame of 134217729 bytes; at most 134217728"),
        (b"\x00\x00\x00\x00", "malformed"),
        (b"\x00\x00\x00\x01\xc1", "malformed"),
        (b"\x00\x00\x00\x10half", "closed the link"),
        (b"\x00\x00", "closed the link"),
    ],
)
async def test_a_bad_frame_ends_the_link(data: bytes, reason: str) -> None:
    link, other = await a_link()
    other.write(data)
    other.close()
    with pytest.raises(ReplicationError, match=reason):
        await link.receive(allowed(10))
    await link.close()


@pytest.mark.parametrize(
    "message",
    [
        ["changes", 1, "h", 1, [["drop", "thing"]]],
        ["changes", 1, "h", 1, ["DROP TABLE thing"]],
        ["changes", -1, "h", 1, []],
        ["changes", 1 << 63, "h", 1, []],
        ["changes", 1, "h" * 65, 1, []],
        ["rows", [["delete", "thing", [["name", "=", "a"]]]]],
        ["sql", "DROP TABLE thing"],
        [[[[[[]]]]]],
        ["changes", 1, "h", 1, [["put", "thing", 7]]],
    ],
)
async def test_a_message_of_another_form_ends_the_link(message: Any) -> None:
    link, other = await a_link()
    body = msgspec.msgpack.encode(message)
    other.write(len(body).to_bytes(4, "big") + body)
    with pytest.raises(ReplicationError, match="malformed"):
        await link.receive(allowed(10))
    other.close()
    await link.close()


async def test_a_change_too_large_for_a_frame_is_an_error_with_a_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with asyncio.timeout(SECONDS), replicated(tmp_path) as (active, standby):
        await until(lambda: active.sender.lag().caught_up)
        for module in (replication_frames, replication_sender):
            monkeypatch.setattr(module, "LARGEST_FRAME", 100_000)
        active.database.put("tree", 1, bytes(200_000), 1.0)
        await until(lambda: len(standby.ends) > 2)
        assert "a change has 200034 bytes, and the standby gets at most 100000" in active.sender.lag().reason
        assert standby.replica.position.number == 0
        active.database.put("tree", 1, bytes(20_000), 1.0)
        await active.sender.until_acknowledged(2)
        await require_equal(tmp_path, active)


async def test_the_standby_tells_why_it_refuses(tmp_path: Path) -> None:
    more = SCHEMA + "CREATE TABLE IF NOT EXISTS newer (name TEXT PRIMARY KEY) WITHOUT ROWID;"
    async with active_side(tmp_path, schema=more) as active:
        active.database.put("newer", "a")
        async with standby_side(tmp_path, active) as standby:
            await until(lambda: any("no table 'newer'" in end for end in standby.ends))
            await until(
                lambda: "the standby refuses: a change does not fit: the" in active.sender.lag().reason
            )


INTRODUCTION = Introduction(b"request", "0" * 64, "10.0.0.3", "")


async def test_a_standby_introduces_itself_once_an_hour(tmp_path: Path) -> None:
    replica, made = Replica(tmp_path / "standby.db", SCHEMA, failed=pytest.fail), list[Introduction]()
    ends, others = await pair_of_streams()
    link: ReplicationLink[FromStandby] = ReplicationLink(*others, FromStandby)
    receiver = ReplicationReceiver(replica, lambda _epoch: True, lambda: made[-1] if made else None)
    following = asyncio.create_task(receiver.follow(*ends))

    async def answers() -> list[object]:
        await link.send(Changes(1, "", 1, []))
        return [await link.receive(10) for _ in range(1 + len(made))]

    async with asyncio.timeout(SECONDS):
        assert isinstance(await link.receive(10), Stored)
        assert isinstance((await answers())[0], Stored)
        made.append(INTRODUCTION)
        assert (await answers())[1] == INTRODUCTION
        await link.send(Changes(1, "", 1, []))
        await link.send(Changes(1, "", 1, []))
        assert [type(await link.receive(10)) for _ in range(2)] == [Stored, Stored]
    await link.close()
    with contextlib.suppress(ReplicationError):
        await following
    replica.close()


async def test_an_introduction_is_not_an_acknowledgement(tmp_path: Path) -> None:
    database = InlineDatabase(tmp_path / "state.db", SCHEMA, failed=pytest.fail)
    sender, heard = ReplicationSender(database, lambda: 1), list[Introduction]()
    sender.on_introduction(heard.append)
    ends, others = await pair_of_streams()
    serving = asyncio.create_task(sender.serve(*ends))
    link: ReplicationLink[FromActive] = ReplicationLink(*others, FromActive)
    async with asyncio.timeout(SECONDS):
        await link.send(Stored(0, "", 0))
        for _ in range(3):
            await link.send(INTRODUCTION)
        while len(heard) < 3:
            await asyncio.sleep(0)
        assert not serving.done()
        await link.close()
        with pytest.raises(ReplicationError):
            await serving
        ends, others = await pair_of_streams()
        link = ReplicationLink(*others, FromActive)
        await link.send(INTRODUCTION)
        with pytest.raises(ReplicationError, match="did not send its position first"):
            await sender.serve(*ends)
    await link.close()
    sender.close()
    await asyncio.to_thread(database.close)


@pytest.mark.parametrize(
    "bad",
    [
        {"endpoint": "10.0.0.3\n  local { }"},
        {"endpoint": ""},
        {"pin": 'sha256//"; reboot; "'},
        {"key": "0"},
        {"request": 20_000 * b"x"},
    ],
    ids=["a line of swanctl.conf", "no address", "a shell command", "no fingerprint", "a long request"],
)
async def test_an_introduction_cannot_write_into_hosts_files(bad: dict[str, str | bytes]) -> None:
    """Hosts run scripts with these values."""
    fields = msgspec.structs.asdict(INTRODUCTION) | bad
    with pytest.raises(msgspec.ValidationError):
        msgspec.msgpack.decode(msgspec.msgpack.encode(Introduction(**fields)), type=Introduction)


async def test_an_order_to_hand_over_is_refused_with_the_reason_or_ends_the_link(tmp_path: Path) -> None:
    store, replica = two_states(tmp_path)
    wanted = asyncio.Event()
    sender = ReplicationSender(store.database, lambda: 1, switchover_wanted=wanted.set)
    receiver = ReplicationReceiver(replica, lambda _epoch: True)
    with pytest.raises(ReplicationError, match="not connected"):
        await receiver.want_switchover()
    ends, others = await pair_of_streams()
    tasks = [asyncio.create_task(sender.serve(*ends)), asyncio.create_task(receiver.follow(*others))]
    async with asyncio.timeout(SECONDS):
        await sender.until_acknowledged(store.database.number)
        for reason in ("b is blind", ""):
            order = asyncio.create_task(receiver.want_switchover())
            await wanted.wait()
            wanted.clear()
            if reason:
                await sender.refuse_switchover(reason)
            else:
                sender.close()
            assert await order == reason
        ends, others = await pair_of_streams()
        tasks.append(asyncio.create_task(receiver.follow(*others)))
        await ends[0].read(1)  # it follows now
        with pytest.raises(ReplicationError, match="does not answer"):
            await receiver.want_switchover()
        ends[1].close()
    await asyncio.gather(*tasks, return_exceptions=True)
    replica.close()
    store.close()
