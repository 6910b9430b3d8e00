from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.integration.conformance.fake_nodes import FakeNodes
from tests.integration.conformance.side_by_side import BothMasters, MasterSide
from tests.support.nodes import RosSession, need_ros
from tests.support.site import Masters, Site


@pytest.fixture(params=["plain", "appliance"])
def local(request: pytest.FixtureRequest, masters: Masters) -> Iterator[Site]:
    with masters.lend(request.param, "loopback") as site:
        yield site


@pytest.fixture
def ros(local: Site, tmp_path: Path) -> Iterator[RosSession]:
    with RosSession(local.master_uri, tmp_path) as session:
        yield session


@pytest.fixture(scope="module")
def fakes() -> Iterator[tuple[FakeNodes, FakeNodes]]:
    with FakeNodes() as plain, FakeNodes() as appliance:
        yield plain, appliance


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Site, Site]]:
    need_ros()
    with (
        Site("plain", tmp_path_factory.mktemp("plain")) as plain,
        Site("appliance", tmp_path_factory.mktemp("appliance")) as appliance,
    ):
        yield plain, appliance


@pytest.fixture
def both(pair: tuple[Site, Site], fakes: tuple[FakeNodes, FakeNodes]) -> Iterator[BothMasters]:
    sides = MasterSide(pair[0].master_uri, fakes[0]), MasterSide(pair[1].master_uri, fakes[1])
    both = BothMasters(*sides)
    yield both
    both.reset()
    for side in sides:
        side.close()
    for site in pair:
        site.reset()
