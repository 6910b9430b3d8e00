import random
from collections import Counter
from pathlib import Path

import pytest

from appliance.audit.search.query import Filter
from appliance.audit.search.search import export
from appliance.channel.messages import MonitorEvent
from appliance.specifications.records import MonitorRecords, Repetitions
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
    records.reported([event] * 2, lost=0, ahead=0)
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


@pytest.mark.parametrize("hosts", [1, 3, 40])
def test_the_records_of_a_host_have_the_number_of_its_actions_under_any_flood(hosts: int) -> None:
    """The robot's own drops have their own records, although hosts flood a monitor with texts."""
    chance = random.Random(hosts)  # noqa: S311  the same flood in every run
    repetitions, now = Repetitions(), 0.0
    sent, recorded, own = Counter[str](), Counter[str](), list[MonitorEvent]()

    def take(kind: str, host: str, text: str, count: int = 0) -> None:
        event = MonitorEvent(kind, "safe", "k", "/cmd", 0, text, {}, host=host, caller_id="/x", count=count)
        sent[host] += count or 1
        note(repetitions.take(event, now))

    def note(event: MonitorEvent | None) -> None:
        if event is not None:
            recorded[event.host] += event.count or 1
            own.extend([event] * (event.host == "10.0.0.2"))

    for second in range(120):
        now += 1
        for _ in range(40 if second else 2500):
            word = "".join(chance.choices("abcdefgh", k=4))
            host = f"10.0.1.{chance.randrange(hosts)}"
            take(chance.choice(["log", "drop", "fault"]), host, word, chance.choice([0, 0, 7]))
        take("drop", "10.0.0.2", "one")
    for _ in range(300):
        now += 100
        for event, _whole in repetitions.pop_ended(now):
            note(event)
    assert recorded == sent
    assert not repetitions.some
    assert {event.text for event in own} == {"one"}
