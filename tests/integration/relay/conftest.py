"""A real relay between real nodes."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.nodes import RosSession, has_ros
from tests.support.relay_driver import RelayDriver
from tests.support.requirements import needs


@pytest.fixture
def driver() -> Iterator[RelayDriver]:
    """rosmaster, the relay, and the least of a control."""
    needs(has_ros(), "ROS 1 and g++ (run `make setup`)")
    with RelayDriver() as driver:
        yield driver


@pytest.fixture
def ros(driver: RelayDriver, tmp_path: Path) -> Iterator[RosSession]:
    """Nodes of the test, whose master is the driver's."""
    with RosSession(driver.uri, tmp_path) as session:
        yield session
