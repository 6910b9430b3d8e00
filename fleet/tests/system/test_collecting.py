import json
import shutil
from collections.abc import Callable

import msgspec
import pytest

from appliance.formats.receipts import SegmentReceipt
from fleet.tests.support.fleet_site import FleetRobot, FleetSite
from tests.support.waiting import eventually

MakeRobot = Callable[..., FleetRobot]


def test_records_are_pushed_proven_and_found(site: FleetSite, make_robot: MakeRobot) -> None:
    for name in ("arm1", "arm2"):
        robot = make_robot(name)
        robot.record(35, reason=f"because of {name}")
        pusher = robot.push()
        assert pusher.progress.sequence >= 35
    site.indexed()
    found = site.search(topic="/cmd_*", limit=1000)
    assert {record["robot"] for record in found} == {"arm1", "arm2"}
    assert len(found) == 70
    assert [record["time"] for record in found] == sorted((record["time"] for record in found), reverse=True)
    assert len(site.search(text="BECAUSE of arm2", limit=1000)) == 35
    proofs = [json.loads(line) for line in site.run("verify", "--json").stdout.splitlines()]
    assert [(proof["robot"], proof["missing"], proof["ok"]) for proof in proofs] == [
        ("arm1", 0, True),
        ("arm2", 0, True),
    ]
    assert all(proof["records"] >= 35 for proof in proofs)


def test_each_segment_has_a_signed_receipt_on_the_robot(site: FleetSite, make_robot: MakeRobot) -> None:
    robot = make_robot("arm1")
    robot.record(35)
    robot.push()
    lines = (robot.folder / "state" / "receipts.ndjson").read_bytes().splitlines()
    receipts = [msgspec.json.decode(line, type=SegmentReceipt) for line in lines]
    assert all(receipt.is_signed(site.receipt_key) and receipt.robot == "arm1" for receipt in receipts)
    assert [receipt.first for receipt in receipts[1:]] == [receipt.last + 1 for receipt in receipts[:-1]]
    assert receipts[0].first == 1
    assert not msgspec.structs.replace(receipts[0], last=999).is_signed(site.receipt_key)


def test_a_restarted_client_continues_where_the_collector_is(site: FleetSite, make_robot: MakeRobot) -> None:
    robot = make_robot("arm1")
    robot.record(35)
    first = robot.push()
    robot.record(15)
    second = robot.push()
    assert second.progress.checkpoint > first.progress.checkpoint
    assert second.progress.sent == second.progress.checkpoint - first.progress.checkpoint


def test_a_restored_collector_gets_the_newer_segments_again(site: FleetSite, make_robot: MakeRobot) -> None:
    robot = make_robot("arm1")
    pusher = robot.pusher()
    robot.record(20)
    while pusher.step() == 0:
        pass
    site.stop()
    assert site.data is not None
    shutil.copytree(site.data, site.folder / "backup")
    site.start()
    robot.record(20)
    while pusher.step() == 0:
        pass
    assert pusher.progress.sequence == robot.sealed()
    site.stop()
    shutil.rmtree(site.data)
    shutil.copytree(site.folder / "backup", site.data)
    site.start()
    robot.record(20)
    while pusher.step() == 0:
        pass
    assert not pusher.progress.trouble
    assert pusher.progress.sequence == robot.sealed()
    pusher.close()
    (proof,) = map(json.loads, site.run("verify", "--json").stdout.splitlines())
    assert (proof["ok"], proof["missing"], proof["last"]) == (True, 0, robot.sealed())


def test_a_search_continues_with_its_cursor(site: FleetSite, make_robot: MakeRobot) -> None:
    robot = make_robot("arm1")
    robot.record(50)
    robot.push()
    site.indexed()
    everything = [one["id"] for one in site.search(limit=1000)]
    pages: list[str] = []
    cursor = None
    while True:
        page = site.get("/v1/search", limit=7, **({"cursor": cursor} if cursor else {})).json()
        pages += [record["id"] for record in page["records"]]
        cursor = page["cursor"]
        if cursor is None:
            break
    assert pages == everything
    assert len(set(pages)) == len(pages) >= 50


@pytest.mark.parametrize(
    ("words", "count"),
    [
        ({"host": "10.0.0.3"}, 20), ({"host": "10.0.0.[34]"}, 40), ({"caller": "/node1?"}, 20),
        ({"topic": "/cmd_1*"}, 55), ({"rule": "Publishers"}, 100), ({"rule": "/cmd_*"}, 100),
        ({"event": "decision"}, 100),
        ({"allow": "true"}, 100), ({"deny": "true"}, 0), ({"robot": "arm*", "event": "decision"}, 100),
        ({"robot": "leg*"}, 0), ({"since": "1h", "event": "decision"}, 100), ({"until": "2020-01-01"}, 0),
        ({"text": "100%"}, 0), ({"text": "registerpublisher"}, 100), ({"who": "*"}, 0), ({"category": "pub*"}, 100),
        ({"host": "' OR 1=1 --"}, 0), ({"host": "10.0.0.3\0"}, 0), ({"text": "a\0"}, 0),
    ],
)  # fmt: skip
def test_the_words_of_a_search(shared: FleetSite, words: dict[str, str], count: int) -> None:
    assert len(shared.search(limit=1000, **words)) == count


@pytest.mark.parametrize(
    "words",
    [
        {"since": "soon"},
        {"host": "*" * 9},
        {"host": "[z-a]*"},
        {"cursor": "x"},
        {"limit": "0"},
        {"host": "a" * 300},
    ],
)
def test_a_wrong_search_is_refused(shared: FleetSite, words: dict[str, str]) -> None:
    answer = shared.get("/v1/search", **words)
    assert answer.status_code == 422, answer.text
    assert answer.json()["detail"]


def test_a_search_needs_a_token(shared: FleetSite) -> None:
    for path in ("/v1/search", "/v1/health", "/metrics"):
        assert shared.get(path, token=None).status_code == 401
        assert shared.get(path, token="wrong").status_code == 401  # noqa: S106  not a secret
        assert shared.get(path).status_code == 200
    token = shared.run("token", "add", "brief").stdout.strip()
    assert shared.get("/v1/health", token=token).status_code == 200
    shared.run("token", "remove", "brief")
    assert shared.get("/v1/health", token=token).status_code == 401
    stored = (shared.folder / "data" / "tokens.json").read_text()
    assert shared.token not in stored


def test_the_command_line_searches(shared: FleetSite) -> None:
    lines = shared.run("search", "--topic", "/cmd_1*", "--limit", "1000", "--json").stdout.splitlines()
    assert len(lines) == 55
    assert shared.run("search", "--since", "soon", status=2).stderr.startswith(
        "rosrv-fleet: --since: 'soon' is not a valid time"
    )


def test_the_index_is_rebuilt_from_segments(site: FleetSite, make_robot: MakeRobot) -> None:
    robot = make_robot("arm1")
    robot.record(25, reason="a\0b", caller_id="/x\u202e")
    robot.push()
    site.indexed()
    before = site.search(limit=1000)
    assert len(before) >= 25
    site.run("reindex")
    assert site.search(limit=1000) == before


def test_a_damaged_segment_does_not_stop_reindex(site: FleetSite, make_robot: MakeRobot) -> None:
    damaged, other = make_robot("arm1"), make_robot("arm2")
    for robot in (damaged, other):
        robot.record(20)
        robot.push()
    site.indexed()
    assert site.data is not None
    file = sorted((site.data / "segments" / "arm1").rglob("*.gz"))[0]
    file.write_bytes(b"damaged")
    assert f"{file} is not indexed" in site.run("reindex", status=1).stderr
    assert len(site.search(robot="arm2", event="decision")) == 20
    assert 0 < len(site.search(robot="arm1", event="decision")) < 20


def test_a_silent_robot_is_reported(site: FleetSite, make_robot: MakeRobot) -> None:
    make_robot("arm1").record(5)
    site.stop()
    site.write_config(silent_seconds=0.1)
    site.start()
    eventually(lambda: site.health()["robots"][0]["silent"], "the robot is silent")
    assert 'rosrv_fleet_robot_silent{robot="arm1"} 1.0' in site.get("/metrics").text


def test_a_robot_that_was_switched_off_is_off(site: FleetSite, make_robot: MakeRobot) -> None:
    robot = make_robot("arm1")
    robot.record(5)
    robot.push()
    pusher = robot.pusher()
    pusher.close(stopped=True)
    site.stop()
    site.write_config(silent_seconds=0.1)
    site.start()
    state = site.health()["robots"][0]
    assert (state["silent"], state["off"]) == (False, True)
    assert 'rosrv_fleet_robot_off{robot="arm1"} 1.0' in site.get("/metrics").text
    robot.push()
    assert not site.health()["robots"][0]["off"]
    eventually(lambda: site.health()["robots"][0]["silent"], "the robot is silent")
