"""Every action of a monitor is explained: the host, the events, the values and the line.

The events that a record names are replayed alone, from the initial state, and must have the same effect. The lines
for people come from the record, as `rosrv audit why`, REST and the console show them.
"""

import struct
from collections.abc import Collection, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import pytest

from appliance.audit.log.record_format import LogEntry, without_contents
from appliance.channel.messages import MonitorEvent
from appliance.features.policy_tools.explanations import lines_of
from appliance.relay.monitors.observation_points import ObservationPoint
from appliance.specifications.records import MonitorRecords
from rosmop.run.outcomes import moment
from rosmop.tests.acting import message
from rosmop.tests.random_specifications import Traffic, definitions
from tests.support.core import FakeTrail
from tests.unit.relay.monitors.test_batch_progress import Monitored

MS = 1_000_000
START = 1_900_000_000_000 * MS
"""Later than the present: in shadow mode, specifications read the clock, which must not be ahead of the messages."""


EMPTY: Mapping[str, Any] = MappingProxyType({})


class Given(NamedTuple):
    at: int
    where: str
    value: int
    who: str


class Row(NamedTuple):
    text: str
    given: list[Given]
    kind: str
    by: str
    at: str
    because: Sequence[tuple[str, str]] = ()
    """The events, with their senders, that explain the verdict, or the verdict whose handler acted."""
    where: Mapping[str, Mapping[str, object]] = EMPTY
    values: Mapping[str, object] = EMPTY
    restarted: bool = False


def events_of(
    row: Row, given: Iterable[Given], *, together: bool, shadows: Collection[str] = ()
) -> list[MonitorEvent]:
    monitored = Monitored(
        {"x.rv": row.text}, definitions(), together=together, shadows=shadows, restarted=row.restarted,
        began=START,
    )  # fmt: skip
    try:
        for one in given:
            monitored.time = START + one.at * MS
            if one.where == "request":
                point = ObservationPoint("k", "/mode", "10.0.0.8", one.who)
                monitored.interceptor.judge(point, "request", bytes([one.value]))
            elif one.where == "response":
                point = ObservationPoint("k", "/mode", "10.0.0.9", one.who)
                monitored.interceptor.judge(point, "response", struct.pack("<BI", one.value, 0))
            else:
                body = message("std_msgs/Int32", data=one.value)
                monitored.through(
                    Traffic(one.where, struct.pack("<I", len(body)) + body, 1), publisher=one.who
                )
            if shadows:
                monitored.interceptor.shadow.have_turn()
        monitored.interceptor.observations.flush()
        return [one for one in monitored.sent() if isinstance(one, MonitorEvent)]
    finally:
        monitored.close()


def told(row: Row, given: Iterable[Given], *, together: bool, shadow: bool = False) -> MonitorEvent | None:
    names = [row.text.removeprefix("hold ").split("(")[0].strip()] if shadow else []
    kind = f"shadow {row.kind}" if shadow else row.kind
    events = events_of(row, given, together=together, shadows=names)
    return next((event for event in events if event.kind == kind and not event.count), None)


def place(text: str, piece: str) -> str:
    before = text[: text.index(piece) + (len(piece) + 1) * piece.endswith(":")]
    return f"x.rv:{before.count(chr(10)) + 1}:{len(before) - before.rfind(chr(10))}"


def check(row: Row, *, together: bool, shadow: bool = False) -> None:
    event = told(row, row.given, together=together, shadow=shadow)
    assert event is not None
    detail = event.detail
    assert event.caller_id == row.by
    assert bool(event.host) is bool(row.by)
    at = place(row.text, row.at)
    assert at in detail["at"]
    where = {place(row.text, piece): values for piece, values in row.where.items()}
    assert detail.get("conditions", {}) == where
    assert detail.get("values", {}) == row.values
    named = detail.get("why", {}).get("events", [])
    assert [(one["event"], one.get("node", "")) for one in named] == [*row.because]
    check_lines(row, event, at, where)
    if named:
        times = {one["time"] for one in named}
        alone = [one for one in row.given if moment(START + one.at * MS) in times]
        again = told(
            row, [*alone, Given(row.given[-1].at, "/clock", 0, "/clock")], together=together, shadow=shadow
        )
        assert again is not None
        assert again.text == event.text


def check_lines(row: Row, found: MonitorEvent, at: str, where: Mapping[str, Mapping[str, object]]) -> None:
    """Check the explanation that people read."""
    trail = FakeTrail()
    MonitorRecords(trail, lambda _topic, _data: None, []).reported([found], 0, 0)
    (record,) = trail.records
    lines = list(lines_of(record))
    assert lines[0] == record.reason
    assert any(line.startswith("by: ") and f"{row.by} on {found.host}" in line for line in lines) is bool(
        row.by
    )
    assert any(line.startswith("at: ") and at in line for line in lines)
    assert [line.split(",")[0] for line in lines if line.startswith("where: ")] == [
        f"where: {one}" for one in where
    ]
    assert [line for line in lines if line.startswith("because: ")] == [
        line
        for line in lines
        if any(line.startswith(f"because: {event} at ") for event, _node in row.because)
    ]
    assert sum(line.startswith("because: ") for line in lines) == len(row.because)
    for name, value in (*row.values.items(), *(pair for one in where.values() for pair in one.items())):
        assert any(f"{name} = {value}" in line for line in lines)
    hidden = "\n".join(lines_of(without_contents(LogEntry(1, record)).record))
    assert "because: " not in hidden
    assert "where: " not in hidden
    assert "with: " not in hidden


INT = "std_msgs/Int32 '{data:%s}'"
DONE = "event done() /alarm std_msgs/Int32 '{}' { }"
CLOCK = "event clock() /clock std_msgs/Int32 '{}' { }"
A, B = (f"event {name}(int {name}) /{name} std_msgs/Int32 '{{data:{name}}}'" for name in "ab")
ARM, STICK = "/arm", "/stick"
BOTH = [("a", ARM), ("b", STICK)]


def given(text: str) -> list[Given]:
    """Parse messages 10 ms apart: `a5` is 5 on /a from the arm, `b1` is 1 on /b from the stick.

    A `.` adds 10 ms, and `c0` lets the time pass.
    """
    who = {"a": ARM, "b": STICK, "c": "/clock", "q": "/client", "r": "/server"}
    where = {"c": "/clock", "q": "request", "r": "response"}
    found, now = [], 0
    for word in text.split():
        now += 10
        if word != ".":
            found.append(Given(now, where.get(word[0], f"/{word[0]}"), int(word[1:]), who[word[0]]))
    return found


def row(text: str, words: str, *what: Any, **more: Any) -> Row:
    return Row(text, given(words), *what, **more)


def m(body: str, *what: Any, **more: Any) -> Row:
    """Return a row of the monitor `m` with this body."""
    return row(f"m() {{ {body} }}", *what, **more)


def logic(formula: str, words: str, because: list[tuple[str, str]], by: str = STICK) -> Row:
    text = f"m() {{ {A} {{ }} {B} {{ }} {CLOCK}\n {formula} {{ }} }}"
    return Row(text, given(words), "verdict", by, formula[: formula.index(":") + 1], because, {})


VERDICTS = {
    "fsm": logic(
        "fsm: up [ a -> armed, clock -> up ] armed [ b -> bad, clock -> armed ] bad [ ] @bad", "c1 a1 b1", BOTH
    ),
    "ere": logic("ere: a b @match", "a1 b1", BOTH),
    "ltl": logic("ltl: [] (a => o !b) @violation", "c1 a1 b1", BOTH),
    "ptltl": logic("ptltl: b -> !(<*> a) @violation", "a1 c1 b1", BOTH),
    "mtl past": logic("mtl: b -> !(once[0,1s] a) @violation", "a1 c1 b1", BOTH),
    "mtl future": logic("mtl: a => !(eventually[0,1s] b) @violation", "a1 c1 b1", BOTH),
    "cfg": logic("cfg: S -> a S b | epsilon @fail", "c1", [("clock", "/clock")], by="/clock"),
    "srs": logic("srs: a b -> #fail . clock -> #epsilon . @fail", "c1 a1 b1", BOTH),
    "ptcaret": logic("ptcaret: b -> !(<*> a) @violation", "a1 c1 b1", BOTH),
    "tfsm": logic(
        "tfsm: up [ a -> armed, default up ] armed [ b -> bad, timeout 1s -> up ] bad [ ] @bad", "a1 b1", BOTH
    ),
    "a timeout of a tfsm": logic(
        "tfsm: up [ a -> armed, default up ] armed [ b -> up, timeout 20ms -> late ] late [ default up ] @late",
        "b1 a1 . . . c0", [("a", ARM)], by="",
    ),
    "a deadline of a pattern": logic(
        "pattern: globally: a causes b within 20ms @violation", "b1 a1 . . . c0", [("a", ARM)], by=""
    ),
    "a deadline of mtl": logic("mtl: a => eventually[0,20ms] b @violation", "b1 a1 . . . c0", [("a", ARM)], by=""),
}  # fmt: skip


@pytest.mark.parametrize("shadow", [False, True], ids=["in force", "shadow"])
@pytest.mark.parametrize("name", VERDICTS)
def test_a_verdict(name: str, *, shadow: bool) -> None:
    check(VERDICTS[name], together=not shadow, shadow=shadow)


WHEN = "when (b > 2)"
ALARM = "std_msgs::Int32 x; PUBLISH(/alarm, std_msgs/Int32, x);"
ERE = "ere: a b @match"
ASK = "event q(bool on) service /mode std_srvs/SetBool request '{data:on}'"
REPLY = "event r(bool ok) service /mode std_srvs/SetBool response '{success:ok}'"
SLICED = f"m(int a) {{ event begin(int a) /a {INT % 'a'} {{ }} event end(int a) /b {INT % 'a'} {{ }}\n"
PAIR = [("begin", ARM), ("end", STICK)]

OUTCOMES = {
    "a verdict with a guard": m(f"{A} {{ }} {B} {WHEN} {{ }} {ERE} {{ }}", "a1 b7", "verdict", STICK, "ere:", BOTH,
        where={"b > 2": {"b": 7}}),
    "a drop": m(f"{B} {WHEN} {{ if (b == 7) {{ DROP; }} }}", "b7", "drop", STICK, "DROP;",
        where={"b > 2": {"b": 7}, "b == 7": {"b": 7}}),
    "a drop by return": m(f"{B} {{ if (b == 7) {{ return; }} }}", "b7", "drop", STICK, "return;",
        where={"b == 7": {"b": 7}}),
    "a drop in a handler": m(f"{A} {{ }} {B} {{ }} {ERE} {{ DROP; }}", "a1 b1", "drop", STICK, "DROP;", BOTH),
    "a drop by a fault": m(f"{B} {{ int zero = b - 7; b = 1 / zero; }}", "b7", "drop", STICK, "1 / zero",
        values={"zero": 0}),
    "a drop by a fault in a handler": m(f"int zero = 0; {A} {{ }} {B} {{ }} {ERE} {{ zero = 1 / zero; }}", "a1 b1",
        "drop", STICK, "1 / zero", BOTH, values={"zero": 0}),
    "what is held": row(f"hold m() {{ {B} {{ }} }}", "b1", "drop", STICK, "hold", restarted=True),
    "what could not begin": m(f"int zero = 0; init() {{ zero = 1 / zero; }} {B} {{ if (b) {{ return; }} }}", "b1",
        "drop", STICK, "m()"),
    "a change": m(f"{B} {WHEN} {{ if (b == 7) {{ b = 1; }} }}", "b7", "change", STICK, "b = 1",
        where={"b > 2": {"b": 7}, "b == 7": {"b": 7}}),
    "a publication": m(f"{B} {WHEN} {{ if (b == 7) {{ {ALARM} }} }}", "b7", "publish", STICK, "PUBLISH",
        where={"b > 2": {"b": 7}, "b == 7": {"b": 7}}),
    "a publication of a function": m(f"warn(int level) {{ if (level == 7) {{ {ALARM} }} }} {B} {{ warn(b); }}", "b7",
        "publish", STICK, "PUBLISH", where={"level == 7": {"level": 7}}),
    "a publication in a handler": m(f"{A} {{ }} {B} {{ }} {ERE} {{ {ALARM} }}", "a1 b1", "publish", STICK, "PUBLISH",
        BOTH),
    "a publication that is enforced": m(
        f"warn() {{ {ALARM} }} {A} {{ }} {B} {{ }} {CLOCK}\n"
        f" {DONE} pattern: globally: a causes done within 20ms enforced by warn @violation {{ }}",
        "b1 a1 . . . c0", "publish", "", "PUBLISH", [("a", ARM)],
    ),
    "a verdict of what is enforced": m(
        f"warn() {{ {ALARM} }} {A} {{ }} {B} {{ }} {CLOCK}\n"
        f" {DONE} pattern: globally: a causes done within 20ms enforced by warn @violation {{ }}",
        "b1 a1 . . . c0", "verdict", "", "pattern:", [("a", ARM)],
    ),
    "a fault": m(f"{B} {WHEN} {{ int zero = b - 7; b = 1 / zero; }}", "b7", "fault", STICK, "1 / zero",
        where={"b > 2": {"b": 7}}, values={"zero": 0}),
    "a publication of a tick": m(
        f"int seen = 0; {B} {{ seen = b; }} {CLOCK}\n"
        f" event tick() every 10ms {{ if (seen == 7) {{ {ALARM} }} }}",
        "b7 . . c0", "publish", "", "PUBLISH", where={"seen == 7": {"seen": 7}},
    ),
    "a verdict of a tick": m(
        f"{B} {{ }} event tick() every 10ms {{ }} {CLOCK}\n ptltl: tick -> !(<*> b) @violation {{ }}", "b7 . . c0",
        "verdict", "", "ptltl:", [("b", STICK), ("tick", "")]),
    "a fault of a tick": m(f"int zero = 0; {B} {{ }} event tick() every 10ms {{ zero = 1 / zero; }} {CLOCK}",
        "b7 . . c0", "fault", "", "1 / zero", values={"zero": 0}),
    "a verdict of a request": m(f"{A} {{ }} {ASK} when (on) {{ }} ere: a q @match {{ }}", "a1 q1", "verdict",
        "/client", "ere:", [("a", ARM), ("q", "/client")], where={"on) {": {"on": True}}),
    "a verdict of a reply": m(f"{ASK} {{ }} {REPLY} {{ }} ere: q r @match {{ }}", "q1 r1", "verdict", "/server",
        "ere:", [("q", "/client"), ("r", "/server")]),
    "a request that is refused": m(f"{ASK} {{ if (on) {{ DROP; }} }}", "q1", "drop", "/client", "DROP;",
        where={"on) { D": {"on": True}}),
    "a request that a handler refuses": m(f"{A} {{ }} {ASK} {{ }} ere: a q @match {{ DROP; }}", "a1 q1", "drop",
        "/client", "DROP;", [("a", ARM), ("q", "/client")]),
    "a reply that is refused": m(f"{REPLY} {{ if (ok) {{ DROP; }} }}", "r1", "drop", "/server", "DROP;",
        where={"ok) { D": {"ok": True}}),
    "a request that is changed": m(f"{ASK} {{ if (on) {{ on = false; }} }}", "q1", "change", "/client", "on = false",
        where={"on) { o": {"on": True}}),
    "a reply that is changed": m(f"{REPLY} {{ if (ok) {{ ok = false; }} }}", "r1", "change", "/server", "ok = false",
        where={"ok) { o": {"ok": True}}),
    "a fault of a request": m(f"{ASK} {{ int zero = 0; zero = 1 / zero; }}", "q1", "fault", "/client", "1 / zero",
        values={"zero": 0}),
    "a verdict of a slice": row(f"{SLICED} ere: begin end @match {{ }} }}", "a1 a2 b2", "verdict", STICK, "ere:",
        PAIR),
    "a drop in a handler of a slice": row(f"{SLICED} ere: begin end @match {{ DROP; }} }}", "a1 a2 b2", "drop", STICK,
        "DROP;", PAIR),
    "a publication in a handler of a slice": row(f"{SLICED} ere: begin end @match {{ {ALARM} }} }}", "a1 a2 b2",
        "publish", STICK, "PUBLISH", PAIR),
}  # fmt: skip


@pytest.mark.parametrize("name", OUTCOMES)
def test_the_outcome_of_an_event(name: str) -> None:
    check(OUTCOMES[name], together=True)


@pytest.mark.parametrize("name", [name for name in OUTCOMES if name not in ("what is held",)])
def test_the_outcome_in_shadow_mode(name: str) -> None:
    check(OUTCOMES[name], together=False, shadow=True)
