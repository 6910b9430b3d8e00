from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.nodes import RosSession, need_ros
from tests.support.relay_driver import RelayDriver


@pytest.fixture
def driver() -> Iterator[RelayDriver]:
    need_ros()
    with RelayDriver() as driver:
        yield driver


@pytest.fixture
def ros(driver: RelayDriver, tmp_path: Path) -> Iterator[RosSession]:
    with RosSession(driver.uri, tmp_path) as session:
        yield session
