import gzip
import json
import os
import secrets
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from datetime import UTC, date, datetime, timedelta
from pathlib import Path

import psycopg
import pytest
from rosrv_fleet import indexer
from rosrv_fleet.collector import drop_partitions, make_collector
from rosrv_fleet.config import load_config
from rosrv_fleet.database import IndexDatabase, migrate
from rosrv_fleet.indexer import index, make_partition

from fleet.tests.support.fleet_site import FleetRobot, FleetSite, running
from fleet.tests.support.postgres import PostgresCluster, postgres
from fleet.tests.system.test_attacks import put, segment
from tests.support.small_disk import small_disk
from tests.support.waiting import eventually

MakeRobot = Callable[..., FleetRobot]
_DAY = 86_400
_RETENTION = {"index_days": 10, "segment_days": 30}


def _segments(site: FleetSite, robot: str) -> list[Path]:
    assert site.data is not None
    return sorted((site.data / "segments" / robot).rglob("*.gz"))


def _aged(site: FleetSite, robot: FleetRobot, ages: list[int]) -> None:
    for _age in ages:
        robot.record(5)
    robot.push()
    site.indexed()
    site.stop()
    files = _segments(site, robot.name)
    assert len(files) == len(ages)
    for file, age in zip(files, ages, strict=True):
        at = time.time() - age * _DAY
        os.utime(file, (at, at))
    site.run("reindex")


def _restart_with_retention(site: FleetSite) -> None:
    site.stop()
    site.write_config(retention=_RETENTION)
    site.start()


def _days(database: str) -> int:
    with psycopg.connect(database) as connection:
        query = "SELECT count(*) FROM pg_inherits WHERE inhparent = 'record'::regclass"
        row = connection.execute(query).fetchone()
    assert row is not None
    return int(row[0])


def test_retention_removes_the_beginning_and_verify_proves_the_rest(
    site: FleetSite, make_robot: MakeRobot
) -> None:
    robot = make_robot("arm1")
    _aged(site, robot, [50, 40, 20, 0])
    assert _days(site.database) > 1
    _restart_with_retention(site)
    eventually(lambda: len(_segments(site, "arm1")) == 2, "old segments are removed")
    eventually(lambda: _days(site.database) == 1, "old days leave the index")
    site.indexed()
    everything = site.all()
    assert len([one for one in everything if one["event"] == "decision"]) == 5
    found = site.run("verify", "arm1").stdout
    assert "were removed by the collector (retention.segment_days: 30)" in found
    assert "2 segments with 0 gaps and 0 forks" in found
    (proof,) = map(json.loads, site.run("verify", "--json").stdout.splitlines())
    first = segment(robot, 3)[0].first
    assert (proof["removed"], proof["records"], proof["missing"]) == (
        first - 1, proof["last"] - first + 1, 0
    )  # fmt: skip
    # A restored index has the same days, and the robot goes on as before.
    site.run("reindex")
    assert site.all() == everything
    robot.record(10)
    assert robot.push().progress.sent == 1
    site.run("verify", "arm1")
    assert site.health()["robots"][0]["gaps"] == 0


def test_a_segment_that_is_missing_without_a_note_is_found(site: FleetSite, make_robot: MakeRobot) -> None:
    robot = make_robot("arm1")
    _aged(site, robot, [50, 40, 1, 1, 0])
    _restart_with_retention(site)
    eventually(lambda: len(_segments(site, "arm1")) == 3, "old segments are removed")
    site.stop()
    assert site.data is not None
    first = _segments(site, "arm1")[0]
    first.rename(site.folder / "aside")
    assert "are missing" in site.run("verify", "arm1", status=1).stdout
    (site.folder / "aside").rename(first)
    site.run("verify", "arm1")
    (note,) = (site.data / "removed" / "arm1").iterdir()
    note.rename(site.folder / "note")
    assert "records 1 to" in site.run("verify", "arm1", status=1).stdout


def test_an_unfinished_removal_is_finished(site: FleetSite, make_robot: MakeRobot) -> None:
    robot = make_robot("arm1")
    _aged(site, robot, [50, 40, 35, 0])
    saved = site.folder / "saved"
    assert site.data is not None
    shutil.copytree(site.data / "segments", saved)
    _restart_with_retention(site)
    eventually(lambda: len(_segments(site, "arm1")) == 1, "old segments are removed")
    site.kill()
    for file in sorted(saved.rglob("*.gz"))[1:3]:  # as if only the first had been removed
        place = site.data / "segments" / file.relative_to(saved)
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(file, place)
    (proof,) = map(json.loads, site.run("verify", "--json").stdout.splitlines())
    assert (proof["ok"], proof["segments"]) == (True, 1)
    site.start()
    eventually(lambda: len(_segments(site, "arm1")) == 1, "the rest is removed")
    site.run("verify", "arm1")


def test_a_removed_segment_is_not_accepted_again(site: FleetSite, make_robot: MakeRobot) -> None:
    robot = make_robot("arm1")
    _aged(site, robot, [50, 0])
    _restart_with_retention(site)
    eventually(lambda: len(_segments(site, "arm1")) == 1, "old segments are removed")
    summary, body = segment(robot, 1)

    answer = put(site, robot.certificates, summary, gzip.compress(body))
    assert (answer.status_code, "were removed" in answer.text) == (409, True)


def test_a_gap_and_a_fork_are_counted_when_they_are_removed(site: FleetSite, make_robot: MakeRobot) -> None:
    robot = make_robot("arm1")
    for _ in range(5):
        robot.record(5)
    for number in (1, 3, 4, 5):
        summary, body = segment(robot, number)
        assert put(site, robot.certificates, summary, gzip.compress(body)).status_code == 201
    site.indexed()
    assert site.health()["robots"][0]["gaps"] == 1
    site.stop()
    for file in _segments(site, "arm1")[:2]:
        at = time.time() - 50 * _DAY
        os.utime(file, (at, at))
    _restart_with_retention(site)
    eventually(lambda: len(_segments(site, "arm1")) == 2, "old segments are removed")
    assert site.health()["robots"][0]["gaps"] == 0
    assert "2 segments with 1 gap and 0 forks" in site.run("verify", "arm1").stdout


def _opened(database: str) -> IndexDatabase:
    made = IndexDatabase(database, connections=1, statement_seconds=10.0)
    made.open()
    return made


@pytest.mark.parametrize("ended", [True, False], ids=["the day has ended", "someone dropped it"])
def test_a_day_that_is_dropped_while_its_segment_is_indexed(
    ended: bool, site: FleetSite, make_robot: MakeRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = make_robot("arm1")
    robot.record(5)
    robot.push()
    site.indexed()
    site.stop()
    collector = make_collector(load_config(site.folder / "fleet.yaml"))
    with psycopg.connect(site.database) as connection:
        connection.execute("TRUNCATE segment, record")

    def midnight(database: IndexDatabase, day: date) -> None:
        make_partition(database, day)
        assert drop_partitions(database, day + timedelta(1)) == [day]

    monkeypatch.setattr(indexer, "make_partition", midnight)
    (log,) = collector.store.logs("arm1")
    (place,) = collector.store.segments("arm1", log)
    today = datetime.fromtimestamp(collector.store.arrival_time(place) // 10**9, UTC).date()

    def indexed(database: IndexDatabase, oldest: date) -> bool:
        return index(database, collector.store, place, (robot.public,), collector.config, oldest=oldest)

    with closing(_opened(site.database)) as database:
        if ended:
            assert not indexed(database, today)
        else:
            with pytest.raises(psycopg.errors.CheckViolation):
                indexed(database, today - timedelta(1))
    assert _days(site.database) == 0
    with psycopg.connect(site.database) as connection:
        assert connection.execute("SELECT count(*) FROM segment").fetchone() == (0,)
    assert len(_segments(site, "arm1")) == 1
    site.run("verify", "arm1")


@pytest.mark.parametrize("ages", [[50, 1], [50, 40]], ids=["a part", "all"])
def test_the_logbook_admits_what_retention_removed_and_what_did_not_arrive(
    ages: list[int], site: FleetSite, make_robot: MakeRobot
) -> None:
    robot = make_robot("arm1")
    _aged(site, robot, ages)
    _restart_with_retention(site)
    days = 1 + sum(age < 10 for age in ages)  # with today, on which they arrived
    eventually(lambda: _days(site.database) == days, "retention removes old days")
    assert site.data is not None
    ((heard,),) = [list((site.data / "heard" / "arm1").iterdir())]
    os.utime(heard, (time.time() - 3 * 3600,) * 2)
    report = json.loads(site.run("report", "interventions", "--json").stdout)
    lacks = {gap["event"] for gap in report["gaps"] if gap["appliance"] == "arm1"}
    assert "not in the index" in lacks
    assert ("not collected since" in lacks) is (min(ages) < 10)
    noted = site.run("who-drove", "--at", "1s", "--robot", "arm?", status=1).stderr
    assert "arm1  not in the index" in noted
    assert "the index has no record that a host held a group then" in noted
    assert "arm1" not in site.run("who-drove", "--at", "1s", "--robot", "arm2", status=1).stderr


def test_a_day_whose_segments_were_not_indexed_is_dropped(database: str) -> None:
    today = datetime.now(UTC).date()
    with psycopg.connect(database) as connection:
        migrate(connection)
    with closing(_opened(database)) as index_database:
        make_partition(index_database, today - timedelta(1))
        make_partition(index_database, today)
        assert drop_partitions(index_database, today) == [today - timedelta(1)]
    assert _days(database) == 1


def test_the_first_segments_of_a_day_are_indexed_at_the_same_time(database: str) -> None:
    with psycopg.connect(database) as connection:
        migrate(connection)
    begin, today = threading.Barrier(8), datetime.now(UTC).date()

    def make(own: IndexDatabase) -> None:
        for ago in range(20):
            begin.wait(60)
            make_partition(own, today - timedelta(ago))

    databases = [_opened(database) for _ in range(8)]
    try:
        with ThreadPoolExecutor(8) as pool:
            for made in [pool.submit(make, one) for one in databases]:
                made.result(120)
    finally:
        for one in databases:
            one.close()
    assert _days(database) == 20


@pytest.fixture
def own_cluster() -> Iterator[PostgresCluster]:
    with postgres() as cluster:
        yield cluster


def test_a_full_disk_of_postgresql_loses_nothing(own_cluster: PostgresCluster, tmp_path: Path) -> None:
    with small_disk(own_cluster.folder / "small", "24m", "mode=777") as disk:
        shutil.chown(disk, "postgres", "postgres")
        database = own_cluster.create(f"test_{secrets.token_hex(6)}")
        with psycopg.connect(own_cluster.database("postgres"), autocommit=True) as connection:
            connection.execute(f"CREATE TABLESPACE small LOCATION '{disk}'".encode())
            name = database.rpartition("=")[2]
            connection.execute(f"ALTER DATABASE {name} SET default_tablespace = small".encode())
        with running(FleetSite(tmp_path / "site", database)) as site:
            robot = FleetRobot(site, "arm1")
            robot.record(10)
            robot.push()
            site.indexed()
            filler = disk / "filler"
            filler.write_bytes(b"x" * shutil.disk_usage(disk).free)
            robot.record(110, reason=secrets.token_hex(2000))  # PostgreSQL cannot compress it
            robot.push()
            eventually(lambda: "No space left" in (site.health()["trouble"] or ""), "the trouble is reported")
            assert site.health()["waiting"] >= 1
            assert "rosrv_fleet_index_up 0.0" in site.get("/metrics").text
            site.run("verify", "arm1")
            filler.unlink()
            site.indexed()
            assert len([one for one in site.all() if one["event"] == "decision"]) == 120
            robot.close()
        own_cluster.stop()
