"""Deadlines for each binding equal those of one specification for each binding."""

# ruff: noqa: E501  the rows of tables

import functools
import gc
import itertools
import re
import sys
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from random import Random

import pytest

from rosmop.check.sources import compiled_from
from rosmop.form.compiled import Compiled
from rosmop.logics.catalogue import LOGICS
from rosmop.run.engine import MonitorSet
from rosmop.run.outcomes import MessageSender, Outcome
from rosmop.run.slices import Slice
from rosmop.tests.acting import definitions, message
from rosmop.tests.examples import examples
from rosmop.tests.test_slices import Made, body, made, slice_of, told

SECOND = 10**9
TIMED = {
    "pattern": ["globally: a causes b within 2s", "globally: some b within 2s", "after a until c: some b within 2s",
                "globally: a forbids b within 2s", "globally: b requires a within 2s", "until c: a causes b within 1s",
                "globally: no a within 3s", "globally: a causes a within 2s"],
    "tfsm": ["s0 [ a -> s1, default s0 ] s1 [ b -> s0, timeout 2s -> late ] late [ a -> s1, timeout 3s -> s0 ]",
             "s0 [ a -> s1, timeout 1s -> late ] s1 [ b -> s0, c -> s1 ] late [ default late ]",
             "s0 [ a -> s0, b -> late ] late [ default late ]"],
    "mtl": ["a => once[0,2s] b", "historically[0,2s] !c", "a => eventually[0,2s] b", "a => always[0,1s] !c",
            "a since[0,2s] b", "a until[0,2s] b", "c => next[0,1s] a"],
}  # fmt: skip
HANDLED = {
    "pattern": ("violation", "validation"),
    "tfsm": ("late", "timeout", "fail"),
    "mtl": ("violation", "validation"),
}


@functools.cache
def compiled(text: str) -> Compiled:
    return compiled_from({"x.rv": text}, definitions())


def running(text: str, start: int, deadlines: int = sys.maxsize) -> MonitorSet:
    monitors = MonitorSet.of(compiled(text), deadlines=deadlines)
    monitors.start(start)
    return monitors


Timed = Sequence[tuple[int, str, dict[str, object]]]
Entry = tuple[int, int, tuple[tuple[str, str], ...]]


def entries(outcomes: Iterable[Outcome], place: int) -> list[Entry]:
    found: list[Entry] = []
    for outcome in outcomes:
        found += entries(outcome.before, -1)
        said = tuple(told(outcome))
        if said:
            found.append((outcome.time, place if outcome.timer is None else -1, said))
    return found


def passed(monitors: MonitorSet, end: int) -> list[Outcome]:
    outcomes: list[Outcome] = []
    for _ in range(1000):
        outcomes += monitors.advance(end)
        if monitors.next_due is None or monitors.next_due > end:
            return outcomes
    raise AssertionError("deadlines without end")


def naive(one: Made, trace: Timed, end: int) -> list[Entry]:
    """Return the reports by definition: each binding's part of the trace is given to the plain specification.

    If there are only formulas, a dropped message does not begin a slice.
    """
    formulas = all(LOGICS[each.split(":")[0]].suppresses for each in one.properties)
    expected: list[Entry] = []
    values = [dict.fromkeys(values[name] for _, _, values in trace) for name in one.parameters]
    for choice in itertools.product(*values):
        binding = dict(zip(one.parameters, choice, strict=True))
        monitors: MonitorSet | None = None
        bound: set[str] = set()

        def tell(outcomes: Iterable[Outcome], place: int, bound: set[str] = bound) -> None:
            if len(bound) == len(one.parameters):
                expected.extend(entries(outcomes, place))

        for place, (time, event, given) in enumerate(trace):
            if any(given[name] != binding[name] for name in one.binds[event]):
                continue
            begins = monitors is None
            if monitors is None:
                if one.creation and event not in one.creation:
                    continue
                monitors = running(one.text(binding=False), time)
            tell(passed(monitors, time), -1)
            bound |= set(one.binds[event])
            outcome = monitors.process(f"/{event}", body(given), time)
            tell([outcome], place)
            if begins and outcome.result == "dropped" and formulas:
                monitors = None
        if monitors is not None:
            tell(passed(monitors, end), -1)
    return expected


def agree(one: Made, trace: Timed, deadlines: int = sys.maxsize) -> None:
    end = trace[-1][0] + 20 * SECOND
    monitors = running(one.text(binding=True), 0, deadlines)
    found: list[Entry] = []
    for place, (time, event, given) in enumerate(trace):
        found += entries([monitors.process(f"/{event}", body(given), time)], place)
    found += entries(passed(monitors, end), -1)
    assert sorted(joined(found)) == sorted(joined(naive(one, trace, end))), (one.text(binding=True), trace)


def joined(found: Iterable[Entry]) -> list[Entry]:
    whole: dict[int, Entry] = {}
    rest: list[Entry] = []
    for time, place, said in found:
        if place < 0:
            rest.append((time, place, said))
        else:
            before = whole.get(place, (time, place, ()))
            whole[place] = (time, place, tuple(sorted((*before[2], *said))))
    return [*rest, *whole.values()]


def a_timed_property(random: Random) -> str:
    logic = random.choice(list(TIMED))
    handled = random.sample(HANDLED[logic], 2)
    formula = random.choice(TIMED[logic])
    if "late" not in formula:
        handled = [one for one in handled if one != "late"] or [HANDLED[logic][1]]
    body = ['ROS_INFO("%d", n);', "n = n * 2;", 'ROS_INFO("%d", n); __RESET;', "__RESET;"]
    return "\n".join([f"{logic}: {formula}", *(f"@{one} {{ {random.choice(body)} }}" for one in handled)])


def timed(random: Random) -> Made:
    one = made(random)
    others = one.properties[:1] if random.random() < 0.4 else ()
    return replace(one, properties=(a_timed_property(random), *others))


def trace_of(random: Random, length: int) -> Timed:
    few, time, found = random.randint(1, 3), SECOND, []
    for _ in range(length):
        time += random.choice((0, 0, SECOND, SECOND, SECOND // 2, 2 * SECOND, 3 * SECOND + 1))
        values: dict[str, object] = {
            "p": random.choice("uvw"[:few]), "q": random.randrange(few), "r": random.randrange(few)
        }  # fmt: skip
        found.append((time, random.choice("abc"), values))
    return found


@pytest.mark.parametrize("part", range(4))
@pytest.mark.parametrize("deadlines", [1, 1_000_000])
def test_each_binding_has_a_time_of_its_own(part: int, deadlines: int) -> None:
    for seed in range(part, 4 * examples(60), 4):
        random = Random(seed)  # noqa: S311  draws examples, not keys
        agree(timed(random), trace_of(random, 14), deadlines=deadlines)


@pytest.mark.parametrize("formula", [*TIMED["pattern"][:3], *TIMED["tfsm"], *TIMED["mtl"][:4]])
def test_all_short_traces_of_two_bindings(formula: str) -> None:
    logic = next(name for name, formulas in TIMED.items() if formula in formulas)
    handlers = " ".join(
        f'@{one} {{ ROS_INFO("%d", n); }}' for one in HANDLED[logic] if one != "late" or "late" in formula
    )
    one = Made(
        "p", dict.fromkeys("abc", "p"), "", (f"{logic}: {formula} {handlers}",), dict.fromkeys("abc", "")
    )
    gaps = (0, 2 * SECOND, 2 * SECOND + 1)
    moves = [*itertools.product("ab", "uv", gaps)]
    for steps in itertools.product(moves, repeat=2 if examples(60) < 60 else 3):
        time, trace = SECOND, []
        for event, value, gap in steps:
            time += gap
            trace.append((time, event, {"p": value, "q": 0, "r": 0}))
        agree(one, trace)


STOP = """goals(std::string id) {
    static std_msgs::Empty stop;
    creation event goal(std::string id) /goal std_msgs/String '{data:id}' { }
    event result(std::string id) /result std_msgs/String '{data:id}' { }
    pattern: globally: goal causes result within 30s
    @violation { PUBLISH(/stop, std_msgs/Empty, stop); __RESET; }
}"""


def text(value: str) -> bytes:
    return message("std_msgs/String", data=value)


def test_a_goal_without_a_result_publishes_the_stop_once_at_its_deadline() -> None:
    monitors = running(STOP, 0)
    for number in range(5):
        monitors.process("/goal", text(str(number)), number * SECOND)
    for number in range(4):
        monitors.process("/result", text(str(number)), (10 + number) * SECOND)
    slices = monitors.monitors[0].slices
    assert slices is not None
    assert slices.live == 1
    assert monitors.advance(34 * SECOND) == []
    assert monitors.next_due == 34 * SECOND + 1
    (outcome,) = monitors.advance(34 * SECOND + 1)
    assert (outcome.time, outcome.timer) == (34 * SECOND, "goals.deadline")
    assert [one.topic for one in outcome.published] == ["/stop"]
    (verdict,) = outcome.verdicts
    assert verdict.binding == {"id": "4"}
    assert verdict.why is not None
    assert [event.time for event in verdict.why.events] == [4 * SECOND]
    assert slices.live == 0
    assert slices.deadline is None


def test_deadlines_beyond_the_limit_wait_but_precede_messages_of_their_slice() -> None:
    monitors = running(STOP, 0, deadlines=10)
    for number in range(40):
        monitors.process("/goal", text(str(number)), SECOND)
    outcome = monitors.process("/result", text("39"), 60 * SECOND)
    assert [len(each.published) for each in outcome.before] == [1] * 11
    assert outcome.before[-1].verdicts[0].binding == {"id": "39"}
    assert len(monitors.advance(60 * SECOND)) == 10
    assert monitors.next_due is not None
    assert monitors.next_due < 60 * SECOND
    assert len(passed(monitors, 60 * SECOND)) == 19


def slices_in_memory() -> int:
    gc.collect()
    return sum(isinstance(thing, Slice) for thing in gc.get_objects())


def test_finished_slices_leave_no_deadlines() -> None:
    monitors = running(STOP, 0)
    slices = monitors.monitors[0].slices
    assert slices is not None
    before = slices_in_memory()
    for number in range(2000):
        monitors.process("/goal", text(str(number)), SECOND)
        monitors.process("/result", text(str(number)), SECOND)
    assert slices.live == 0
    assert slices_in_memory() - before < 100


def test_a_slice_lives_while_its_timer_may_act() -> None:
    watched = """goals(std::string id) {
        static std_msgs::Empty stop; bool waits = false; ros::Time since;
        creation event goal(std::string id) /goal std_msgs/String '{data:id}' { waits = true; since = ros::Time::now(); }
        event result(std::string id) /result std_msgs/String '{data:id}' { waits = false; }
        event look() every 1s {
            if (waits && ros::Time::now() - since > ros::Duration(60.0)) { waits = false; PUBLISH(/stop, std_msgs/Empty, stop); }
        }
        fsm: begun [ goal -> sent, default begun ] sent [ result -> done, default sent ] done [ goal -> twice, default done ]
             twice [ default twice ]
        @fail { ROS_WARN("never"); }
    }"""
    monitors = running(watched, 0)
    for number in range(5):
        monitors.process("/goal", text(str(number)), SECOND)
    for number in range(4):
        monitors.process("/result", text(str(number)), 2 * SECOND)
    stops = [one for outcome in monitors.advance(70 * SECOND) for one in outcome.published]
    assert [stop.topic for stop in stops] == ["/stop"]


def test_deadlines_name_the_events_of_their_own_slice() -> None:
    explained = 0
    for seed in range(examples(120)):
        random = Random(seed)  # noqa: S311  draws examples, not keys
        one = replace(timed(random), actions=dict.fromkeys("abc", ""))
        one = replace(one, properties=tuple(each.replace("__RESET;", "") for each in one.properties))
        trace = trace_of(random, 12)
        monitors = running(one.text(binding=True), 0)
        outcomes = [monitors.process(f"/{event}", body(given), time, MessageSender(place + 1))
                    for place, (time, event, given) in enumerate(trace)]  # fmt: skip
        outcomes += passed(monitors, trace[-1][0] + 20 * SECOND)
        for outcome in [each for whole in outcomes for each in (*whole.before, whole)]:
            for verdict in outcome.verdicts:
                if verdict.why is None or outcome.timer is None:
                    continue
                places = {event.sender.source - 1 for event in verdict.why.events}
                assert places <= {*slice_of(one, [step[1:] for step in trace], verdict.binding)}
                explained += 1
    assert explained > examples(120) // 4


def test_the_example_of_the_tutorial_works() -> None:
    page = (Path(__file__).parents[2] / "docs/monitors-tutorial.md").read_text()
    (written,) = re.findall(r"```cpp\n(watchdog\(.*?\n)```", page, re.DOTALL)
    monitors = running(written, 0)
    for number in range(5):
        monitors.process(
            "/count/goal", message("actionlib/TestActionGoal", goal_id__id=str(number)), number * SECOND
        )
    for number in range(4):
        answer = message("actionlib/TestActionResult", status__goal_id__id=str(number))
        monitors.process("/count/result", answer, (10 + number) * SECOND)
    outcomes = monitors.advance(100 * SECOND)
    stops = [(outcome.time // SECOND, one.topic) for outcome in outcomes for one in outcome.published]
    assert stops == [(34, "/stop")]


DROPPING = ["pattern: globally: a forbids b within 2s", "pattern: globally: b requires a within 2s", "mtl: historically[0,2s] !c",
            "pattern: globally: no a within 3s", "mtl: a since[0,2s] b", "ltl: [](a => o b)", "ere: (a b)* c",
            "tfsm: s0 [ a -> s1, timeout 1s -> late ] s1 [ b -> s0, c -> s1 ] late [ a -> s0, default late ]"]  # fmt: skip
WAITING = ["pattern: globally: a causes b within 2s @violation { %s }", "mtl: a => eventually[0,2s] b @violation { %s }",
           "tfsm: s0 [ b -> s0, default s1 ] s1 [ a -> s1, default s0, timeout 2s -> s0 ] @timeout { %s }"]  # fmt: skip


def test_a_drop_is_undone_in_its_slice() -> None:
    for seed in range(examples(400)):
        random = Random(seed)  # noqa: S311  draws examples, not keys
        formula = random.choice(DROPPING)
        category = {"ere": "fail", "tfsm": "s1"}.get(formula.split(":")[0], "violation")
        drop = random.choice(("DROP;", "if (n % 2 == 0) { DROP; }", 'ROS_INFO("%d", n); DROP;'))
        waits = random.choice(WAITING) % random.choice(
            ("__RESET;", 'ROS_INFO("late %d", n);', "n = 0; __RESET;")
        )
        actions = {
            event: random.choice(("", "n = n + 1;", "if (n > 2) { n = 0; return; } n = n + 1;"))
            for event in "abc"
        }
        properties = [f"{formula} @{category} {{ {drop} }}", waits]
        random.shuffle(properties)
        one = Made("p", dict.fromkeys("abc", "p"), random.choice(("", "a")), tuple(properties), actions)
        agree(one, trace_of(random, 16), random.choice((1, sys.maxsize)))


def test_a_remedy_is_published_for_each_binding() -> None:
    enforced = STOP.replace(
        "within 30s\n    @violation { PUBLISH(/stop, std_msgs/Empty, stop); __RESET; }",
        "within 30s enforced by halt",
    )
    enforced = enforced.replace(
        "static std_msgs::Empty stop;",
        "static std_msgs::String stop; void halt() { stop.data = id; PUBLISH(/result, std_msgs/String, stop); }",
    )
    monitors = running(enforced, 0)
    for number in range(3):
        monitors.process("/goal", text(str(number)), number * SECOND)
    monitors.process("/result", text("1"), 5 * SECOND)
    outcomes = passed(monitors, 100 * SECOND)
    assert [(outcome.time // SECOND, len(outcome.published)) for outcome in outcomes] == [(30, 1), (32, 1)]
    assert monitors.monitors[0].slices is not None
    assert monitors.monitors[0].slices.live == 0
