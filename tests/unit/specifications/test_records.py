from pathlib import Path

import pytest

from appliance.audit.search.query import Filter
from appliance.audit.search.search import export
from appliance.channel.messages import MonitorEvent
from appliance.specifications.records import MonitorRecords
from appliance.telemetry.audit_trail import AuditTrail
from tests.support.audit import settle
from tests.support.engines import open_log

NAMES = ("event", "reason", "severity", "host", "category", "resource", "rule", "decision", "more", "self")


REASONS = {
    "shadow publish": "in shadow mode, not done: gun sends told",
    "shadow call": "in shadow mode, not done: gun calls told",
    "shadow drop": "in shadow mode, not done: told",
    "shadow log": "in shadow mode: told",
}


@pytest.mark.parametrize("kind", ["verdict", "drop", "change", "fault", "log", "publish", *REASONS])
def test_every_report_is_recorded(tmp_path: Path, kind: str) -> None:
    log = open_log(tmp_path / "audit.db")
    records = MonitorRecords(
        AuditTrail(log, strict=False, deny_when_failed=False),
        lambda _topic, _data: None,
        [],
    )
    detail = {"logic": "fsm", **{name: f"its {name}" for name in NAMES}}
    event = MonitorEvent(
        kind, "gun", "key", "/trigger", 10**18, "told", detail, host="10.0.0.7", caller_id="/joystick"
    )
    records.reported([event] * 2, lost=0)
    settle(log)
    assert records.counts == {(kind, "gun"): 2}
    assert records.trail.meter.dropped.counts() == ({"gun": 2} if kind == "drop" else {})
    found = [
        entry.record
        for entry in export(tmp_path / "audit.db", Filter())
        if entry.record.resource == "/trigger"
    ]
    assert [one.reason for one in found] == [REASONS.get(kind, "told")] * 2
    assert found[0].category == "monitor"
    assert (found[0].host, found[0].caller_id) == ("10.0.0.7", "/joystick")
    assert (found[0].detail["category"], found[0].detail["logic"]) == ("its category", "fsm")
    log.close()
