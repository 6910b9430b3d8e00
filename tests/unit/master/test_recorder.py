"""Tests of what callers are told, and not told, while nothing can be recorded."""

import asyncio
import time
from typing import Any

import pytest

from appliance.audit.ids import IdSource
from appliance.master.recorder import NOT_RECORDED, Recorder


class Log:
    """An audit log that cannot be written."""

    def __init__(self) -> None:
        self.ids = IdSource(clock=time.time_ns)
        self.failed: str | None = "/var/lib/rosrv/control/audit.db: database or disk is full"
        self.records: list[Any] = []

    def record(self, record: Any) -> None:
        """Take it."""
        self.records.append(record)

    async def wait_durable(self) -> str | None:
        """Say why not."""
        return self.failed


def recorder(log: Log, *, deny: bool) -> Recorder:
    """As control makes it."""
    return Recorder(log, strict=True, deny_when_failed=deny)  # type: ignore[arg-type]  # stands for the log


def test_nobody_is_told_where_the_log_is() -> None:
    """While the log cannot be written requests are denied; where it is and what is wrong is not for a node."""
    one = recorder(Log(), deny=True)
    assert one.obstacle == NOT_RECORDED
    assert "/" not in NOT_RECORDED
    assert asyncio.run(one.durable()) is not None


@pytest.mark.parametrize("failed", [None, "full"])
def test_when_it_is_to_go_on_without(failed: str | None) -> None:
    """With `on_audit_failure: allow`, or while the log is well, nothing stands in the way."""
    log = Log()
    log.failed = failed
    assert recorder(log, deny=failed is None).obstacle is None
    if failed is not None:
        assert asyncio.run(recorder(log, deny=False).durable()) is None
