from typing import get_args, get_type_hints

import pytest

from appliance.audit.log.events import MONITOR_ACTIONS
from appliance.audit.log.record import AuditRecord, Severity
from appliance.features.recorder.recording_answers import TriggerKind
from appliance.features.recorder.recording_plan import _BY_EVENT, trigger_of
from appliance.features.recorder.settings import RecorderRules

KINDS: tuple[TriggerKind, ...] = get_args(TriggerKind)


@pytest.mark.parametrize(
    ("record", "what"),
    [
        (AuditRecord(id="1", time=5, event="message dropped", reason="too fast"), "drop"),
        (AuditRecord(id="1", time=5, event="message changed"), "change"),
        (AuditRecord(id="1", time=5, event="monitor verdict"), "verdict"),
        (AuditRecord(id="1", time=5, event="monitor fault", severity=Severity.ALARM), "fault"),
        (AuditRecord(id="1", time=5, event="stop begun", severity=Severity.WARNING), "stop"),
        (AuditRecord(id="1", time=5, event="decision", decision="deny"), "denial"),
        (AuditRecord(id="1", time=5, event="signature refused", severity=Severity.ALARM), "alarm"),
        (AuditRecord(id="1", time=5, event="decision", decision="allow"), None),
        (AuditRecord(id="1", time=5, event="recording closed", severity=Severity.NOTICE), None),
    ],
)
def test_records_are_triggers_of_the_kind_that_is_wanted(record: AuditRecord, what: str | None) -> None:
    trigger = trigger_of(record, KINDS)
    assert (trigger and trigger.what) == what
    if trigger is not None:
        assert (trigger.time, trigger.record) == (5, "1")
        assert trigger.text.startswith(record.event)
    own = {what, "alarm", *_BY_EVENT.get(record.event, ())}
    assert trigger_of(record, [kind for kind in KINDS if kind not in own]) is None


def test_a_trigger_has_no_content_of_messages() -> None:
    detail = {"monitor": "goals", "category": "twice", "binding": {"id": "secret"}}
    reason = "property 1 of goals (fsm) with id = secret: twice"
    trigger = trigger_of(
        AuditRecord(id="1", time=5, event="monitor verdict", reason=reason, detail=detail), KINDS
    )
    assert trigger is not None
    assert trigger.text == "monitor verdict: property 1 of goals (fsm): twice"


def test_all_kinds_but_orders_can_be_configured() -> None:
    configurable = get_args(get_args(get_type_hints(RecorderRules)["triggers"])[0])
    assert set(configurable) == set(KINDS) - {"order"}


def test_a_record_of_each_trigger_of_monitors_says_whether_it_was_recorded() -> None:
    assert _BY_EVENT.keys() == MONITOR_ACTIONS
