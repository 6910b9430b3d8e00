from appliance.audit.log.events import MONITOR_ACTIONS
from appliance.audit.log.record import AuditRecord, RuleReference, Severity
from appliance.features.policy_tools.explanations import lines_of


def test_a_verdict_is_explained() -> None:
    event = {
        "event": "go", "time": "12:00", "node": "/a", "host": "10.0.0.1", "on": "/t", "seq": 7, "state": "bad",
    }  # fmt: skip
    why = {"events": [event], "fewest": False, "since": "11:00", "decided": ["a is true"]}
    detail = {"number": 3, "at": ["x.rv:1:2"], "conditions": {"x.rv:3:4": {"x": 2}}, "why": why}
    record = AuditRecord(
        id="1", time=1, event="monitor verdict", reason="bad", host="10.0.0.1", caller_id="/a", detail=detail
    )
    assert list(lines_of(record)) == [
        "bad",
        "by: message number 3 of /a on 10.0.0.1",
        "at: x.rv:1:2",
        "where: x.rv:3:4, x = 2",
        "not recorded: recorder.triggers did not list this kind of event",
        "because: go at 12:00, on /t, by /a, on 10.0.0.1 seq 7 -> bad",
        "but: this is enough only for the property as it was at 11:00; earlier events are not kept",
        "but: fewer of them might suffice",
        "so: a is true",
    ]


def test_missing_explanations_are_reported() -> None:
    bare = AuditRecord(id="1", time=1, event="monitor verdict", reason="bad")
    assert list(lines_of(bare))[-1].startswith("because: the causing events are no longer known")
    silent = AuditRecord(
        id="1", time=1, event="monitor verdict", reason="bad", detail={"why": {"events": []}}
    )
    assert list(lines_of(silent))[::2] == ["bad", "because: no event was needed: time has passed"]
    events = [{"event": str(number), "time": "12:00"} for number in range(10)]
    many = AuditRecord(
        id="1", time=1, event="monitor verdict", detail={"why": {"events": events, "left_out": 4}}
    )
    assert list(lines_of(many))[7] == "because: … 4 more …"


def test_a_denial_names_its_rule() -> None:
    rule = RuleReference("Publishers", "/t", "robot.ini", 4)
    record = AuditRecord(
        id="1", time=1, event="decision", decision="deny", severity=Severity.WARNING, reason="no", host="10.0.0.1",
        rule=rule,
    )  # fmt: skip
    assert list(lines_of(record)) == ["no", "by: on 10.0.0.1", "rule: [Publishers] /t robot.ini:4"]
    other = AuditRecord(
        id="1", time=1, event="policy loaded", reason="by somebody", detail={"why": "strange", "at": 3}
    )
    assert list(lines_of(other)) == ["by somebody"]


def test_an_event_without_a_reason_is_described() -> None:
    assert list(lines_of(AuditRecord(id="1", time=1, event="log begun"))) == ["log begun"]


def test_a_drop_says_whether_it_was_recorded() -> None:
    planned = {"recording": "18e9aa02efc40abb0e51", "charged_to": "robot"}
    drop = AuditRecord(id="1", time=1_500_000_000, event="message dropped", reason="no", detail=planned)
    assert list(lines_of(drop)) == [
        "no",
        "recorded: in 18e9aa02efc40abb0e51; rosrv record messages 18e9aa02efc40abb0e51 --at 1",
    ]
    off = AuditRecord(
        id="1", time=1, event="message dropped", reason="no", detail={"not_recorded": "it is off"}
    )
    assert list(lines_of(off)) == ["no", "not recorded: it is off"]
    own = AuditRecord(id="1", time=1, event="recording closed", reason="done", detail=planned)
    assert list(lines_of(own)) == ["done"]
    withheld = AuditRecord(id="1", time=1, event="message dropped", detail=planned | {"withheld": ["before"]})
    assert list(lines_of(withheld))[1].startswith("recorded: in ")


def test_every_monitors_trigger_says_whether_it_was_recorded() -> None:
    for event in MONITOR_ACTIONS:
        assert any("not recorded: " in line for line in lines_of(AuditRecord(id="1", time=1, event=event)))


def test_withheld_contents_are_named() -> None:
    detail = {"monitor": "m", "at": ["m.rv:3"], "withheld": ["before", "conditions"]}
    lines = list(lines_of(AuditRecord(id="1", time=0, event="message dropped", detail=detail)))
    assert lines[-1] == "this role may not read contents of messages"
