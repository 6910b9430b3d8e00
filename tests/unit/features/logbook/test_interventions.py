from typing import Any

import pytest

from appliance.audit.log.events import EVENTS
from appliance.audit.log.record import AuditRecord
from appliance.audit.log.record_format import LogEntry, rfc3339
from appliance.features.logbook.interventions import (
    GAPS,
    NO_INTERVENTION,
    SUBJECT_OF,
    SUBJECTS,
    Interventions,
)
from appliance.features.logbook.log_source import origin_of
from appliance.features.logbook.machine_report import (
    BLOCKED,
    ENDS_OF_DRIVING,
    OFF,
    RUNS,
    LastingState,
    MachineInterface,
    MachineReport,
    Period,
    driver_spans,
    pauses,
    spans,
)
from appliance.features.logbook.report_words import page, report_lines

HOUR = 3_600_000_000_000
ALWAYS = Period(0, 1000 * HOUR)


def entry(hour: float, event: str, resource: str = "", reason: str = "", **detail: Any) -> LogEntry:
    number = round(hour * 100) + 1
    record = AuditRecord(
        id=f"{number:020x}",
        time=round(hour * HOUR),
        event=event,
        resource=resource or None,
        host=resource or None,
        reason=reason,
        detail=detail,
    )
    return LogEntry(number, record)


def read(*entries: LogEntry) -> Interventions:
    interventions = Interventions("a")
    interventions.add(entries)
    return interventions


def test_each_event_is_an_intervention_a_gap_or_neither() -> None:
    """A new event must say here whether it changes the machine's safety settings."""
    places = [*SUBJECT_OF, *GAPS, *NO_INTERVENTION]
    assert sorted(places) == sorted(EVENTS)
    assert sum(map(len, SUBJECTS.values())) == len(SUBJECT_OF)


def test_a_value_has_what_it_was_before() -> None:
    (row,) = read(
        entry(1, "monitor set", "speed", who="ann", before={"vMax": 1.5}, values={"vMax": 0.5})
    ).rows
    assert (row.what, row.who, row.before, row.after) == ("speed", "ann", "vMax = 1.5", "vMax = 0.5")


def test_a_policy_has_the_hash_before_and_after_and_its_changed_lines() -> None:
    rows = read(
        entry(1, "policy loaded", sha256="aa", who="disk"),
        entry(2, "policy loaded", sha256="bb", who="ann", diff=["-/cmd_vel = robot", "+/cmd_vel = *"]),
    ).rows
    assert [(row.sha256_before, row.sha256_after) for row in rows] == [("", "aa"), ("aa", "bb")]
    assert rows[1].diff == ["-/cmd_vel = robot", "+/cmd_vel = *"]


def test_a_changed_setting_is_named_without_its_value() -> None:
    rows = read(
        entry(1, "appliance started", version="0.4.0", configuration={"sso": "11", "audit": "22"}),
        entry(2, "appliance started", version="0.4.1", configuration={"sso": "33", "audit": "22"}),
    ).rows
    assert [row.diff for row in rows] == [[], ["appliance.yaml: sso changed"]]
    assert (rows[1].before, rows[1].after) == ("0.4.0", "0.4.1")


def test_a_guard_that_was_off_has_its_time_its_author_and_who_ended_it() -> None:
    rows = read(
        entry(1, "monitor disabled", "speed", who="ann"),
        entry(2, "monitor disabled", "fence", who="bob"),
        entry(3, "monitor enabled", "speed", who="eve"),
    ).rows
    found = {span.what: span for span in spans(rows, OFF, ALWAYS)}
    assert (found["speed"].since_utc, found["speed"].until_utc) == (rfc3339(HOUR), rfc3339(3 * HOUR))
    assert (found["speed"].by, found["speed"].ended_by) == ("ann", "eve")
    assert found["fence"].until_utc == ""


@pytest.mark.parametrize(
    ("since", "until", "seen"),
    [(0, 1, False), (0, 1.5, True), (1.5, 2.5, True), (3.5, 9, False), (2.5, 9, True)],
)
def test_a_span_is_in_a_period_that_it_meets(since: float, until: float, seen: bool) -> None:
    rows = read(entry(1, "host blocked", "10.0.0.9", who="ann"), entry(3, "host unblocked", "10.0.0.9")).rows
    period = Period(round(since * HOUR), round(until * HOUR))
    assert bool(spans(rows, BLOCKED, period)) is seen


def test_each_start_begins_the_time_of_a_version() -> None:
    rows = read(
        entry(1, "appliance started", version="0.3.0"), entry(5, "appliance started", version="0.4.0")
    ).rows
    assert [(span.state, span.since_utc, span.until_utc) for span in spans(rows, RUNS, ALWAYS, one=True)] == [
        ("0.3.0", rfc3339(HOUR), rfc3339(5 * HOUR)),
        ("0.4.0", rfc3339(5 * HOUR), ""),
    ]


def drove(*entries: LogEntry, at: float) -> list[LastingState]:
    moment = round(at * HOUR)
    return driver_spans(read(*entries).rows, Period(moment, moment + 1))


_HANDED = (
    entry(1, "authority handed over", "base", earlier="nobody", holder="10.0.0.5", who="ann"),
    entry(2, "authority handed over", "base", earlier="10.0.0.5", holder="10.0.0.6", who="bob"),
    entry(3, "authority handed over", "base", earlier="10.0.0.6", holder="nobody", who="bob"),
)


@pytest.mark.parametrize(
    ("at", "host"), [(0.5, None), (1, "10.0.0.5"), (1.5, "10.0.0.5"), (2.5, "10.0.0.6"), (3.5, None)]
)
def test_the_driver_at_a_time(at: float, host: str | None) -> None:
    assert [span.state for span in drove(*_HANDED, at=at)] == ([] if host is None else [host])


def test_the_end_of_the_appliance_ends_who_drove() -> None:
    entries = (_HANDED[0], entry(1.5, "appliance stopped"), entry(4, "appliance started", version="1"))
    assert drove(*entries, at=1.2) and not drove(*entries, at=2)
    for event in ENDS_OF_DRIVING:
        ended = (_HANDED[0], entry(4, event, "control"))
        assert drove(*ended, at=3) and not drove(*ended, at=5)


def test_a_crash_and_an_ordered_end_are_different_gaps() -> None:
    rows = read(
        entry(1, "appliance started"),
        entry(2, "appliance stopped"),
        entry(3, "appliance started"),
        entry(5, "appliance started"),
    ).rows
    ordered, crash = pauses(rows, ALWAYS)
    assert "shut down in order" in ordered.reason and "(3600 s)" in ordered.reason
    assert "a crash or a power cut" in crash.reason


def test_an_appliance_that_was_not_started_again_is_a_gap() -> None:
    rows = read(entry(1, "appliance started"), entry(2, "appliance stopped")).rows
    (gap,) = pauses(rows, ALWAYS)
    assert "not started again" in gap.reason
    assert not pauses(rows, Period(0, HOUR))


@pytest.mark.parametrize(
    ("calls", "origin"),
    [
        ([("ann", "10.0.0.1")], "10.0.0.1"),
        ([("bob", "10.0.0.2"), ("ann", "10.0.0.1"), ("ann", "10.0.0.1")], "10.0.0.1"),
        ([("ann", "10.0.0.1"), ("ann", "10.0.0.2")], ""),
        ([("bob", "10.0.0.2")], ""),
    ],
)
def test_an_origin_is_named_only_without_doubt(calls: list[tuple[str, str]], origin: str) -> None:
    (row,) = read(entry(1, "monitor set", "speed", who="ann")).rows
    made = [
        entry(1 + number / 10_000, "rest call", host, who=who, method="POST")
        for number, (who, host) in enumerate(calls)
    ]
    assert origin_of(row, made) == origin


EVIL = "<script>alert(1)</script>\x1b[31m"


def report(**changes: Any) -> MachineReport:
    fields: dict[str, Any] = {
        "robot": EVIL, "logs": ["ab"], "since_utc": rfc3339(0), "until_utc": rfc3339(9 * HOUR),
        "made_utc": rfc3339(9 * HOUR),
        "version": "1", "log_begins_utc": rfc3339(HOUR),
        "interventions": read(entry(2, "policy loaded", EVIL, EVIL, who=EVIL, sha256=EVIL, diff=[EVIL])).rows,
        "switched_off": [], "blocks": [], "software": [], "drivers": [],
        "interfaces": [MachineInterface(name=EVIL, where=EVIL, commands=EVIL, protection=EVIL)], "rights": [EVIL],
        "live_reason": "", "gaps": [], "verification": None,
    }  # fmt: skip
    return MachineReport(**fields | changes)


def test_the_page_has_no_script_and_nothing_of_a_peer_unescaped() -> None:
    made = page(report())
    assert "<script" not in made and "\x1b" not in made
    assert "http://" not in made and "https://" not in made
    assert made.count("&lt;script&gt;") > 8


def test_the_page_and_the_lines_say_what_is_not_covered_and_not_verified() -> None:
    for text in (page(report()), "\n".join(report_lines(report()))):
        assert f"{rfc3339(0)} to {rfc3339(HOUR)}: the log begins later" in text
        assert "no result of `rosrv audit verify` is stored here" in text
    stopped = page(report(interfaces=[], rights=[], live_reason="not known: no appliance is running"))
    assert stopped.count("not known: no appliance is running") == 2
