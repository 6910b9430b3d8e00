import asyncio
from pathlib import Path

from appliance.control.process import _end_others
from appliance.store.state_file import StateStore
from tests.support.engines import InlineDatabase


def fail(reason: str) -> None:
    raise AssertionError(reason)


def test_requests_in_progress_are_stored_before_the_end(tmp_path: Path) -> None:
    store = StateStore(tmp_path, failed=fail, kind=InlineDatabase)

    async def scenario() -> bool:
        under_way = asyncio.Event()

        async def request() -> None:
            try:
                under_way.set()
                await asyncio.Event().wait()
            finally:
                await asyncio.sleep(0)
                store.database.put("setting", "ended", "yes")

        task = asyncio.create_task(request())
        await under_way.wait()
        await _end_others(30)
        return task.done()

    assert asyncio.run(scenario())
    store.close()
    again = StateStore(tmp_path, failed=fail, kind=InlineDatabase)
    assert again.database.query("SELECT value FROM setting WHERE name = 'ended'") == [("yes",)]
    again.close()
