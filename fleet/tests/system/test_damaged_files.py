import gzip
from collections.abc import Callable
from pathlib import Path

import pytest

from appliance.base.atomic_files import write_whole
from fleet.tests.support.fleet_site import FleetRobot, FleetSite
from tests.support.waiting import eventually

MakeRobot = Callable[..., FleetRobot]


def test_the_file_of_a_robot(site: FleetSite, make_robot: MakeRobot) -> None:
    bad, good = make_robot("bad"), make_robot("good")
    assert site.data is not None
    file = site.data / "robots" / "bad.json"
    whole = file.read_bytes()
    write_whole(file, b"damaged", 0o600)
    eventually(lambda: str(file) in (site.health()["trouble"] or ""), "the damage is reported")
    for robot in (bad, good):
        robot.record(20)
        robot.push()
    assert site.run("robot", "list", status=1).stderr.count(str(file)) == 1
    file.write_bytes(whole)
    site.indexed()
    make_robot("later").push()


def test_the_file_of_a_robot_at_the_start(site: FleetSite, make_robot: MakeRobot) -> None:
    bad, good = make_robot("bad"), make_robot("good")
    for robot in (bad, good):
        robot.record(20)
    site.stop()
    assert site.data is not None
    file = site.data / "robots" / "bad.json"
    whole = file.read_bytes()
    file.write_bytes(b"damaged")
    site.start()
    good.push()
    rejected = bad.pusher()
    rejected.step()
    assert rejected.progress.trouble
    rejected.close()
    file.write_bytes(whole)
    eventually(lambda: site.health()["trouble"] is None, "the repair is noticed")
    eventually(bad.is_trusted, "the robot is trusted")
    bad.push()
    site.run("verify")


@pytest.mark.parametrize(
    "content",
    [b"", b"damaged", b"\x1f\x8b\x08\x00", gzip.compress(b'{"end":{"log":"\xff"}}')],
    ids=["empty", "no gzip", "cut", "no UTF-8"],
)
def test_the_newest_segment(content: bytes, site: FleetSite, make_robot: MakeRobot) -> None:
    robot = make_robot("arm1")
    robot.record(20)
    robot.push()
    site.indexed()
    newest = _segments(site)[-1]
    whole = newest.read_bytes()
    newest.write_bytes(content)
    robot.record(20)
    robot.push()
    assert newest.read_bytes() == whole
    _require_complete(site)


def test_a_segment_before_others(site: FleetSite, make_robot: MakeRobot) -> None:
    robot = make_robot("arm1")
    robot.record(20)
    pusher = robot.pusher()
    while pusher.step() == 0:
        pass
    newest = _segments(site)[-1]
    whole = newest.read_bytes()
    newest.write_bytes(b"damaged")
    robot.record(20)
    while pusher.step() == 0:
        pass
    assert not pusher.progress.trouble
    pusher.close()
    eventually(lambda: str(newest) in (site.health()["trouble"] or ""), "the damage is reported")
    site.run("verify", "arm1", status=1)
    newest.write_bytes(whole)
    site.stop()
    site.start()
    _require_complete(site)


def test_the_note_of_the_newest_segment(site: FleetSite, make_robot: MakeRobot) -> None:
    robot = make_robot("arm1")
    robot.record(20)
    robot.push()
    assert site.data is not None
    (site.data / "newest" / "arm1").write_bytes(b"\xff\xfe")
    assert site.health()["robots"][0]["number"] is None
    robot.record(20)
    robot.push()
    assert site.health()["robots"][0]["number"] == int(_segments(site)[-1].name.partition("-")[0])


def test_the_tokens(site: FleetSite, make_robot: MakeRobot) -> None:
    assert site.data is not None
    file = site.data / "tokens.json"
    whole = file.read_bytes()
    file.write_bytes(b"damaged")
    answer = site.get("/v1/health")
    assert (answer.status_code, answer.json()) == (
        503,
        {"detail": "a file of the collector is damaged; see its log"},
    )
    assert str(file) in (site.folder / "log").read_text()
    assert str(file) in site.run("token", "list", status=2).stderr
    robot = make_robot("arm1")
    robot.record(20)
    robot.push()
    file.write_bytes(whole)
    site.indexed()


def _require_complete(site: FleetSite) -> None:
    site.indexed()
    site.run("verify", "arm1")
    assert site.health()["robots"][0]["gaps"] == 0


def _segments(site: FleetSite) -> list[Path]:
    assert site.data is not None
    return sorted((site.data / "segments").rglob("*.gz"))
