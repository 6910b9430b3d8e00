import asyncio
from collections.abc import Mapping
from pathlib import Path

import pytest

from appliance.base import clock
from appliance.specifications.rollout import Switch
from appliance.specifications.timed_switches import TimedSwitches
from appliance.store.state_file import StateStore
from tests.support.engines import InlineDatabase
from tests.support.virtual_clock import set_wall

pytestmark = pytest.mark.anyio


async def test_a_clock_that_is_set_back_does_not_extend_a_time_limit(tmp_path: Path) -> None:
    store = StateStore(tmp_path, failed=pytest.fail, kind=InlineDatabase)
    enabled: asyncio.Queue[float] = asyncio.Queue()

    async def come_back(back: Mapping[str, Switch]) -> None:
        assert back == {"gun": True}
        enabled.put_nowait(clock.now())

    limits, begin = TimedSwitches(store, come_back), clock.now()
    limits.begin({"gun": True}, 600.0)
    await asyncio.sleep(300.0)
    set_wall(clock.wall() - 86_400.0)
    assert await enabled.get() - begin == pytest.approx(600.0)
    store.close()
