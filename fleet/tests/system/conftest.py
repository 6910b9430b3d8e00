import secrets
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fleet.tests.support.fleet_site import FleetRobot, FleetSite, running
from fleet.tests.support.postgres import PostgresCluster, postgres


@pytest.fixture(scope="session")
def cluster() -> Iterator[PostgresCluster]:
    with postgres() as running:
        yield running


@pytest.fixture
def database(cluster: PostgresCluster) -> str:
    return cluster.create(f"test_{secrets.token_hex(6)}")


@pytest.fixture
def site(database: str, tmp_path: Path) -> Iterator[FleetSite]:
    with running(FleetSite(tmp_path / "site", database)) as found:
        yield found


@pytest.fixture
def make_robot(site: FleetSite) -> Iterator[Callable[..., FleetRobot]]:
    made: list[FleetRobot] = []

    def make(name: str, **settings: object) -> FleetRobot:
        made.append(FleetRobot(site, name, **settings))  # type: ignore[arg-type]  # as the test says
        return made[-1]

    yield make
    for robot in made:
        robot.close()


@pytest.fixture(scope="module")
def shared(cluster: PostgresCluster, tmp_path_factory: pytest.TempPathFactory) -> Iterator[FleetSite]:
    database = cluster.create(f"test_{secrets.token_hex(6)}")
    with running(FleetSite(tmp_path_factory.mktemp("shared") / "site", database)) as found:
        robot = FleetRobot(found, "arm1")
        robot.record(100)
        robot.push()
        robot.close()
        found.indexed()
        yield found
