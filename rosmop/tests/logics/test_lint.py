import re
from itertools import accumulate, product

import pytest

from rosmop.logics.past_monitors import ClockedPastProperty
from rosmop.logics.picture import to_dot
from rosmop.logics.property_lint import TIME, PropertyFact, analyse, shortest_trace_to
from rosmop.tests.logics.driving import compiled, play, seeded, told, traces
from rosmop.tests.logics.temporal import draw
from rosmop.tests.logics.test_mtl import ARITY, PRINTER, TEMPORAL, bounded


def test_violated_at_once_shows_a_trace() -> None:
    facts = analyse(compiled("ltl", "false"), ())
    assert facts == [
        PropertyFact(
            "violated at once",
            "violation",
            "the property is violated at the first event, whatever it is",
            ("a",),
        )
    ]


def test_shortest_traces_are_shortest() -> None:
    random = seeded(17)
    formulas = ["[](a => o (b U c))", "<>(a and o (b and o c))", "(a U b) or [] c", "[](a => o o !a)"]
    for formula in [*formulas, *(f"o {random.choice(formulas)}" for _ in range(4))]:
        monitor = compiled("ltl", formula)
        for category in monitor.categories:
            found = next(
                (trace for trace in traces("abc", 6) if told(monitor, trace)[-1] == (category,)), None
            )
            shown = shortest_trace_to(monitor, category)
            assert (shown is None) == (found is None)
            if shown is not None and found is not None:
                assert len(shown) == len(found)
                assert told(monitor, shown)[-1] == (category,)


def test_shortest_traces_of_bounded_past_formulas_lead_to_the_category() -> None:
    random, clocked, none = seeded(18), 0, 0
    while clocked < 200:
        tree = bounded(draw(random, 3, TEMPORAL, ARITY, ("a", "b")), random, 3)
        monitor = compiled("mtl", PRINTER.show(tree, random))
        if not isinstance(monitor, ClockedPastProperty):
            continue
        clocked += 1
        for category in monitor.categories:
            shown = shortest_trace_to(monitor, category)
            if shown is not None:
                run, now = monitor.start(0), 0
                said: tuple[str, ...] = ()
                for word in shown:
                    if word == TIME:
                        now += 10**9
                    else:
                        said = run.step(monitor.events.index(word), now)
                assert said == (category,), (monitor.formula, shown)
            none += shown is None
            for trace in traces("abc", 3) if shown is None else ():
                for times in product((0, 1, 5), repeat=len(trace)):
                    run = monitor.start(0)
                    told_of = [
                        run.step("abc".index(event), at)
                        for event, at in zip(trace, accumulate(times), strict=True)
                    ]
                    assert (category,) not in told_of, (monitor.formula, trace, times)
    assert none


SCOPES = ("globally:", "after a:", "until a:", "until b:", "after a until b:", "after b until a:")
BODIES = ("no a", "some a", "no b", "some b", "a causes b", "a requires b", "a forbids b", "b causes a")
CLAIMED = [
    *(
        ("pattern", f"{scope} {body}{within}")
        for scope in SCOPES
        for body in BODIES
        for within in ("", " within 2ns")
    ),
    *(
        ("ltl", one)
        for one in ("[] !a", "a", "false", "<> a", "o a", "a U b", "[] (a => o b)", "!a and !b", "[] a")
    ),
    *(("ptltl", one) for one in ("!a", "a", "(*) a", "[*] a", "b => <*> a", "!a and !b", "a and b", "<*> a")),
    *(
        ("mtl", one)
        for one in ("once[0,2ns] a", "!a", "historically[0,2ns] !a", "b => once[0,2ns] a", "previously a")
    ),
    *(("ere", one) for one in ("a b", "a*", "empty", "epsilon", "a+", "~(a b)")),
]


@pytest.mark.parametrize("events", [("a",), ("a", "b"), ("b", "a", "c")])
def test_facts_hold_for_every_trace(events: tuple[str, ...]) -> None:
    found = {"never runs": 0, "never violated": 0, "violated at once": 0}
    for logic, formula in CLAIMED:
        names = set(re.findall(r"\b[ab]\b", formula))
        if not names <= set(events):
            continue
        monitor = compiled(logic, formula, events)
        wider = compiled(logic, formula, (*events, "other"))
        facts = {(fact.kind, fact.category) for fact in analyse(monitor, monitor.categories)}
        for kind, _ in facts:
            found[kind] += 1
        reached, first = set[str](), list[bool]()
        for trace in traces(events, 4 if len(events) < 3 else 3):
            for delays in product((0, 1, 3), repeat=len(trace)):
                timed = [*zip(accumulate(delays), trace, strict=True)]
                record = play(monitor.start(0), events, timed, timed[-1][0] + 5)
                reached |= {category for _, categories in record for category in categories}
        failure = "fail" if logic == "ere" else "violation"
        for event, delay in product((*events, "other"), (0, 1, 3)):
            record = play(wider.start(0), wider.events, [(delay, event)])
            first.append(failure in record[-1][1])
        unreached = set(monitor.categories) - reached
        assert {category for kind, category in facts if kind == "never runs"} == unreached, (formula, facts)
        assert (("never violated", failure) in facts) == (failure in unreached and failure == "violation"), (
            formula
        )
        assert (("violated at once", failure) in facts) == all(first), (formula, first)
    assert all(found.values()) or events == ("a",)


def test_categories_after_an_event() -> None:
    machine = compiled("fsm", "s0 [ a -> s1, b -> s0 ] s1 [ a -> s1, b -> s0 ]", ("a", "b"))
    assert machine.categories_after(0) == {"s1", "fail"}
    assert machine.categories_after(1) == {"s0", "fail"}


def test_picture() -> None:
    picture = to_dot(compiled("fsm", "s0 [ a -> s1, b -> s1, c -> s0 ] s1 [ default s0 ] alias bad = s1"))
    assert picture is not None
    assert picture.startswith('digraph "fsm" {')
    assert '1 [label="s1\\nbad"];' in picture
    assert '0 -> 1 [label="a, b"];' in picture
    assert "fail" not in picture


@pytest.mark.parametrize(
    ("logic", "formula"),
    [
        ("tfsm", "s0 [ timeout 1s -> s1 ] s1 [ ]"),
        ("pattern", "after a: some b within 1s"),
        ("ltl", "a U b"),
        ("ere", "a b"),
    ],
)
def test_pictures_of_timed_and_untimed_properties(logic: str, formula: str) -> None:
    picture = to_dot(compiled(logic, formula))
    assert picture is not None
    assert picture.count("{") == picture.count("}") == 1
    assert picture.count('"') % 2 == 0


def test_no_picture_of_a_stack() -> None:
    assert to_dot(compiled("cfg", "S -> a S b | epsilon")) is None
