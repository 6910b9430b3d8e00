import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from appliance.audit.log.events import EVENTS
from appliance.audit.log.record import AuditRecord
from appliance.audit.log.record_format import LogEntry, rfc3339
from appliance.audit.proof.chain_findings import VerificationResult
from appliance.features.logbook.log_source import origin_of
from appliance.formats.interventions import (
    CHANGES,
    GAPS,
    NO_INTERVENTION,
    NOTHING_CHANGED,
    SUBJECT_OF,
    SUBJECTS,
    Intervention,
    fields_of,
)
from appliance.formats.machine_report import (
    ENDS_OF_DRIVING,
    LastingState,
    MachineInterface,
    MachineReport,
    MachineRight,
    Period,
    Reading,
    ReportedLog,
    merge,
    read_records,
)
from appliance.formats.report_words import page, report_lines
from distribution.fact_cache import nodes, statements

HOUR = 3_600_000_000_000
ALWAYS = Period(0, 1000 * HOUR)


def entry(hour: float, event: str, resource: str = "", reason: str = "", **detail: Any) -> LogEntry:
    number = round(hour * 100) + 1
    record = AuditRecord(
        id=f"{number:020x}", time=round(hour * HOUR), event=event, resource=resource or None,
        host=resource or None, reason=reason, detail=detail,
    )  # fmt: skip
    return LogEntry(number, record)


def read(*entries: LogEntry, period: Period = ALWAYS) -> Reading:
    return read_records(merge({"": entries}), period)


def rows_of(*entries: LogEntry) -> list[Intervention]:
    return read(*entries).interventions


def test_each_event_is_an_intervention_a_gap_or_neither() -> None:
    """A new event must say here whether it changes the machine's safety settings."""
    places = [*SUBJECT_OF, *GAPS, *NO_INTERVENTION]
    assert sorted(places) == sorted(EVENTS)
    assert sum(map(len, SUBJECTS.values())) == len(SUBJECT_OF)


def test_a_value_has_what_it_was_before() -> None:
    (row,) = rows_of(entry(1, "monitor set", "speed", who="ann", before={"vMax": 1.5}, values={"vMax": 0.5}))
    assert (row.what, row.who, row.before, row.after) == ("speed", "ann", "vMax = 1.5", "vMax = 0.5")


def test_a_policy_has_the_hash_before_and_after_and_its_changed_lines() -> None:
    rows = rows_of(
        entry(1, "policy loaded", sha256="aa", who="disk"),
        entry(2, "policy loaded", sha256="bb", who="ann", diff=["-/cmd_vel = robot", "+/cmd_vel = *"]),
    )
    assert [(row.sha256_before, row.sha256_after) for row in rows] == [("", "aa"), ("aa", "bb")]
    assert rows[1].diff == ["-/cmd_vel = robot", "+/cmd_vel = *"]


def test_changed_lines_that_a_record_has_no_room_for_are_not_missed() -> None:
    (row,) = rows_of(entry(1, "specifications loaded", sha256="bb", earlier_sha256="aa", cut="too large"))
    assert row.diff == ["(too many changed lines for the record: compare the texts of both SHA-256)"]


def test_a_record_says_itself_what_was_before() -> None:
    """So retention of the record before it, or a log that was replaced, hides nothing."""
    (row,) = rows_of(entry(1, "specifications loaded", sha256="bb", earlier_sha256="aa", diff=["-1", "+2"]))
    assert (row.sha256_before, row.sha256_after, row.diff) == ("aa", "bb", ["-1", "+2"])


def test_a_changed_setting_is_named_and_only_those_of_sign_on_have_values() -> None:
    def start(hour: float, sso: str, **values: str) -> LogEntry:
        configuration = {"sso": sso, "audit": "22"}
        settings = {"sso": values} if values else {}
        return entry(
            hour, "appliance started", version=f"0.{hour}", configuration=configuration, settings=settings
        )

    rows = rows_of(start(1, "11"), start(2, "33", roles="{'admin': ['it']}"), start(3, "44", roles="{}"))
    assert [row.diff for row in rows] == [
        [],
        ["appliance.yaml: sso changed", "-sso.roles: the default", "+sso.roles: {'admin': ['it']}"],
        ["appliance.yaml: sso changed", "-sso.roles: {'admin': ['it']}", "+sso.roles: {}"],
    ]
    assert (rows[1].before, rows[1].after) == ("0.1", "0.2")


def off(*entries: LogEntry) -> dict[str, LastingState]:
    return {span.what: span for span in read(*entries).switched_off}


def test_a_guard_that_was_off_has_its_time_its_author_and_who_ended_it() -> None:
    states = off(
        entry(1, "monitor disabled", "speed", who="ann"),
        entry(2, "monitor disabled", "fence", who="bob"),
        entry(3, "monitor enabled", "speed", who="eve"),
    )
    assert (states["speed"].since_utc, states["speed"].until_utc) == (rfc3339(HOUR), rfc3339(3 * HOUR))
    assert (states["speed"].by, states["speed"].ended_by) == ("ann", "eve")
    assert states["fence"].until_utc == ""


@pytest.mark.parametrize(
    ("detail", "until"),
    [
        ({"monitors": ["fence"]}, 3),  # a record of an earlier version
        ({"monitors": ["fence"], "off": {}}, 3),
        ({"monitors": ["fence", "speed"], "off": {}}, 3),  # loaded, and in force
        ({"monitors": ["fence", "speed"], "off": {"speed": "disabled"}}, None),
        ({"monitors": ["fence", "speed"]}, None),
        ({"cut": "the details were too large to keep"}, None),
    ],
)
def test_a_guard_that_is_removed_while_it_is_off_is_off_no_longer(
    detail: dict[str, Any], until: int | None
) -> None:
    states = off(
        entry(1, "monitor disabled", "speed", who="ann"),
        entry(3, "specifications loaded", sha256="b", who="eve", **detail),
    )
    assert states["speed"].until_utc == ("" if until is None else rfc3339(until * HOUR))
    assert states["speed"].ended_by == ("" if until is None else "eve")


def test_a_guard_that_was_never_on_is_off_from_its_load() -> None:
    loaded: dict[str, Any] = {"sha256": "b", "monitors": ["speed"], "off": {"speed": "disabled"}}
    states = off(
        entry(1, "specifications loaded", who="ann", **loaded),
        entry(2, "monitor enabled", "speed", who="bob"),
        entry(4, "appliance started", version="1", off={"fence": "in shadow mode"}),
    )
    assert (states["speed"].since_utc, states["speed"].until_utc) == (rfc3339(HOUR), rfc3339(2 * HOUR))
    assert (states["fence"].state, states["fence"].until_utc) == ("in shadow mode", "")


@pytest.mark.parametrize(
    ("since", "until", "seen"),
    [(0, 1, False), (0, 1.5, True), (1.5, 2.5, True), (3.5, 9, False), (2.5, 9, True)],
)
def test_a_span_is_in_a_period_that_it_meets(since: float, until: float, seen: bool) -> None:
    entries = entry(1, "host blocked", "10.0.0.9", who="ann"), entry(3, "host unblocked", "10.0.0.9")
    period = Period(round(since * HOUR), round(until * HOUR))
    assert bool(read(*entries, period=period).blocks) is seen


def test_each_start_begins_the_time_of_a_version() -> None:
    states = read(
        entry(1, "appliance started", version="0.3.0"), entry(5, "appliance started", version="0.4.0")
    ).software
    assert [(span.state, span.since_utc, span.until_utc) for span in states] == [
        ("0.3.0", rfc3339(HOUR), rfc3339(5 * HOUR)),
        ("0.4.0", rfc3339(5 * HOUR), ""),
    ]


def drove(*entries: LogEntry, at: float) -> list[LastingState]:
    moment = round(at * HOUR)
    return read(*entries, period=Period(moment, moment + 1)).drivers


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
    ordered, crash = read(
        entry(1, "appliance started"),
        entry(2, "appliance stopped"),
        entry(3, "appliance started"),
        entry(5, "appliance started"),
    ).gaps
    assert "shut down in order" in ordered.reason and "(3600 s)" in ordered.reason
    assert "a crash or a power cut" in crash.reason


def test_an_appliance_that_was_not_started_again_is_a_gap() -> None:
    entries = entry(1, "appliance started"), entry(2, "appliance stopped")
    (gap,) = read(*entries).gaps
    assert "not started again" in gap.reason
    assert not read(*entries, period=Period(0, HOUR)).gaps


@pytest.mark.parametrize("event", GAPS)
def test_acts_that_leave_the_chain_whole_are_gaps(event: str) -> None:
    """A moved clock, a full disk, a log that was replaced: `verify` cannot know of these, and the report names them."""
    (gap,) = read(entry(1, event, reason="why")).gaps
    assert (gap.event, gap.reason) == (event, "why")
    assert not read(entry(1, event), period=Period(0, HOUR)).gaps


def test_an_address_has_the_name_that_the_records_gave_it_then() -> None:
    """A host that was enrolled under another name later keeps its name in the rows of before."""
    rows = rows_of(
        entry(1, "host blocked", "10.77.0.5", address="10.77.0.5", until=None, earlier="not blocked"),
        entry(2, "host enrolled", name="tablet", address="10.77.0.5"),
        entry(3, "host unblocked", "10.77.0.5", address="10.77.0.5", earlier="blocked by ann"),
        entry(4, "door added", "agent", address="10.78.0.1", port=9091, source=None),
        entry(5, "authority handed over", "base", earlier="nobody", holder="10.78.0.1"),
        entry(6, "host enrolled", name="arm", address="10.77.0.5"),
        entry(7, "host blocked", "10.77.0.5", address="10.77.0.5", until=None, earlier="not blocked"),
    )
    names = [row.names for row in rows if row.event not in ("host enrolled", "door added")]
    assert names == [{}, {"10.77.0.5": "tablet"}, {"10.78.0.1": "agent"}, {"10.77.0.5": "arm"}]


def test_two_logs_are_one_history_by_time_and_a_moved_record_counts_once() -> None:
    moved = entry(5, "policy file refused", reason="moved", kept={"sequence": 1, "hash": "aa"})
    early = LogEntry(
        moved.sequence,
        AuditRecord(id="f" * 20, time=HOUR // 2, event="policy file refused", detail={"kept": {}}),
    )
    again = LogEntry(2, early.record)
    a = [again, entry(0.9, "monitor disabled", "speed", who="ann"), _HANDED[0], early]
    b = [
        entry(6, "took over", appliance="b", other="a"),
        entry(7, "monitor enabled", "speed", who="bob", earlier="disabled"),
    ]
    reading = read_records(merge({"a": a, "b": b}), ALWAYS)
    assert [(row.appliance, row.event) for row in reading.interventions] == [
        ("a", "policy file refused"), ("a", "monitor disabled"), ("a", "authority handed over"),
        ("b", "took over"), ("b", "monitor enabled"),
    ]  # fmt: skip
    (switched,) = reading.switched_off
    assert (switched.appliance, switched.until_utc) == ("a", rfc3339(7 * HOUR))
    (driver,) = reading.drivers
    assert driver.until_utc == rfc3339(6 * HOUR)  # a takeover ends who drove


def test_a_clock_that_was_set_back_does_not_change_the_order_of_a_log() -> None:
    late, early = (
        entry(5, "monitor disabled", "speed"),
        entry(2, "monitor enabled", "speed", earlier="disabled"),
    )
    backwards = [LogEntry(1, late.record), LogEntry(2, early.record)]
    reading = read_records(
        merge({"a": backwards, "b": [entry(3, "host renewed", name="t", replaced="1")]}), ALWAYS
    )
    events = [row.event for row in reading.interventions]
    assert events == ["host renewed", "monitor disabled", "monitor enabled"]


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
    (row,) = rows_of(entry(1, "monitor set", "speed", who="ann"))
    made = [
        entry(1 + number / 10_000, "rest call", host, who=who, method="POST")
        for number, (who, host) in enumerate(calls)
    ]
    assert origin_of(row, made) == origin


# --- each intervention's record has the state before and after ---

PACKAGE = Path(__file__).resolve().parents[4] / "appliance"
_RECORDERS = {"happened", "_record", "_ended", "_note", "_make", "_own"}


@cache
def calls() -> list[tuple[Path, str, ast.Call]]:
    """Return the calls that record something, with the name of the called method."""
    found = []
    for file in sorted(PACKAGE.rglob("*.py")):
        text = file.read_text(encoding="utf-8")
        if file.parent.name in ("logbook", "formats") or not any(f"{name}(" in text for name in _RECORDERS):
            continue
        for node in nodes(ast.parse(text)):
            if (
                isinstance(node, ast.Call)
                and isinstance(node.func, ast.Attribute)
                and node.func.attr in _RECORDERS
            ):
                found.append((file, node.func.attr, node))
    return found


def _fields(code: ast.AST) -> Iterator[str]:
    """Yield the names of the detail's fields that code states: as keywords, or as keys of a dict."""
    for node in nodes(code):
        if isinstance(node, ast.keyword) and node.arg is not None:
            yield node.arg
        if isinstance(node, ast.Dict):
            yield from (
                key.value for key in node.keys if isinstance(key, ast.Constant) and isinstance(key.value, str)
            )


def _states(call: ast.Call, event: str) -> bool:
    return any(isinstance(arg, ast.Constant) and arg.value == event for arg in call.args)


@cache
def _helper(file: Path, name: str) -> set[str]:
    """Return the fields that a method adds, which records several events."""
    found = (
        node
        for node in statements(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef)
    )
    return {field for node in found if node.name == name for field in _fields(node)}


def recorded(event: str) -> list[set[str]]:
    """Return the fields of each place that records an event."""
    named = [(file, method, call) for file, method, call in calls() if _states(call, event)]
    if not named:  # the event is chosen from a table: every call of that module whose event is not a text
        files = {file for file, _, _ in calls() if f'"{event}"' in file.read_text(encoding="utf-8")}
        named = [
            (file, method, call)
            for file, method, call in calls()
            if file in files and call.args and not isinstance(call.args[0], ast.Constant)
        ]
    return [
        {*_fields(call), *(_helper(file, method) if method != "happened" else ())}
        for file, method, call in named
    ]


def test_the_place_of_a_start_is_found() -> None:
    """The rule below would pass for an event whose record is not found, so it must find each."""
    assert [event for event in SUBJECT_OF if not recorded(event)] == []


@pytest.mark.parametrize("event", SUBJECT_OF)
def test_each_interventions_record_has_the_state_before_and_after(event: str) -> None:
    change = CHANGES[event]
    if event == "appliance started":
        assert {"version", "configuration", "settings", "off"} <= sources_of_a_start()
        return
    if change != NOTHING_CHANGED:
        assert (change.before or change.text_before) and (change.after or change.text_after)
    for fields in recorded(event):
        assert fields_of(change) <= fields, f"the record {event!r} lacks {sorted(fields_of(change) - fields)}"
        if change.text_after and event not in _OPAQUE:
            assert "diff" in fields, f"the record {event!r} has no changed lines"


_OPAQUE = {"bundle in force", "rest certificate replaced", "host authority replaced"}
"""Their texts are archives or keys; the parts of a bundle have records of their own."""


def sources_of_a_start() -> set[str]:
    text = (PACKAGE / "control/process.py").read_text(encoding="utf-8")
    return {key for key in ("version", "configuration", "settings", "off") if f'"{key}":' in text}


@pytest.mark.parametrize("event", [event for event in SUBJECT_OF if CHANGES[event] != NOTHING_CHANGED])
def test_each_change_is_in_words(event: str) -> None:
    """With the fields that the record must have, the report has both states, and no field's name."""
    detail = dict.fromkeys(fields_of(CHANGES[event]), "some")
    first = [entry(0.5, "appliance started", version="0")] if event == "appliance started" else []
    *_, row = rows_of(*first, entry(1, event, **detail))
    assert (row.before or row.sha256_before) and (row.after or row.sha256_after)
    assert "{" not in row.before + row.after


def test_times_mappings_and_none_are_in_words() -> None:
    (blocked,) = rows_of(entry(1, "host blocked", address="10.0.0.9", earlier="not blocked", until=None))
    assert blocked.after == "blocked until an order ends it"
    (token,) = rows_of(entry(1, "token added", role="admin", expires=3600.0))
    assert token.after == "admin until 1970-01-01T01:00:00Z"
    (door,) = rows_of(entry(1, "door removed", "agent", address="10.78.0.1", port=9091, source=None))
    assert (door.before, door.after) == ("address 10.78.0.1, port 9091, from any address", "no door")


# --- the page ---

EVIL = "<script>alert(1)</script>\x1b[31m"


def report(**changes: Any) -> MachineReport:
    log = ReportedLog(name="", id="ab", begins_utc=rfc3339(HOUR), last=9, verification=None)
    fields: dict[str, Any] = {
        "robot": EVIL, "logs": [log], "since_utc": rfc3339(0), "until_utc": rfc3339(9 * HOUR),
        "made_utc": rfc3339(9 * HOUR), "version": "1", "verify": "rosrv audit verify",
        "interventions": rows_of(entry(2, "policy loaded", EVIL, EVIL, who=EVIL, sha256=EVIL, diff=[EVIL])),
        "switched_off": [], "blocks": [], "software": [], "drivers": [],
        "interfaces": [MachineInterface(name=EVIL, where=EVIL, commands=EVIL, protection=EVIL)],
        "rights": [MachineRight(what=EVIL, who=EVIL, by=EVIL)], "live_reason": "", "gaps": [],
    }  # fmt: skip
    return MachineReport(**fields | changes)


def test_the_page_has_no_script_and_nothing_of_a_peer_unescaped() -> None:
    made = page(report())
    assert "<script" not in made and "\x1b" not in made
    assert "http://" not in made and "https://" not in made
    assert made.count("&lt;script&gt;") > 8


def test_the_page_and_the_lines_say_what_is_not_covered_and_not_verified() -> None:
    for text in (page(report()).replace(" 0", "T0"), "\n".join(report_lines(report()))):
        assert "to 1970-01-01T01:00:00" in text and ": the audit log begins later" in text
        assert "none is stored here: run `rosrv audit verify`" in text
    stopped = page(report(interfaces=[], rights=[], live_reason="not known: no appliance is running"))
    assert stopped.count("<p>not known: no appliance is running</p>") == 2


@pytest.mark.parametrize(
    ("log", "through", "words"),
    [
        ("ab", 9, "9 records: The log is consistent, but nothing is signed yet"),
        ("ab", 7, "2 later records are not verified"),
        ("cd", 9, "It is of another log (cd), and says nothing of this one"),
    ],
)
def test_a_verification_says_of_what_it_is(log: str, through: int, words: str) -> None:
    result = VerificationResult(
        time_utc=rfc3339(HOUR), complete=True, records=9, text="", log=log, through=through,
        verdict="The log is consistent, but nothing is signed yet",
    )  # fmt: skip
    known = ReportedLog(name="", id="ab", begins_utc=rfc3339(HOUR), last=9, verification=result)
    assert words in page(report(logs=[known]))


def test_a_name_of_now_is_marked_and_a_name_of_then_is_not() -> None:
    rows = rows_of(entry(0.5, "host enrolled", name="tablet", address="10.77.0.5"), *_HANDED[:1])
    made = page(
        report(interventions=rows),
        lambda address: f"joystick ({address})" if address == "10.0.0.5" else address,
    )
    assert "10.0.0.5 (now joystick)" in made


def test_two_machines_have_a_column() -> None:
    reading = read_records(
        merge({"a": [_HANDED[0]], "b": [entry(5, "took over", appliance="b", other="a")]}), ALWAYS
    )
    logs = [
        ReportedLog(name=name, id=name, begins_utc=rfc3339(HOUR), last=1, verification=None) for name in "ab"
    ]
    made = report(logs=logs, interventions=reading.interventions, drivers=reading.drivers)
    assert "<tr><th>machine<th>time (UTC)" in page(made) and "<th>machine" not in page(report())
    assert any("  b  took over" in line for line in report_lines(made))
