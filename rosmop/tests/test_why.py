"""The explanation of a verdict is sufficient: in a new run, the named events alone give the verdict.

Tested for each logic over random formulas and traces. No named event can be left out (`fewest`).
"""

import contextlib
import copy
from collections.abc import Iterator, Sequence
from random import Random

import pytest

from rosmop.check.sources import compiled_from
from rosmop.logics import mtl, ptcaret, ptltl
from rosmop.logics.formula import read_formula
from rosmop.logics.interface import ClockedProperty, CompiledProperty, FormulaError, Run
from rosmop.run import explain
from rosmop.run.engine import MonitorSet
from rosmop.run.explain import ClockedSteps, Steps, history_of
from rosmop.run.outcomes import NOBODY, SEQ, EventOccurrence, Explanation, Meaning, MessageSender, decided_by
from rosmop.tests.acting import definitions, message
from rosmop.tests.logics.driving import compiled, seeded
from rosmop.tests.logics.temporal import ARITY, BOOLEAN, Printer, draw

EVENTS = ("a", "b", "c")
CALLS = ("begin", "end", "a")
MILLISECOND = 10**6

_PAST = ("previously", "once", "historically", "since")
_UNARY = {**ARITY, "previously": 1, "once": 1, "historically": 1}
_BINARY = (*BOOLEAN, "since")
_PTLTL = Printer(
    {"previously": ("(*)",), "once": ("<*>",), "historically": ("[*]",), "since": ("S",)}, [_BINARY], _BINARY
)


def machine(random: Random, *, timed: bool) -> str:
    text = ""
    for state in range(4):
        moves = [f"{event} -> s{random.randrange(4)}" for event in EVENTS if random.random() < 0.8]
        if timed and random.random() < 0.5:
            moves.append(f"timeout {random.randrange(1, 5)}ms -> s{random.randrange(4)}")
        moves.append(f"default s{random.randrange(4)}")
        text += f"s{state} [ {', '.join(moves)} ] "
    return text


def expression(random: Random, depth: int) -> str:
    if depth == 0:
        return random.choice(EVENTS)
    one, other = expression(random, depth - 1), expression(random, depth - 1)
    return random.choice([f"({one} {other})", f"({one} | {other})", f"({one})*", f"~({one})", one])


def past(random: Random) -> str:
    return _PTLTL.show(draw(random, 4, _PAST, _UNARY, EVENTS), random)


def caret(random: Random) -> str:
    inner = _PTLTL.show(draw(random, 2, _PAST, _UNARY, CALLS), random)
    other = _PTLTL.show(draw(random, 2, _PAST, _UNARY, CALLS), random)
    return random.choice(
        [f"(*a) ({inner})", f"<*a> ({inner})", f"[*a] ({inner})", f"@b ({inner})", f"<*s@b> ({inner})",
         f"({inner}) Sa ({other})", f"({other}) -> <*a> ({inner})"]
    )  # fmt: skip


def metric(random: Random) -> str:
    def part(depth: int) -> str:
        if depth == 0:
            return random.choice(EVENTS)
        low = random.choice([0, 0, 1, 2])
        bounds = random.choice(["", f"[{low}ms,{low + random.randrange(4)}ms]", f"[{low}ms,inf]"])
        one, other = part(depth - 1), part(depth - 1)
        return random.choice(
            [f"once{bounds} ({one})", f"historically{bounds} ({one})", f"({one}) since{bounds} ({other})",
             f"previously{bounds} ({one})", f"!({one})", f"({one}) and ({other})", f"({one}) -> ({other})"]
        )  # fmt: skip

    return part(3)


def ahead(random: Random) -> str:
    one, other = random.sample(EVENTS, 2)
    bounds = f"[{random.choice([0, 1])}ms,{random.randrange(2, 6)}ms]"
    return random.choice([
        f"{one} => eventually{bounds} {other}", f"{one} => always{bounds} !{other}", f"!{one} or next{bounds} {other}",
        f"{one} => (!{other} until{bounds} {one})", f"eventually{bounds} ({one} and next{bounds} {other})",
    ])  # fmt: skip


def pattern(random: Random) -> str:
    scope = random.choice(["globally", "after a", "until b", "after a until b"])
    body = random.choice(["no c", "some c", "c causes b", "c requires a", "c forbids c", "a causes c"])
    return f"{scope}: {body}{random.choice(['', ' within 3ms'])}"


def grammar(random: Random) -> str:
    return random.choice([
        "S -> a S b | epsilon", "S -> a S b S | c", "S -> S S | a b | c", "S -> a S a | b S b | c",
        "S -> A B, A -> a A | epsilon, B -> b B c | epsilon",
    ])  # fmt: skip


def rewriting(random: Random) -> str:
    return random.choice([
        "a b -> #epsilon . ^ b -> #fail .", "a a -> b . b b -> #fail . c -> #epsilon .",
        "a c -> #epsilon . ^ c -> #fail . b b b -> #succeed .", "^ a $ -> a a . a a a a -> #fail . c -> #succeed .",
    ])  # fmt: skip


def future(random: Random) -> str:
    return random.choice([
        "[] (a => o b)", "[] !(a and b) and <> c", "!b U a", "[](a => <> b)", "<> c", "[] (c => !a U b)",
    ])  # fmt: skip


MAKERS = {
    "fsm": lambda random: machine(random, timed=False),
    "tfsm": lambda random: machine(random, timed=True),
    "ere": lambda random: expression(random, 4),
    "ltl": future,
    "ptltl": past,
    "mtl": metric,
    "mtl future": ahead,
    "pattern": pattern,
    "cfg": grammar,
    "srs": rewriting,
    "ptcaret": caret,
}


def gives(
    made: CompiledProperty,
    before: Run | None,
    explanation: Sequence[EventOccurrence],
    target: EventOccurrence,
    category: str,
) -> bool:
    run = made.start(0) if before is None else copy.copy(before)
    told: tuple[str, ...] = ()
    for one in explanation:
        while (deadline := run.deadline) is not None and deadline < one.time:
            run.expire()
        told = run.step(one.event, one.time)
    if target.event >= 0:
        return category in told
    at_once: list[str] = []
    while (deadline := run.deadline) is not None and deadline <= target.time:
        categories = run.expire()
        at_once += categories if deadline == target.time else ()
    return category in at_once


def explained(
    made: CompiledProperty, random: Random, length: int
) -> list[tuple[Explanation | None, EventOccurrence, str, Run | None]]:
    run, history, now = made.start(0), history_of(made, 0), 0
    found = []
    copies: dict[int, Run] = {}

    def note(event: int, time: int, number: int, categories: Sequence[str]) -> None:
        happened = EventOccurrence(event, time, MessageSender(7, number, SEQ) if event >= 0 else NOBODY)
        for category in dict.fromkeys(categories):
            explanation = history.explain(category)
            since = explanation.since if explanation is not None else None
            found.append((explanation, happened, category, copies.get(since) if since is not None else None))

    for number in range(length):
        now += random.randrange(1, 3) * MILLISECOND
        while (deadline := run.deadline) is not None and deadline < now:
            copies.setdefault(deadline, copy.copy(run))
            note(-1, deadline, 0, history.expire(run))
        if isinstance(history, Steps):
            copies[now] = copy.copy(run)
        event = random.randrange(len(made.events))
        note(event, now, number, history.step(run, event, now, MessageSender(7, number, SEQ)))
    return found


@pytest.mark.parametrize("logic", ["tfsm", "pattern"])
def test_clocked_steps_explain_the_same_as_steps(logic: str) -> None:
    random, compared = seeded(43), 0
    for _ in range(12):
        made = compiled(logic, MAKERS[logic](random), EVENTS)
        if not isinstance(made, ClockedProperty):
            continue
        ways = [(made.start(0), kept(made, 0)) for kept in (Steps, ClockedSteps)]
        now = 0
        for number in range(400):
            now += random.randrange(1, 3) * MILLISECOND
            event, told = random.randrange(len(made.events)), []
            for run, history in ways:
                said = []
                while (deadline := run.deadline) is not None and deadline < now:
                    said += [history.explain(one) for one in history.expire(run)]
                categories = history.step(run, event, now, MessageSender(7, number, SEQ))
                if number % 7 == 0:
                    said += [history.explain(category) for category in categories]
                told.append(said)
            assert told[0] == told[1]
            compared += len(told[0])
    assert compared > 50


def properties(logic: str, random: Random) -> Iterator[CompiledProperty]:
    name, events = logic.split(maxsplit=1)[0], CALLS if logic == "ptcaret" else EVENTS
    for _ in range(40):
        with contextlib.suppress(FormulaError):
            yield compiled(name, MAKERS[logic](random), events)


@pytest.mark.parametrize("logic", MAKERS)
def test_the_named_events_alone_give_the_verdict(logic: str) -> None:
    random = seeded(41)
    count = cut = 0
    for made in properties(logic, random):
        for explanation, target, category, before in explained(made, random, 30):
            assert explanation is not None
            assert explanation.since is None
            assert explanation.fewest
            assert gives(made, before, explanation.events, target, category)
            numbers = [event.sender.number for event in explanation.events]
            assert numbers == sorted(set(numbers))
            for place in range(len(numbers)):
                fewer = [*explanation.events[:place], *explanation.events[place + 1 :]]
                assert not gives(made, before, fewer, target, category)
            count += 1
            cut += explanation.since is not None
    assert count > 100


@pytest.mark.parametrize("logic", MAKERS)
def test_a_shortened_explanation_says_so(logic: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(explain, "KEPT", 2)
    random = seeded(42)
    whole = cut = 0
    for made in properties(logic, random):
        for explanation, target, category, before in explained(made, random, 30):
            assert explanation is not None
            assert (before is None) is (explanation.since is None)
            assert gives(made, before, explanation.events, target, category)
            whole += explanation.since is None
            cut += explanation.since is not None
    assert whole > 20
    if logic in ("fsm", "ere", "ltl"):
        assert not cut
    elif logic in ("tfsm", "mtl", "cfg", "srs", "ptcaret"):
        assert cut > 5


def test_a_long_path_is_explained_in_full() -> None:
    states = 400
    text = " ".join(f"s{number} [ a -> s{number + 1}, b -> s{number} ]" for number in range(states))
    made = compiled("fsm", f"{text} s{states} [ ]")
    run, history = made.start(0), history_of(made, 0)
    for number in range(states):
        for event in (1, 1, 0):
            history.step(run, event, number + 1, NOBODY)
    explanation = history.explain(f"s{states}")
    assert explanation is not None
    assert not explanation.fewest
    assert [one.event for one in explanation.events] == [0] * states
    assert explanation.events[-1].state == f"s{states}"


def test_the_latest_of_equal_explanations() -> None:
    made = compiled("ere", "(a b)* c")
    run, history = made.start(0), history_of(made, 0)
    for number, event in enumerate((0, 1, 0, 1, 2)):
        history.step(run, event, number + 1, MessageSender(1, number, SEQ))
    explanation = history.explain("match")
    assert explanation is not None
    assert [one.sender.number for one in explanation.events] == [4]


def test_a_verdict_of_now_is_not_explained_by_one_of_before() -> None:
    """The last event is named unless the other events suffice without it."""
    made = compiled("ptltl", "!c and (a -> <*> b)")
    run, history = made.start(0), history_of(made, 0)
    for number, event in enumerate((2, 0)):
        history.step(run, event, number + 1, MessageSender(1, number, SEQ))
    explanation = history.explain("violation")
    assert explanation is not None
    assert [one.event for one in explanation.events] == [0]


@pytest.mark.parametrize("logic", ["ptltl", "mtl", "ptcaret"])
def test_sub_formulas_have_the_meaning_of_the_monitors(logic: str) -> None:
    random = seeded(43)
    syntax = {"ptltl": ptltl.SYNTAX, "mtl": mtl.SYNTAX, "ptcaret": ptcaret.SYNTAX}[logic]
    events = CALLS if logic == "ptcaret" else EVENTS
    for _ in range(150):
        made = compiled(logic, MAKERS[logic](random), events)
        formula = read_formula(made.source, syntax)
        run, times, trace, now = made.start(0), [], [], 0
        for _ in range(12):
            now += random.randrange(0, 3) * MILLISECOND
            trace.append(random.randrange(3))
            times.append(now)
            holds = run.step(trace[-1], now) == ("validation",)
            meaning = Meaning([events[event] for event in trace], times)
            assert meaning.holds(formula, len(trace) - 1) is holds


def test_sub_formulas_that_decide_a_formula() -> None:
    made = compiled("mtl", "a -> once[0,500ms] b and !c")
    run, history = made.start(0), history_of(made, 0)
    for event, time in ((1, 1), (0, 700 * MILLISECOND)):
        history.step(run, event, time, NOBODY)
    explanation = history.explain("violation")
    assert explanation is not None
    assert [one.event for one in explanation.events] == [0]
    assert decided_by(made.source, explanation) == ["a is true", "once[0ns,500ms] b is false"]


def test_an_old_event_is_explained_by_its_effect() -> None:
    made = compiled("mtl", "a -> !(once[0,10s] b)")
    run, history = made.start(0), history_of(made, 0)
    for number, event in enumerate((1, *[0] * 4 * explain.KEPT)):
        history.step(run, event, number, NOBODY)
    explanation = history.explain("violation")
    assert explanation is not None
    assert [one.event for one in explanation.events] == [0]
    assert explanation.since is not None
    assert explanation.since > 2 * explain.KEPT
    assert decided_by(made.source, explanation) == []


@pytest.mark.parametrize("between", [10, 1500])
@pytest.mark.parametrize(
    ("formula", "last", "because"),
    [("a => eventually[0,1s] b", 2, [0]), ("a => always[0,1s] !b", 1, [0, 1])],
    ids=["by a deadline", "by an event"],
)
def test_a_long_trace_of_the_future(formula: str, last: int, because: list[int], between: int) -> None:
    made = compiled("mtl", formula)
    run, history, now = made.start(0), history_of(made, 0), 0
    for event in [1, *[2] * 30, 0, *[2] * between, last]:
        now += MILLISECOND // 10
        told = history.step(run, event, now, NOBODY)
    while run.deadline is not None:
        told = history.expire(run)
    assert "violation" in told
    explanation = history.explain("violation")
    assert explanation is not None
    assert ([one.event for one in explanation.events], explanation.fewest) == (because, True)


def test_a_verdict_of_a_slice_is_explained_by_its_own_events() -> None:
    text = """goals(int id) {
        event start(int id) /start std_msgs/Int32 '{data:id}' { }
        event end(int id) /end std_msgs/Int32 '{data:id}' { }
        ere: (start end)*
        @fail { ROS_WARN("twice"); }
    }"""
    monitors = MonitorSet.of(compiled_from({"goals.rv": text}, definitions()))
    monitors.start(0)
    outcome = None
    for number, (topic, value) in enumerate((("/start", 1), ("/start", 2), ("/end", 2), ("/start", 1))):
        data = message("std_msgs/Int32", data=value)
        outcome = monitors.process(topic, data, number, MessageSender(number + 1))
    assert outcome is not None
    [verdict] = outcome.verdicts
    assert verdict.binding == {"id": 1}
    assert verdict.why is not None
    assert [event.sender.source for event in verdict.why.events] == [1, 4]


def test_compared_values_and_the_statement_that_dropped() -> None:
    text = """gun() {
        int count = 0;
        event fire(int x) /fire std_msgs/Int32 '{data:x}' when (x > 3 && count < 5) {
            if (x == 7) {
                count = 9; x = 1;
                DROP;
            }
            count = count + 1;
        }
    }"""
    monitors = MonitorSet.of(compiled_from({"gun.rv": text}, definitions()))
    monitors.start(0)
    passed = monitors.process("/fire", message("std_msgs/Int32", data=5), 1)
    assert passed.conditions == {"gun.rv:3:65": {"x": 5, "count": 0}}
    assert passed.dropped_at is None
    dropped = monitors.process("/fire", message("std_msgs/Int32", data=7), 2)
    assert str(dropped.dropped_at) == "gun.rv:6:17"
    assert dropped.conditions == {"gun.rv:3:65": {"x": 7, "count": 1}, "gun.rv:4:17": {"x": 7}}
