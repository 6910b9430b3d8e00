import pytest

from tests.support.control_parts import ControlParts
from tests.unit.features.adopt.robot_world import RobotWorld


@pytest.fixture
async def bare() -> RobotWorld:
    return RobotWorld(await ControlParts.begun())


@pytest.fixture
async def world(bare: RobotWorld) -> RobotWorld:
    bare.add_nodes()
    return bare
