import asyncio
from collections.abc import Iterator
from pathlib import Path

import pytest

from appliance.features.standby.replica import Replica
from appliance.features.standby.replica_sync import ReplicaSync
from appliance.store.state_file import SCHEMA
from tests.support.processes import LIMIT

pytestmark = pytest.mark.anyio


@pytest.fixture
def replica(tmp_path: Path) -> Iterator[Replica]:
    made = Replica(tmp_path / "state.db", SCHEMA, failed=pytest.fail)
    yield made
    made.close()


async def complete(replica: Replica, folder: Path, boot: str, *, followed: bool, seconds: float) -> bool:
    done = asyncio.Event()
    task = asyncio.create_task(ReplicaSync(replica, folder, boot).run(lambda: followed, done.set))
    try:
        await asyncio.wait_for(done.wait(), seconds)
    except TimeoutError:
        return False
    finally:
        task.cancel()
        await asyncio.wait([task])
    return True


async def test_a_restarted_process_may_take_over_at_once(replica: Replica, tmp_path: Path) -> None:
    for _ in range(2):
        assert await complete(replica, tmp_path, "boot 1", followed=False, seconds=LIMIT)


async def test_after_a_reboot_it_waits_for_the_active_appliance(replica: Replica, tmp_path: Path) -> None:
    assert await complete(replica, tmp_path, "boot 1", followed=False, seconds=LIMIT)
    assert not await complete(replica, tmp_path, "boot 2", followed=False, seconds=0.5)
    assert not await complete(replica, tmp_path, "boot 2", followed=False, seconds=0.5)
    assert await complete(replica, tmp_path, "boot 2", followed=True, seconds=LIMIT)
    assert await complete(replica, tmp_path, "boot 2", followed=False, seconds=LIMIT)
