import json
import secrets
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import msgspec
import pytest
from rosrv_fleet.segment_store import SegmentPlace, SegmentStore

from appliance.formats.receipts import SegmentReceipt
from fleet.tests.support.fleet_site import FleetRobot, FleetSite, running
from fleet.tests.support.postgres import PostgresCluster, postgres
from tests.support.waiting import eventually

_ROBOTS = 12
_ROUNDS = 6


@pytest.fixture
def own_cluster() -> Iterator[PostgresCluster]:
    with postgres() as cluster:
        yield cluster


def _work(robot: FleetRobot, ended: threading.Event) -> int:
    pusher = robot.pusher()
    pusher.jitter = lambda: -0.4  # pauses of a tenth: the test kills often
    while not ended.is_set():
        robot.record(5)
        for _ in range(10):
            if ended.wait(min(0.5, pusher.step())):
                break
    deadline = time.monotonic() + 120
    sealed = robot.sealed()
    while pusher.progress.sequence < sealed and time.monotonic() < deadline:
        threading.Event().wait(min(0.5, pusher.step()))
    assert pusher.progress.sequence >= sealed, pusher.progress
    assert pusher.progress.missed == 0
    pusher.close()
    return sealed


def test_nothing_is_missing_after_kills(own_cluster: PostgresCluster, tmp_path: Path) -> None:
    database = own_cluster.create(f"test_{secrets.token_hex(6)}")
    with ExitStack() as stack:
        site = stack.enter_context(running(FleetSite(tmp_path / "site", database)))
        robots = [FleetRobot(site, f"robot{number}") for number in range(_ROBOTS)]
        for robot in robots:
            stack.callback(robot.close)
        ended = threading.Event()
        with ThreadPoolExecutor(_ROBOTS) as pool:
            working = [pool.submit(_work, robot, ended) for robot in robots]
            try:
                for number in range(_ROUNDS):
                    before = site.stored()
                    eventually(partial(_more_than, site, before + _ROBOTS), "segments arrive")
                    (site if number % 2 == 0 else own_cluster).kill()
                    (site if number % 2 == 0 else own_cluster).start()
            finally:
                ended.set()
            sealed = [work.result(150) for work in working]
        site.indexed()
        proofs = {
            one["robot"]: one for one in map(json.loads, site.run("verify", "--json").stdout.splitlines())
        }
        for robot, last in zip(robots, sealed, strict=True):
            proof = proofs[robot.name]
            assert (proof["ok"], proof["missing"], proof["records"]) == (True, 0, proof["last"])
            assert proof["last"] >= last
            _check_receipts(site, robot)
            found = site.all(robot=robot.name)
            assert sorted(one["sequence"] for one in found) == list(range(1, proof["last"] + 1))
        assert [one["gaps"] + one["forks"] for one in site.health()["robots"]] == [0] * _ROBOTS


def _more_than(site: FleetSite, count: int) -> bool:
    return site.stored() > count


def _check_receipts(site: FleetSite, robot: FleetRobot) -> None:
    assert site.data is not None
    store = SegmentStore(site.data, 1)
    lines = (robot.folder / "state" / "receipts.ndjson").read_bytes().splitlines()
    receipts = [msgspec.json.decode(line, type=SegmentReceipt) for line in lines]
    assert receipts
    for receipt in receipts:
        assert store.has(SegmentPlace(receipt.robot, receipt.log, receipt.number, receipt.segment))


def test_segments_are_accepted_without_a_database(own_cluster: PostgresCluster, tmp_path: Path) -> None:
    database = own_cluster.create(f"test_{secrets.token_hex(6)}")
    with running(FleetSite(tmp_path / "site", database)) as site:
        robot = FleetRobot(site, "arm1")
        robot.record(10)
        robot.push()
        site.indexed()
        own_cluster.kill()
        robot.record(10)
        robot.push()
        eventually(lambda: "database" in (site.health()["trouble"] or ""), "the trouble is reported")
        assert site.health()["waiting"] >= 1
        answer = site.get("/v1/search")
        assert (answer.status_code, answer.headers["Retry-After"]) == (503, "5")
        site.kill()
        own_cluster.start()
        site.start()
        site.indexed()
        assert len(site.search(event="decision", limit=1000)) == 20
        robot.close()


def test_a_missing_database_is_noticed_without_segments(own_cluster: PostgresCluster, tmp_path: Path) -> None:
    database = own_cluster.create(f"test_{secrets.token_hex(6)}")
    with running(FleetSite(tmp_path / "site", database)) as site:
        site.indexed()
        own_cluster.kill()
        eventually(lambda: site.health()["trouble"], "the missing database is reported", 90)
        own_cluster.start()
        eventually(lambda: site.health()["trouble"] is None, "the database is back")
