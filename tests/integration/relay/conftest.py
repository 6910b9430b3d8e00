from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.nodes import RosSession, has_ros
from tests.support.relay_driver import RelayDriver
from tests.support.requirements import needs


@pytest.fixture
def driver() -> Iterator[RelayDriver]:
    needs(has_ros(), "ROS 1 and g++ (run `make setup`)")
    with RelayDriver() as driver:
        yield driver


@pytest.fixture
def ros(driver: RelayDriver, tmp_path: Path) -> Iterator[RosSession]:
    with RosSession(driver.uri, tmp_path) as session:
        yield session
