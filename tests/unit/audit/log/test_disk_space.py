from collections.abc import Iterator
from pathlib import Path

import pytest
from structlog.testing import capture_logs

from appliance.audit.log.budget import Budget
from appliance.audit.log.log import AuditLog
from appliance.audit.search.query import Filter
from appliance.audit.search.search import search
from appliance.quotas.pool import QuotaClass
from tests.support.audit import decision, settle
from tests.support.engines import ByHand, let_pass
from tests.support.small_disk import small_disk

pytestmark = pytest.mark.nightly

_RESERVE = 16 << 20


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    with small_disk(tmp_path / "disk", "32m") as place:
        yield place


def test_low_space_raises_an_alarm_before_the_disk_is_full(disk: Path) -> None:
    budget = Budget(lambda _host: QuotaClass.REGISTERED)
    with capture_logs() as said:
        log = AuditLog(disk / "audit.db", drive=ByHand, budget=budget, reserve=_RESERVE)
        log.record(decision(log))
        assert settle(log) is None
        assert log.degraded is None
        filler = disk / "filler"
        filler.write_bytes(b"x" * (20 << 20))
        let_pass(log, 1)
    assert [one["event"] for one in said] == ["disk nearly full"]
    assert "make room" in said[0]["reason"]
    assert (log.degraded or "").startswith(f"the disk of {disk} is nearly full: "), (
        "and the log is not behind"
    )
    assert log.failed is None
    for number in range(2000):
        log.record(
            decision(log, host="10.0.0.66", detail={"call": "setParam", "key": f"/{number}" + "k" * 400})
        )
    assert budget.pause("10.0.0.66") > 0
    assert budget.pause("10.0.0.1") == 0
    assert settle(log) is None
    filler.unlink()
    let_pass(log, 1)
    assert log.degraded is None
    assert budget.pause("10.0.0.66") == 0
    assert log.close() is None
    found = search(disk / "audit.db", Filter(event="disk *")).entries[::-1]
    assert [(one.record.event, one.record.severity.value) for one in found] == [
        ("disk nearly full", "alarm"), ("disk has room", "notice"),
    ]  # fmt: skip
