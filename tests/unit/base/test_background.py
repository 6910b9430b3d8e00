import asyncio

import pytest
from structlog.testing import capture_logs

from appliance.base import background
from appliance.base.background import run_always

pytestmark = pytest.mark.anyio


async def test_work_starts_again_after_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(background, "_AGAIN_SECONDS", 0.0)
    errors = [RuntimeError("first"), OSError("second")]
    others = 0

    async def work() -> None:
        await asyncio.sleep(0)
        if errors:
            raise errors.pop(0)

    async def other() -> None:
        nonlocal others
        while errors:
            others += 1
            await asyncio.sleep(0)

    with capture_logs() as logs:
        async with asyncio.timeout(30), asyncio.TaskGroup() as tasks:
            tasks.create_task(run_always("the work", work))
            tasks.create_task(run_always("the other work", other))
    assert [(log["event"], str(log["exc_info"]), log["log_level"]) for log in logs] == [
        ("fault in the work, which starts again", "first", "critical"),
        ("fault in the work, which starts again", "second", "critical"),
    ]
    assert others > 1


async def test_work_can_be_cancelled() -> None:
    began = asyncio.Event()

    async def work() -> None:
        began.set()
        await asyncio.Event().wait()

    task = asyncio.create_task(run_always("the work", work))
    await began.wait()
    task.cancel()
    with pytest.raises(asyncio.CancelledError), capture_logs() as logs:
        await task
    assert logs == []
