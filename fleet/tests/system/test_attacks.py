import gzip
import json
import os
import shutil
import socket
import ssl
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import pytest

from appliance.features.fleet.connection import CollectorConnection, CollectorError
from appliance.formats.segments import SegmentSummary, write_segment
from fleet.tests.support.fleet_site import FleetRobot, FleetSite, running
from tests.support.certificates import Certificates, make_certificates
from tests.support.small_disk import small_disk
from tests.support.waiting import eventually

MakeRobot = Callable[..., FleetRobot]


def segment(robot: FleetRobot, number: int) -> tuple[SegmentSummary, bytes]:
    lines: list[bytes] = []
    summary = write_segment(robot.log_file, number, lines.append)
    assert summary is not None
    return summary, b"".join(lines)


def put(
    site: FleetSite, certificates: Certificates, summary: SegmentSummary, body: bytes, **headers: str
) -> httpx.Response:
    end = summary.header.end
    path = f"/v1/logs/{end.log}/segments/{end.number}/{summary.name}"

    def answer() -> httpx.Response | None:
        found = client.put(path, content=body, headers={"Content-Encoding": "gzip"} | headers)
        return None if "has to pause" in found.text else found

    with site.client(certificates) as client:
        return eventually(answer, "the robot may push again", 300)


def test_a_robot_cannot_push_the_log_of_another(site: FleetSite, make_robot: MakeRobot) -> None:
    victim, thief = make_robot("victim"), make_robot("thief")
    victim.record(10)
    summary, body = segment(victim, 1)
    answer = put(site, thief.certificates, summary, gzip.compress(body))
    assert answer.status_code == 422
    assert "not a valid segment of thief" in answer.json()["detail"]
    assert site.stored() == 0


def test_a_stolen_certificate_forges_nothing(site: FleetSite, make_robot: MakeRobot) -> None:
    victim = make_robot("victim")
    victim.record(10)
    forger = FleetRobot(site, "forger", enrolled=False)
    forger.record(10)
    summary, body = segment(forger, 1)
    assert put(site, victim.certificates, summary, gzip.compress(body)).status_code == 422
    changed = body.replace(b'"decision":"allow"', b'"decision":"deny"', 1)
    summary, body = segment(victim, 1)
    assert put(site, victim.certificates, summary, gzip.compress(changed)).status_code == 422
    forger.close()
    assert site.stored() == 0


def test_an_unknown_certificate_does_not_connect(
    site: FleetSite, make_robot: MakeRobot, tmp_path: Path
) -> None:
    robot = make_robot("arm1")
    robot.record(5)
    summary, body = segment(robot, 1)
    with pytest.raises(httpx.TransportError):
        put(site, make_certificates(tmp_path / "other"), summary, gzip.compress(body))
    with site.client() as client:
        assert client.get(f"/v1/logs/{'0' * 32}").status_code == 403


def test_a_removed_robot_is_refused_at_once(site: FleetSite, make_robot: MakeRobot) -> None:
    robot = make_robot("arm1")
    robot.record(5)
    summary, body = segment(robot, 1)
    site.run("robot", "remove", "arm1")
    assert put(site, robot.certificates, summary, gzip.compress(body)).status_code == 403
    renewed = make_certificates(robot.folder / "renewed", authority="renewed")
    site.run("robot", "renew", "arm1", "--certificate", str(renewed.certificate))

    def accepted() -> bool:
        try:
            return put(site, renewed, summary, gzip.compress(body)).status_code == 201
        except httpx.TransportError:
            return False

    eventually(accepted, "the renewed certificate is accepted")
    assert put(site, robot.certificates, summary, gzip.compress(body)).status_code == 403


def test_a_replayed_segment_is_stored_once(site: FleetSite, make_robot: MakeRobot) -> None:
    robot = make_robot("arm1")
    robot.record(5)
    robot.push()
    summary, body = segment(robot, 1)
    for _ in range(3):
        assert put(site, robot.certificates, summary, gzip.compress(body)).status_code == 201
    site.indexed()
    assert site.stored() == 1
    assert len(site.search(event="decision")) == 5


def test_a_swapped_segment_is_refused(site: FleetSite, make_robot: MakeRobot) -> None:
    robot = make_robot("arm1")
    robot.record(30)
    (first, _), (second, body) = segment(robot, 1), segment(robot, 2)
    assert put(site, robot.certificates, first, gzip.compress(body)).status_code == 422
    assert (
        put(site, robot.certificates, second._replace(name="0" * 64), gzip.compress(body)).status_code == 422
    )
    assert site.stored() == 0


def test_a_withheld_segment_is_a_gap(site: FleetSite, make_robot: MakeRobot) -> None:
    robot = make_robot("arm1")
    robot.record(30)
    for number in (1, 3):
        summary, body = segment(robot, number)
        assert put(site, robot.certificates, summary, gzip.compress(body)).status_code == 201
    assert site.health()["robots"][0]["gaps"] == 1
    missing, late = segment(robot, 2)
    found = site.run("verify", "arm1", status=1).stdout
    assert f"records {missing.first} to {missing.last} are missing" in found
    assert put(site, robot.certificates, missing, gzip.compress(late)).status_code == 201
    assert site.health()["robots"][0]["gaps"] == 0
    site.run("verify", "arm1")


def test_a_second_history_is_reported(site: FleetSite, make_robot: MakeRobot) -> None:
    robot = make_robot("arm1")
    robot.record(5)
    robot.record(5, reason="first history")
    first = segment(robot, 2)
    robot.close()
    robot.rewind(1)
    robot.record(5, reason="second history")
    second = segment(robot, 2)
    robot.push()
    assert first[0].name != second[0].name
    assert put(site, robot.certificates, first[0], gzip.compress(first[1])).status_code == 201
    assert site.health()["robots"][0]["forks"] == 2
    assert "seals two histories" in site.run("verify", "arm1", status=1).stdout


def test_a_client_with_another_history_continues_from_the_common_part(
    site: FleetSite, make_robot: MakeRobot
) -> None:
    robot = make_robot("arm1")
    for _ in range(4):
        robot.record(10)
    robot.push()
    robot.close()
    robot.rewind(2)
    for _ in range(3):
        robot.record(10, reason="after the restore")
    assert robot.push().progress.sent in (4, 5)  # it sends the common segment again, to have its receipt
    site.indexed()
    assert len(site.search(text="after the restore", limit=1000)) == 30


@pytest.fixture
def strict(database: str, tmp_path: Path) -> Iterator[FleetSite]:
    limits = {"segment_bytes": 200_000, "upload_bytes": 50_000}
    with running(FleetSite(tmp_path / "site", database, limits)) as found:
        yield found


@pytest.fixture
def hasty(database: str, tmp_path: Path) -> Iterator[FleetSite]:
    limits = {"upload_seconds": 10.0, "header_seconds": 10.0}
    with running(FleetSite(tmp_path / "site", database, limits)) as found:
        yield found


def test_a_huge_segment_is_refused(strict: FleetSite) -> None:
    robot = FleetRobot(strict, "arm1", every=2000)
    robot.record(1000)
    summary, body = segment(robot, 1)
    assert put(strict, robot.certificates, summary, os.urandom(60_000)).status_code == 413
    bomb = put(strict, robot.certificates, summary, gzip.compress(body[:500] + b" " * 40_000_000))
    assert (bomb.status_code, "bytes" in bomb.text or "limit" in bomb.text) == (422, True)
    packed = gzip.compress(body)
    assert put(strict, robot.certificates, summary, packed).status_code in (413, 422)
    assert put(strict, robot.certificates, summary, packed[:1000]).status_code == 422
    assert put(strict, robot.certificates, summary, b"not gzip").status_code == 422
    assert put(strict, robot.certificates, summary, b"", **{"Content-Encoding": "br"}).status_code == 415
    assert strict.data is not None
    assert list((strict.data / "incoming").iterdir()) == []
    with pytest.raises(AssertionError, match="the collector answers 4"):
        robot.push()
    robot.close()


def test_a_slow_robot_is_cut_off(hasty: FleetSite) -> None:
    slow, other = FleetRobot(hasty, "slow"), FleetRobot(hasty, "other")
    other.record(5)
    context = ssl.create_default_context(cafile=hasty.server.ca)
    context.load_cert_chain(slow.certificates.certificate, slow.certificates.key)

    def connect() -> ssl.SSLSocket:
        plain = socket.create_connection(("127.0.0.1", hasty.port), 30)
        return context.wrap_socket(plain, server_hostname="127.0.0.1")

    with connect() as silent, connect() as half, connect() as slowly:
        half.sendall(b"GET /healthz HTTP/1.1\r\nHost: x\r\n")
        path = f"/v1/logs/{'0' * 32}/segments/1/{'0' * 64}"
        slowly.sendall(
            f"PUT {path} HTTP/1.1\r\nHost: x\r\nContent-Encoding: gzip\r\nContent-Length: 9999\r\n\r\nx".encode()
        )
        assert other.push().progress.sent == 1
        begun = time.monotonic()
        assert slowly.recv(1000).startswith(b"HTTP/1.1 408")
        assert silent.recv(1) == b""
        assert half.recv(1) == b""
        assert time.monotonic() - begun < 60
    slow.close()
    other.close()


def test_a_robot_has_one_upload_at_a_time(site: FleetSite) -> None:
    robot = FleetRobot(site, "arm1")
    robot.record(5)
    context = ssl.create_default_context(cafile=site.server.ca)
    context.load_cert_chain(robot.certificates.certificate, robot.certificates.key)
    plain = socket.create_connection(("127.0.0.1", site.port), 30)
    with context.wrap_socket(plain, server_hostname="127.0.0.1") as first:
        path = f"/v1/logs/{'0' * 32}/segments/1/{'0' * 64}"
        head = f"PUT {path} HTTP/1.1\r\nHost: x\r\nContent-Encoding: gzip\r\nContent-Length: 9\r\n\r\nx"
        first.sendall(head.encode())
        assert site.data is not None
        incoming = site.data / "incoming"
        eventually(lambda: list(incoming.iterdir()), "the first upload has begun")
        summary, body = segment(robot, 1)
        answer = put(site, robot.certificates, summary, gzip.compress(body))
        assert (answer.status_code, answer.headers["Retry-After"]) == (429, "2")
    robot.close()


def test_a_full_disk_refuses_and_recovers(database: str, tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", "2m") as disk:
        limits = {"reserve_bytes": 500_000}
        with running(FleetSite(tmp_path / "site", database, limits, disk / "data")) as site:
            robot = FleetRobot(site, "arm1")
            robot.record(10)
            robot.push()
            (disk / "filler").write_bytes(b"x" * (shutil.disk_usage(disk).free - 400_000))
            robot.record(10)
            pusher = robot.pusher()
            pause = pusher.step()
            assert "503" in pusher.progress.trouble
            assert pause >= 30  # half of Retry-After
            assert site.health()["disk"] is not None
            site.run("verify", "arm1")
            (disk / "filler").unlink()
            robot.push()
            site.indexed()
            assert json.loads(site.run("verify", "--json").stdout)["missing"] == 0
            robot.close()


def test_a_collector_with_another_key_is_not_believed(site: FleetSite, make_robot: MakeRobot) -> None:
    robot = make_robot("arm1")
    robot.record(10)
    pusher = robot.pusher()
    pusher.receipt_key = robot.public
    pusher.step()
    assert "wrong signature" in pusher.progress.trouble
    assert pusher.progress.sent == 0
    assert not (robot.folder / "state" / "receipts.ndjson").exists()


class _Busy(CollectorConnection):
    def get(self, path: str, longest: int = 0) -> bytes:
        raise CollectorError(f"not now: {path} {longest}", 503, 600.0)


def test_the_pause_grows_and_obeys_the_collector(site: FleetSite, make_robot: MakeRobot) -> None:
    robot = make_robot("arm1")
    robot.record(10)
    pusher = robot.pusher()
    pusher.jitter = lambda: 0.5
    site.kill()
    pauses = [pusher.step() for _ in range(9)]
    assert pauses == [0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 60.0, 60.0]
    pusher = robot.pusher()
    pusher.jitter = lambda: 0.5
    pusher.collector = _Busy(pusher.collector.url, ssl.create_default_context)
    assert pusher.step() == 600.0
