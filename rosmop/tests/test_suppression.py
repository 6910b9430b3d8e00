"""For formulas, a dropped message has not happened: their trace is that of subscribers."""

from collections.abc import Iterator, Sequence
from itertools import product
from random import Random
from typing import cast

import pytest

from rosmop.check.sources import compiled_from
from rosmop.logics.interface import CompiledProperty, FormulaError, FormulaRun, RunFaultError
from rosmop.run.engine import MonitorSet
from rosmop.tests.acting import definitions, load, message
from rosmop.tests.both_ways import BothWays, plain
from rosmop.tests.examples import examples, sample
from rosmop.tests.interpreted import beside, check_same
from rosmop.tests.logics.driving import ABC, compiled, seeded
from rosmop.tests.logics.temporal import Tree, draw
from rosmop.tests.logics.test_bounded import ARITY, FUTURE, PAST, PRINTER, worth
from rosmop.tests.logics.test_ltl import PRINTER as LTL_PRINTER
from rosmop.tests.logics.test_pattern import Meaning

SECOND = 10**9
Timed = list[tuple[int, str]]

FORMULAS = [
    "ptltl: a => <*> b",
    "ptltl: c => (!a S b)",
    "ltl: [](a => o !b)",
    "ltl: [](a => !(*) b)",
    "ltl: !a U b",
    "mtl: a => once[0,2ns] b",
    "mtl: a => (once[1ns,2ns] b or previously c)",
    "mtl: a => always[0,2ns] !b",
    "mtl: !(a and next[0,2ns] b)",
    "pattern: globally: a forbids b",
    "pattern: globally: a forbids b within 2ns",
    "pattern: after a until b: c requires a within 2ns",
    "pattern: until b: no a within 2ns",
]


def guard(formula: str, handler: str = "DROP;", name: str = "s", event: str = "") -> str:
    events = "".join(f"event {name} () /{name} std_msgs/Empty '{{}}' {{ {event} }}\n" for name in ABC)
    return f"{name}() {{ {events} {formula} @violation {{ {handler} }} }}"


def passed(monitors: MonitorSet, trace: Timed) -> list[bool]:
    return [monitors.process(f"/{event}", b"", time).result == "passed" for time, event in trace]


def violates(tree: Tree, before: Timed, event: tuple[int, str]) -> bool:
    """Whether, by definition, a violation becomes certain with an event after the messages that subscribers saw."""
    trace, now = (*before, event), event[0] - 1
    return any(
        worth(tree, [*trace], place, now) is False
        and (place == len(before) or worth(tree, before, place, now) is None)
        for place in range(len(trace))
    )


def told(property_: CompiledProperty, trace: Timed) -> tuple[str, ...]:
    run = property_.start(0)
    categories: tuple[str, ...] = ()
    for time, event in trace:
        while run.deadline is not None and run.deadline < time:
            run.expire()
        categories = run.step(property_.events.index(event), time)
    return categories


def projected(property_: CompiledProperty, trace: Timed) -> list[bool]:
    """Return whether each message passes, judged by a run that has seen only the earlier messages that passed."""
    seen: Timed = []
    found = []
    for event in trace:
        found.append("violation" not in told(property_, [*seen, event]))
        seen += [event] if found[-1] else []
    return found


def timed(random: Random, length: int, most: int = 2) -> Timed:
    time, trace = 1, []
    for _ in range(length):
        time += random.randint(0, most)
        trace.append((time, random.choice(ABC)))
    return trace


@pytest.mark.parametrize("handler", ["DROP;", "DROP; __RESET;", "__RESET; DROP;"])
def test_an_interlock_neither_sticks_nor_forgets(handler: str) -> None:
    """A halt forbids motion for 5 s, repeatedly: nothing else is dropped, and no drop makes the monitor forget."""
    monitors = load(guard("pattern: globally: a forbids b within 5s", handler))
    trace = [(0, "b"), (1, "a"), (2, "b"), (3, "b"), (4, "a"), (8, "b"), (10, "b"), (20, "a"), (21, "b")]
    assert passed(monitors, [(time * SECOND, event) for time, event in trace]) == [
        True, True, False, False, True, False, True, True, False,
    ]  # fmt: skip


@pytest.mark.parametrize("formula", FORMULAS)
def test_all_short_traces(formula: str) -> None:
    logic, _, text = formula.partition(": ")
    property_ = compiled(logic, text)
    cases = [(events, gap) for length in (3, 5) for events in product(ABC, repeat=length) for gap in (1, 2)]
    for events, gap in sample(cases, 5):
        trace = [(1 + gap * place, event) for place, event in enumerate(events)]
        assert passed(load(guard(formula)), trace) == projected(property_, trace), trace


def _bounded(random: Random, operators: Sequence[str]) -> tuple[Tree, str]:
    def bounds(tree: Tree) -> Tree:
        rest = [bounds(part) if isinstance(part, tuple) else part for part in tree[1:]]
        if tree[0] in (*PAST, *FUTURE):
            low = random.randint(0, 2)
            rest.append((low, low + random.randint(0, 3)))
        return (tree[0], *rest)

    tree = bounds(draw(random, random.randint(1, 3), operators, ARITY, ABC))
    return tree, PRINTER.show(tree, random)


@pytest.mark.parametrize("operators", [PAST, (*PAST, *FUTURE)], ids=["past", "future"])
def test_random_metric_formulas_by_definition(operators: Sequence[str]) -> None:
    random, dropped = seeded(26), 0
    for _ in range(examples(600)):
        tree, text = _bounded(random, operators)
        if compiled("mtl", text).blocking_refused("violation"):
            continue
        monitors, seen = load(guard(f"mtl: {text}")), list[tuple[int, str]]()
        for event in timed(random, 9):
            goes_on = not violates(tree, seen, event)
            assert passed(monitors, [event]) == [goes_on], (text, seen, event)
            seen += [event] if goes_on else []
            dropped += not goes_on
    assert dropped > examples(300)


def test_random_patterns_by_definition() -> None:
    random, dropped = seeded(27), 0
    for _ in range(examples(600)):
        kind, within = random.choice(("no", "requires", "forbids")), random.choice((None, 1, 3))
        opens, closes = random.choice((None, *ABC)), random.choice((None, *ABC))
        first, second = random.sample(ABC, 2)
        meaning = Meaning(kind, opens, closes, first, second, within)
        if meaning.opens is not None and meaning.opens == meaning.closes:
            continue
        if meaning.closes == meaning.second:
            continue
        monitors, seen = load(guard(f"pattern: {meaning.text()}")), list[tuple[int, str]]()
        for event in timed(random, 12):
            goes_on = not meaning.unmet((*seen, event), event[0])[0]
            assert passed(monitors, [event]) == [goes_on], (meaning.text(), seen, event)
            seen += [event] if goes_on else []
            dropped += not goes_on
    assert dropped > examples(300)


def test_random_linear_formulas() -> None:
    random, dropped = seeded(28), 0
    for _ in range(examples(300)):
        tree = draw(
            random,
            3,
            ("next", "until", "always", "eventually"),
            {"not": 1, "next": 1, "always": 1, "eventually": 1},
            ABC,
        )
        text = LTL_PRINTER.show(tree, random)
        try:
            property_ = compiled("ltl", text)
        except FormulaError:
            continue
        trace = timed(random, 10)
        expected = projected(property_, trace)
        assert passed(load(guard(f"ltl: {text}")), trace) == expected, (text, trace)
        dropped += expected.count(False)
    assert dropped > examples(100)


def test_a_run_goes_on_as_if_it_had_never_stepped() -> None:
    random = seeded(29)
    for _ in range(examples(400)):
        _, text = _bounded(random, (*PAST, *FUTURE))
        property_ = compiled("mtl", text)
        run, twin = (cast("FormulaRun", property_.start(0)) for _ in range(2))
        for time, event in timed(random, 14):
            for one in (run, twin):
                while one.deadline is not None and one.deadline < time:
                    one.expire()
            mark = run.mark()
            if random.random() < 0.4:
                for _ in range(random.randint(1, 3)):
                    run.step(random.randrange(3), time)
                run.take_back(mark)
            else:
                index = ABC.index(event)
                assert run.step(index, time) == twin.step(index, time), text
            assert run.deadline == twin.deadline, text


def _dropping(how: str) -> str:
    body = {"action": "return;", "fault": "int n = 0; n = 1 / n;", "handler": ""}[how]
    handler = "ere: a @match { DROP; } @fail { __RESET; }" if how == "handler" else ""
    return f"z() {{ event a() /b std_msgs/Empty '{{}}' {{ {body} }} {handler} }}"


@pytest.mark.parametrize("how", ["action", "fault", "handler"])
def test_whatever_drops_the_message_formulas_of_all_specifications_have_not_seen_it(how: str) -> None:
    machine = "fsm: idle [b -> moved] moved [default moved] @moved { moved = true; }"
    formula = "ptltl: !(<*> b) @violation { seen = true; }"
    events = "".join(f"event {name} () /{name} std_msgs/Empty '{{}}' {{ }}\n" for name in ABC)
    both = f"first() {{ bool moved = false; bool seen = false; {events} {machine} {formula} }}"
    monitors = load(both, z=_dropping(how))
    assert passed(monitors, [(1, "b")]) == [False]
    assert monitors.value("first", "moved")
    monitors.interpreter.variables[monitors.monitor("first").code.variables["seen"]] = False
    assert passed(monitors, [(2, "a")]) == [True]
    assert not monitors.value("first", "seen")


def test_a_reset_by_a_message_that_is_dropped_later_is_none() -> None:
    one = guard("ptltl: !(b and <*> a)", "__RESET;", name="one")
    monitors = load(
        one, z="z() { bool go = false; event b() /b std_msgs/Empty '{}' { if (!go) { return; } } }"
    )
    trace = [(1, "a"), (2, "b")]
    assert passed(monitors, trace) == [True, False]
    assert [verdict.category for verdict in monitors.process("/b", b"", 3).verdicts] == ["violation"]


def test_in_shadow_mode_the_trace_is_the_one_that_there_would_be() -> None:
    monitors = MonitorSet.of(
        compiled_from({"s.rv": guard("pattern: globally: a forbids b within 5s")}, definitions()),
        shadows=["s"],
    )
    monitors.start(0)
    results = []
    for time, event in [(1, "a"), (2, "b"), (3, "b"), (4, "c"), (9, "b")]:
        assert monitors.process(f"/{event}", b"", time * SECOND).result == "passed"
        results += [tapped.give().result for tapped in monitors.tapped]
        monitors.tapped.clear()
    assert results == ["passed", "dropped", "dropped", "passed", "passed"]


def test_a_dropped_request_has_not_happened() -> None:
    text = """s() { event on() service /set std_srvs/SetBool request '{data:true}' { }
        event off() service /set std_srvs/SetBool request '{data:false}' { }
        pattern: globally: on forbids on within 5s @violation { DROP; } }"""
    monitors = load(text)
    results = [
        monitors.process_service("/set", "request", bytes((on,)), time * SECOND).result
        for time, on in [(1, 1), (3, 1), (5, 0), (7, 1)]
    ]
    assert results == ["passed", "dropped", "passed", "passed"]


def test_explanations_name_no_event_that_was_dropped() -> None:
    for formula in (
        "pattern: globally: a forbids b within 5s",
        "ptltl: b => !(<*> a)",
        "mtl: b => !(once[1s,9s] a)",
    ):
        monitors = load(guard(formula))
        passed(monitors, [(SECOND, "a"), (2 * SECOND, "b"), (3 * SECOND, "b")])
        (verdict,) = monitors.process("/b", b"", 4 * SECOND).verdicts
        assert verdict.why is not None
        assert [event.time // SECOND for event in verdict.why.events] == [1, 4]


def _formulas(random: Random) -> Iterator[str]:
    for number in range(random.randint(1, 3)):
        formula = random.choice(
            [
                *FORMULAS,
                "fsm: idle [a -> moved, default idle] moved [b -> violation, default moved] violation [c -> idle]",
                "ptltl: !(a and b)",
            ]
        )
        body = random.choice(
            ("", "DROP;", "n++; DROP;", "if (n % 2 == 0) { DROP; } n++;", "__RESET;", "DROP; __RESET;")
        )
        yield f"{formula} @violation {{ {body} }}"
        if number == 1 and random.random() < 0.5:
            yield "ltl: [](c => o !c) @violation { n++; }"


def test_the_module_takes_back_what_the_interpreter_takes_back() -> None:
    random, came = seeded(30), 0
    for _ in range(examples(60)):
        texts = []
        for name in ("one", "two")[: random.randint(1, 2)]:
            cut = random.choice(("", "if (x > 8) { return; }"))
            change = random.choice(("", "y = y + 1; n = 3;"))
            events = [
                f"event a(int x) /plain own/Plain '{{kind:0, count:x}}' {{ {cut} }}",
                "event b(int x) /plain own/Plain '{count:x}' when (x % 3 == 0) { }",
                f"event c(double y) /plain own/Plain '{{kind:1, x:y}}' {{ {change} }}",
            ]
            random.shuffle(events)
            texts.append(f"{name}() {{ int n = 0; {' '.join(events)} {' '.join(_formulas(random))} }}")
        fed, time = BothWays(*texts), 1
        for _ in range(6):
            bodies = [plain(random.randint(0, 10), random.random(), random.randint(0, 2)) for _ in range(12)]
            time += random.randint(0, 3)
            fed.counting = random.random() < 0.7
            fed.check(bodies, "/plain", time)
        came += fed.came["together"] > 0 and fed.came["dropped"] > 0
    assert came > examples(20)


@pytest.mark.parametrize("creation", ["", "creation "])
def test_slices_take_back_theirs(creation: str) -> None:
    random, dropped = seeded(31), 0

    def text(formula: str, parameters: str) -> str:
        events = "".join(
            f"{creation if name == 'a' else ''}event {name}(int id) /{name} std_msgs/Int32 '{{data:id}}' {{ }}\n"
            for name in ABC
        )
        return f"s({parameters}) {{ {events} {formula} @violation {{ DROP; }} }}"

    for _ in range(examples(80)):
        formula = random.choice(
            [each for each in FORMULAS if "until b: no" not in each and "1ns" not in each]
        )  # from the trace's beginning on
        monitors = load(text(formula, "int id"))
        interpreter = beside(monitors)
        interpreter.start(0)
        alone: dict[int, MonitorSet] = {}
        for time, event in timed(random, 30):
            binding = random.randint(0, 2)
            data = message("std_msgs/Int32", data=binding)
            outcome = monitors.process(f"/{event}", data, time)
            check_same(outcome, interpreter.process(f"/{event}", data, time))
            expected = "passed"
            if binding in alone or not creation or event == "a":
                one = alone.get(binding) or load(text(formula, "").replace("creation ", ""))
                expected = one.process(f"/{event}", data, time).result
                if expected == "passed":
                    alone[binding] = one
            assert outcome.result == expected, (formula, time, event, binding)
            dropped += expected == "dropped"
    assert dropped > examples(50)


def test_a_fault_of_the_run_itself_drops_and_is_taken_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rosmop.logics.bounded.BoundedProperty.most", 2)
    monitors = load(guard("mtl: a => always[0,9s] !b"))
    assert passed(monitors, [(1, "a"), (2, "a"), (3, "a"), (4, "b")]) == [True, True, False, False]
    run = monitors.monitor("s").properties[0].run
    with pytest.raises(RunFaultError):
        run.step(0, 5)
