from collections.abc import AsyncIterator

import pytest

from tests.support.features.doors.door_world import DoorWorld, door_world


@pytest.fixture
async def world() -> AsyncIterator[DoorWorld]:
    async with door_world() as world:
        yield world
