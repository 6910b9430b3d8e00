import asyncio
import json
import re
import ssl
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pytest

from appliance.features.fleet import connection
from appliance.features.fleet.bundle_link import BundleOffered, BundleStated
from appliance.features.fleet.connection import CollectorConnection, CollectorError, robot_connection
from appliance.features.fleet.process import Poller
from appliance.features.fleet.segment_process import SegmentPusher
from appliance.features.fleet.verified_bundles import VerifiedBundles
from appliance.formats.fleet_membership import Invitation
from fleet.tests.support.bundle_site import GROUP, ROBOT, SITE
from fleet.tests.support.fleet_certificates import FleetAuthority
from tests.support.audit import decision
from tests.support.command import rosrv
from tests.support.lying_collector import Lie, Visitor, lying_collector
from tests.support.waiting import allowed, eventually
from tests.unit.audit.conftest import MakeLog, Notary, key, make_log, notary, path
from tests.unit.features.fleet.robot_site import RobotSite

pytestmark = pytest.mark.nightly

__all__ = ["MakeLog", "Notary", "key", "make_log", "notary", "path"]  # fixtures and their types

_SECONDS = 0.4
Client = Callable[[str], str]


def sends(data: bytes, more: bytes = b"", pause: float = 0.02) -> Lie:
    """Send this, and then more of it until the end, with pauses in seconds."""

    def lie(visitor: Visitor) -> None:
        visitor.stream.sendall(data)
        if more:
            visitor.repeat(more, pause)

    return lie


def closes(visitor: Visitor) -> None:
    visitor.stream.close()


def closes_midway(visitor: Visitor) -> None:
    sends(WITH_LENGTH + b"{")(visitor)
    visitor.stream.close()


def demands_a_login(visitor: Visitor) -> None:
    visitor.give(b"\x1b[2Jno", "401 Unauthorized", "Retry-After: 99999999999999999999")


HEAD = b"HTTP/1.1 200 OK\r\n"
WITH_LENGTH = HEAD + b"Content-Length: 500\r\n\r\n"
IN_HANDSHAKE = {
    "drips the handshake": (sends(b"\x16\x03\x03\x40\x00", b"\x02"), "takes more than"),
    "is silent in the handshake": (Visitor.wait, "takes more than"),
    "closes in the handshake": (closes, "EOF|reset|ended"),
}
IN_ANSWER: dict[str, tuple[Lie, str]] = {
    "is silent": (Visitor.wait, "takes more than"),
    "closes": (closes, "disconnected|reset|EOF|ended"),
    "drips the head": (sends(HEAD + b"X: ", b"x"), "takes more than"),
    "sends interim answers": (sends(b"", b"HTTP/1.1 100 Continue\r\n\r\n", 0.001), "takes more than"),
    "sends an endless head": (sends(HEAD + b"X: ", b"x" * 65_536, 0), "too long|exceed"),
    "drips the body": (sends(WITH_LENGTH, b"x"), "takes more than"),
    "sends an endless body": (sends(HEAD + b"\r\n", bytes(1 << 16), 0), "more than .* bytes|exceed"),
    "closes midway": (closes_midway, "closed connection|incomplete|EOF|violation"),
    "redirects": (lambda one: one.give(b"", "307 Temporary Redirect", "Location: https://127.0.0.1:1/"), "307"),
    "compresses": (
        lambda one: one.give(b"\x1f\x8b\x08", "200 OK", "Content-Encoding: gzip"), "the answer is compressed"
    ),
    "is not HTTP": (sends(b"SSH-2.0-OpenSSH_9.2\r\n"), "illegal|disconnected"),
    "demands a login": (demands_a_login, r"401: \\x1b\[2Jno"),
}  # fmt: skip


@pytest.fixture
def site(tmp_path: Path) -> RobotSite:
    return RobotSite(tmp_path / "site")


@pytest.fixture
def authority(site: RobotSite) -> FleetAuthority:
    return site.authority


@pytest.fixture
def pusher(authority: FleetAuthority, make_log: MakeLog, path: Path, tmp_path: Path) -> Iterator[Client]:
    log = make_log(checkpoint_every=10)
    for number in range(10):
        log.record(decision(log, number))
    asyncio.run(asyncio.wait_for(log.wait_signed(), 60))

    def step(url: str) -> str:
        made = SegmentPusher(
            path, tmp_path, robot_connection(url, authority.ca, *authority.issue(ROBOT)), b""
        )
        made.step()
        assert (made.progress.sent, made.progress.sequence) == (0, 0)
        made.close()
        return made.progress.trouble

    yield step


@pytest.fixture
def poller(site: RobotSite, tmp_path: Path) -> Client:
    def step(url: str) -> str:
        authority = site.authority
        collector = robot_connection(url, authority.ca, *authority.issue(ROBOT))
        bundles = VerifiedBundles(
            tmp_path / "robot", site.first_root, collector, site=SITE, group=GROUP, robot=ROBOT
        )
        offered: list[BundleOffered] = []
        made = Poller(bundles, collector, (SITE, GROUP), 60.0, BundleStated, offered.append)
        made.step()
        collector.close()
        assert not offered
        return made.progress.trouble

    return step


@pytest.fixture
def joiner(authority: FleetAuthority, tmp_path: Path) -> Client:
    authority.server_context.verify_mode = ssl.CERT_OPTIONAL  # a robot that joins has no certificate yet
    state, file = tmp_path / "joining", tmp_path / "arm1.json"
    (state / "control").mkdir(parents=True)
    (state / "control" / "audit.pub").write_text("the public key")

    def step(url: str) -> str:
        invitation = Invitation(
            robot="arm1", collector=url, authority=authority.ca.read_text(), receipt_key="",
            token=f"rosrv-join_{'a' * 43}", expires=0.0,
        )  # fmt: skip
        file.write_bytes(msgspec.json.encode(invitation))
        done = rosrv("fleet", "join", str(file), "--state", str(state))
        assert done.returncode == 1
        assert not (state / "joined").exists()
        return done.stderr

    return step


@pytest.fixture(params=["pusher", "poller", "joiner"])
def client(request: pytest.FixtureRequest) -> Client:
    found: Client = request.getfixturevalue(request.param)
    return found


@contextmanager
def connected(authority: FleetAuthority, answer: Lie) -> Iterator[CollectorConnection]:
    with lying_collector(authority.server_context, answer) as url:
        made = robot_connection(url, authority.ca, *authority.issue(ROBOT))
        yield made
        made.close()


def timely(client: Client, url: str, reason: str, patch: pytest.MonkeyPatch) -> None:
    if "takes more than" in reason:
        patch.setattr(connection, "_EXCHANGE_SECONDS", _SECONDS)
    began = time.monotonic()
    trouble = client(url)
    assert time.monotonic() - began < 2 * _SECONDS + allowed(3)  # two exchanges, keys and files
    assert re.search(reason, trouble), trouble


@pytest.mark.parametrize("name", IN_HANDSHAKE)
def test_a_collector_that_misbehaves_in_the_handshake(
    name: str, client: Client, authority: FleetAuthority, monkeypatch: pytest.MonkeyPatch
) -> None:
    lie, reason = IN_HANDSHAKE[name]
    with lying_collector(authority.server_context, Visitor.wait, lie) as url:
        timely(client, url, reason, monkeypatch)


@pytest.mark.parametrize("name", IN_ANSWER)
def test_a_collector_that_misbehaves_in_its_answer(
    name: str, client: Client, authority: FleetAuthority, monkeypatch: pytest.MonkeyPatch
) -> None:
    lie, reason = IN_ANSWER[name]

    def answer(visitor: Visitor) -> None:
        visitor.body(visitor.request())
        lie(visitor)

    with lying_collector(authority.server_context, answer) as url:
        timely(client, url, reason, monkeypatch)


@pytest.mark.parametrize("name", IN_ANSWER)
def test_a_collector_that_misbehaves_after_an_upload(
    name: str, pusher: Client, authority: FleetAuthority, monkeypatch: pytest.MonkeyPatch
) -> None:
    lie, reason = IN_ANSWER[name]
    with lying_collector(authority.server_context, honest_until_the_upload(lie)) as url:
        timely(pusher, url, reason, monkeypatch)


def honest_until_the_upload(lie: Lie) -> Lie:
    def answer(visitor: Visitor) -> None:
        visitor.request()
        visitor.give(json.dumps({"robot": ROBOT, "log": "", "number": 0, "hashes": []}).encode())
        visitor.body(visitor.request())
        lie(visitor)

    return answer


@pytest.mark.parametrize("pause", [0.0, 0.02])
def test_an_upload_that_the_collector_does_not_take(
    pause: float, authority: FleetAuthority, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "_EXCHANGE_SECONDS", _SECONDS)
    monkeypatch.setattr(connection, "_SLOWEST_UPLOAD", 1 << 40)
    size = 64 << 20

    def answer(visitor: Visitor) -> None:
        visitor.request()
        while not visitor.ending.wait(pause or 0.1):
            if pause:
                visitor.stream.recv(1)

    with connected(authority, answer) as collector:
        began = time.monotonic()
        with pytest.raises(CollectorError, match="takes more than"):
            collector.put("x", iter([bytes(1 << 20)] * 64), size)
        assert time.monotonic() - began < _SECONDS + allowed(1)


def test_the_reason_of_an_early_refusal_arrives(authority: FleetAuthority) -> None:
    def answer(visitor: Visitor) -> None:
        visitor.request()
        visitor.give(b"the disk is full", "503 Service Unavailable", "Retry-After: 60")
        visitor.wait()

    refusal = pytest.raises(CollectorError, match="503: the disk is full")
    with connected(authority, answer) as collector, refusal as refused:
        collector.put("x", iter([b"x" * 1000]), 1000)
    assert (refused.value.status, refused.value.wait) == (503, 60.0)


def test_a_connection_is_used_again_and_replaced_files_apply_to_the_next(authority: FleetAuthority) -> None:
    visitors: list[Visitor] = []

    def answer(visitor: Visitor) -> None:
        visitors.append(visitor)
        for _ in range(2):
            visitor.request()
            visitor.give(b"here")

    with connected(authority, answer) as collector:
        certificate = authority.folder / f"{ROBOT}.pem"
        assert [collector.get("x"), collector.get("x")] == [b"here", b"here"]
        assert len(visitors) == 1
        eventually(lambda: not collector.is_open, "the collector closes the connection")
        kept = certificate.read_bytes()
        certificate.write_text("rubbish")
        with pytest.raises(CollectorError, match=f"{ROBOT}.pem"):
            collector.get("x")
        certificate.write_bytes(kept)
        assert collector.get("x") == b"here"
        assert len(visitors) == 2


def test_an_event_stream_ends_when_it_is_silent(
    authority: FleetAuthority, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "_SILENT_SECONDS", 1.5)

    def answer(visitor: Visitor) -> None:
        visitor.request()
        visitor.stream.sendall(b"HTTP/1.1 200 OK\r\n\r\n")
        for _ in range(20):
            visitor.ending.wait(0.1)
            visitor.stream.sendall(b": still here\n\n")
        visitor.wait()

    with connected(authority, answer) as collector:
        heard: list[bytes] = []
        with pytest.raises(CollectorError, match="takes more than"):
            heard.extend(collector.events("x"))
        assert b"".join(heard).count(b"still here") == 20
