from appliance.audit.log.record import AuditRecord, Severity
from appliance.telemetry.audit_trail import LastMinute, Meter


def test_only_the_last_minute_counts() -> None:
    now = 100.2
    counted = LastMinute(lambda: now)
    counted.add("publish", 5)
    counted.add("node")
    now = 130.0
    counted.add("publish")
    assert counted.counts() == {"publish": 6, "node": 1}
    now = 159.9
    assert counted.counts() == {"publish": 6, "node": 1}
    now = 160.0
    assert counted.counts() == {"publish": 1}
    now = 1000.0
    assert counted.counts() == {}


def test_a_flood_holds_a_minute_of_seconds() -> None:
    now = 0.0
    counted = LastMinute(lambda: now)
    for second in range(3600):
        now = float(second)
        counted.add("publish", 2)
    assert counted.counts() == {"publish": 120}


def test_only_denials_count_as_denied() -> None:
    meter = Meter()
    for word in ("deny", "allow", "would deny", "ask", "deny"):
        meter.count_record(_record("decision", word))
    assert meter.denied.counts() == {"publish": 2}


def test_a_right_that_ended_does_not_count_as_a_denied_request() -> None:
    """`rosrv status` counts what `rosrv audit summary` does; a fleet's trial still sees what the robot lost."""
    meter = Meter()
    meter.count_record(_record("revoked", "deny"))
    assert (meter.denied.counts(), meter.most_denied()) == ({}, "")
    assert (meter.decisions["publish", "deny"], meter.denied_hosts.counts()) == (1, {"10.0.0.5": 1})


def test_the_most_denied_host_has_its_name() -> None:
    meter = Meter()
    meter.count_record(_record("decision", "deny"))
    assert meter.most_denied(lambda host: f"robot ({host})").startswith("robot (10.0.0.5) was denied publish")


def _record(event: str, word: str) -> AuditRecord:
    return AuditRecord(
        id="1",
        time=0,
        event=event,
        severity=Severity.INFO,
        decision=word,
        host="10.0.0.5",
        category="publish",
    )
