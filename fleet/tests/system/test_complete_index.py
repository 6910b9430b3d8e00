"""An index that lacks stored segments says so, everywhere where it is read, until `reindex` has ended."""

import json
import secrets
import shutil
from collections.abc import Callable
from pathlib import Path

import psycopg
import pytest
from rosrv_fleet import cli
from rosrv_fleet.database import MIGRATIONS, is_complete, migrate
from rosrv_fleet.indexer import index

from fleet.tests.support.fleet_site import FleetRobot, FleetSite
from fleet.tests.support.postgres import PostgresCluster
from tests.support.waiting import eventually

MakeRobot = Callable[..., FleetRobot]


def _other_database(site: FleetSite, database: str, between: Callable[[], object] = bool) -> None:
    site.stop()
    site.write_config(database="host=/nowhere")
    site.start()
    between()
    site.stop()
    site.database = database
    site.write_config()
    site.start()


def _is_admitted(site: FleetSite, *, complete: bool) -> None:
    found = site.answer("/v1/search")
    assert found["complete"] is complete
    assert ("reindex" in site.run("search").stderr) is not complete
    gaps = json.loads(site.run("report", "interventions", "--json").stdout)["gaps"]
    assert ("not indexed" in [gap["event"] for gap in gaps]) is not complete


@pytest.mark.parametrize("ends", ["at once", "later", "lost database"])
def test_an_incomplete_index_admits_it_until_it_is_rebuilt(
    ends: str,
    site: FleetSite,
    make_robot: MakeRobot,
    cluster: PostgresCluster,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    robot = make_robot("arm1")
    for _segment in range(4):
        robot.record(3)
        robot.push()
    site.indexed()
    _is_admitted(site, complete=True)
    whole = site.all()
    if ends == "lost database":
        _other_database(site, cluster.create(f"test_{secrets.token_hex(6)}"))
    else:
        number = iter(range(0 if ends == "at once" else 2))

        def fail(*arguments: object, **named: object) -> bool:
            if next(number, None) is None:
                raise psycopg.OperationalError("the server closed the connection")
            return index(*arguments, **named)  # type: ignore[arg-type]  # as it was called

        monkeypatch.setattr(cli, "index", fail)
        with pytest.raises(psycopg.OperationalError):
            cli.reindex(site.folder / "fleet.yaml")
        site.stop()
        site.start()
    eventually(lambda: "reindex" in (site.health()["trouble"] or ""), "health reports it")
    assert len(site.all()) < len(whole)
    _is_admitted(site, complete=False)
    site.run("reindex")
    site.indexed()
    _is_admitted(site, complete=True)
    assert site.all() == whole


def test_segments_that_came_before_the_database_leave_it_complete(
    site: FleetSite, make_robot: MakeRobot, cluster: PostgresCluster
) -> None:
    def push() -> None:
        robot = make_robot("arm1")
        robot.record(3)
        robot.push()

    _other_database(site, cluster.create(f"test_{secrets.token_hex(6)}"), push)
    site.indexed()
    _is_admitted(site, complete=True)


@pytest.mark.parametrize("segments", [0, 1])
def test_the_index_of_an_earlier_release_counts_as_complete_if_it_has_segments(
    segments: int, database: str, tmp_path: Path
) -> None:
    for name in ("0001_segments_and_records.sql", "0002_rollouts.sql"):
        shutil.copy(MIGRATIONS / name, tmp_path)
    with psycopg.connect(database) as connection:
        migrate(connection, tmp_path)
        if segments:
            connection.execute("INSERT INTO segment VALUES ('r', 'l', 1, 'h', 1, 1, 1, 1, 1, '2026-01-01')")
        assert migrate(connection) == ["0003_complete"]
        assert is_complete(connection) is bool(segments)
