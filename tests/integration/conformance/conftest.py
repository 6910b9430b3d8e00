"""Masters on this machine's loopback, shared by the tests of a module: quick, and no namespaces are needed."""

from collections.abc import Iterator
from pathlib import Path
from typing import Self

import pytest

from tests.integration.conformance.fake_nodes import FakeNodes
from tests.integration.conformance.side_by_side import BothMasters, MasterSide
from tests.support.nodes import RosSession, has_ros
from tests.support.requirements import need_root, needs
from tests.support.rosmaster import PlainMaster, await_node
from tests.support.site import MasterSite, for_nodes


class LocalSite(MasterSite):
    """A master of one mode on 127.0.0.1."""

    def __init__(self, mode: str, home: Path) -> None:
        super().__init__(mode, PlainMaster(home) if mode == "plain" else for_nodes())

    def __enter__(self) -> Self:
        super().__enter__()
        await_node(self.master_uri, self.master.host, "/rosout")
        return self


def need_ros() -> None:
    """The appliance runs as root on this machine, with stock ROS nodes."""
    need_root()
    needs(has_ros(), "ROS 1 and g++ (run `make setup`)")


@pytest.fixture(scope="module", params=["plain", "appliance"])
def local(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[LocalSite]:
    """A master of either mode: a test of it runs with both, and promises the same of both."""
    need_ros()
    with LocalSite(request.param, tmp_path_factory.mktemp("master")) as site:
        yield site


@pytest.fixture
def ros(local: LocalSite, tmp_path: Path) -> Iterator[RosSession]:
    """The nodes and tools of one test."""
    with RosSession(local.master_uri, tmp_path) as session:
        yield session


@pytest.fixture(scope="module")
def both_masters(tmp_path_factory: pytest.TempPathFactory) -> Iterator[BothMasters]:
    """A plain ROSMaster and an appliance that lets everything pass, side by side."""
    need_ros()
    with (
        LocalSite("plain", tmp_path_factory.mktemp("master")) as plain,
        LocalSite("appliance", tmp_path_factory.mktemp("appliance")) as appliance,
        FakeNodes() as plain_nodes,
        FakeNodes() as appliance_nodes,
    ):
        sides = MasterSide(plain.master_uri, plain_nodes), MasterSide(appliance.master_uri, appliance_nodes)
        yield BothMasters(*sides)
        for side in sides:
            side.close()


@pytest.fixture
def both(both_masters: BothMasters) -> Iterator[BothMasters]:
    """The pair, as it was before the test again afterwards."""
    yield both_masters
    both_masters.reset()
