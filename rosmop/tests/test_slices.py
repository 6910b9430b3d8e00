"""Parametric specifications equal one specification for each binding, within limits, in module and interpreter."""

# ruff: noqa: E501  the rows of tables

import gc
import itertools
import tracemalloc
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from random import Random

import pytest

from rosmop.certify.properties import certificates_of
from rosmop.check.sources import compiled_from
from rosmop.check.specification import compile_files
from rosmop.run.engine import MonitorSet
from rosmop.run.execution import EXPLAINED
from rosmop.run.outcomes import MessageSender, Outcome
from rosmop.run.slices import GROWING_LIMIT, MAX_BINDING
from rosmop.tests.acting import definitions, load, message
from rosmop.tests.examples import examples
from rosmop.tests.interpreted import beside, check_same
from rosmop.tests.logics.driving import seeded
from rosmop.tests.on_module import on_module
from rosmop.tests.reload import replaced
from rosmop.text.parser import parse

FIELDS = {"p": ("std::string", "frame_id"), "q": ("uint32_t", "seq"), "r": ("ros::Time", "stamp")}
FORMULAS = {
    "ere": ["a b", "a* b c", "(a | b) c", "~(a b c)", "a b | b a", "epsilon", "(a b)* c", "a+ b+"],
    "fsm": [
        "s0 [ a -> s1, default s0 ] s1 [ b -> bad, c -> s0 ] bad [ default bad ] alias match = bad",
        "s0 [ a -> s1 ] s1 [ b -> s0 ] alias match = s0",
        "s0 [ a -> match ] match [ b -> match ]",
    ],
    "ltl": ["[](a => o b)", "<> c", "a U b", "!(a) U c"],
    "ptltl": ["a => <*> b", "[*](b => (*) a)"],
    "cfg": ["S -> a S b | epsilon", "S -> a S b S | c"],
    "srs": ["a b -> #epsilon. b c -> #fail. a c -> #succeed."],
    "pattern": ["globally: b requires a", "globally: no c"],
}
TWO = {"ere": ("match", "fail"), "fsm": ("match", "fail"), "cfg": ("match", "fail"), "srs": ("fail", "succeed"),
       "ltl": ("violation", "validation"), "ptltl": ("violation", "validation"), "pattern": ("violation", "validation")}  # fmt: skip


@dataclass(frozen=True)
class Made:
    parameters: str
    binds: dict[str, str]
    creation: str
    properties: tuple[str, ...]
    actions: dict[str, str]

    def text(self, binding: bool) -> str:
        head = ", ".join(f"{FIELDS[parameter][0]} {parameter}" for parameter in self.parameters)
        lines = [f"s({head if binding else ''}) {{ int n = 0;"]
        for event, bound in self.binds.items():
            own = ", ".join(f"{FIELDS[one][0]} {one}" for one in bound)
            fields = ", ".join(f"{FIELDS[one][1]}:{one}" for one in bound)
            word = "creation " if binding and event in self.creation else ""
            lines.append(
                f"{word}event {event}({own}) /{event} std_msgs/Header '{{{fields}}}' {{ {self.actions[event]} }}"
            )
        return "\n".join([*lines, *self.properties, "}"])


def a_property(random: Random) -> str:
    logic = random.choice(list(FORMULAS))
    body = ['ROS_INFO("%d", n);', "n = n * 2;", 'ROS_INFO("%d", n); __RESET;', ""]
    handlers = [
        f"@{one} {{ {random.choice(body)} }}" for one in random.sample(TWO[logic], random.randint(1, 2))
    ]
    return "\n".join([f"{logic}: {random.choice(FORMULAS[logic])}", *handlers])


def made(random: Random) -> Made:
    parameters = random.choice(["p", "p", "q", "pq", "pq", "rp", "pqr"])
    while True:
        binds = {event: "".join(one for one in parameters if random.random() < 0.7) for event in "abc"}
        if set("".join(binds.values())) == set(parameters):
            break
    actions = ["", "", "n = n + 1;", "if (n % 3 == 2) n = 7; else n = n + 1;", 'ROS_WARN("%d", n);']
    return Made(
        parameters,
        binds,
        random.choice(["", "", "a", "ab", "b"]),
        tuple(a_property(random) for _ in range(random.choice((1, 1, 2)))),
        {event: random.choice(actions) for event in "abc"},
    )


Trace = Sequence[tuple[str, dict[str, object]]]


def trace(random: Random, length: int) -> Trace:
    few = random.randint(1, 3)
    return [
        (
            random.choice("abc"),
            {"p": random.choice("uvw"[:few]), "q": random.randrange(few), "r": random.randrange(few)},
        )
        for _ in range(length)
    ]


def body(values: dict[str, object]) -> bytes:
    return message("std_msgs/Header", frame_id=values["p"], seq=values["q"], stamp__sec=values["r"])


Told = list[tuple[str, str]]


def told(outcome: Outcome) -> Told:
    assert not outcome.faults, outcome.faults
    return sorted(
        [("verdict", verdict.category) for verdict in outcome.verdicts]
        + [("log", line.text) for line in outcome.log]
    )


def naive(one: Made, trace: Trace) -> list[Told]:
    expected: list[Told] = [[] for _ in trace]
    values = [dict.fromkeys(values[name] for _, values in trace) for name in one.parameters]
    for choice in itertools.product(*values):
        binding = dict(zip(one.parameters, choice, strict=True))
        monitors: MonitorSet | None = None
        bound: set[str] = set()
        for place, (event, given) in enumerate(trace):
            if any(given[name] != binding[name] for name in one.binds[event]):
                continue
            if monitors is None:
                if one.creation and event not in one.creation:
                    continue
                monitors = load(one.text(binding=False))
            bound |= set(one.binds[event])
            outcome = monitors.process(f"/{event}", body(given), place)
            if len(bound) == len(one.parameters):
                expected[place] = sorted(expected[place] + told(outcome))
    return expected


@pytest.mark.parametrize("seed", range(60))
def test_slices_equal_one_specification_for_each_binding(seed: int) -> None:
    random = Random(seed)  # noqa: S311  draws examples, not keys
    one = made(random)
    monitors = load(one.text(binding=True))
    interpreter = beside(monitors)
    interpreter.start(0)
    events = trace(random, 24)
    expected = naive(one, events)
    for place, (event, values) in enumerate(events):
        outcome = monitors.process(f"/{event}", body(values), place)
        check_same(outcome, interpreter.process(f"/{event}", body(values), place))
        assert told(outcome) == expected[place], (one.text(binding=True), events[: place + 1])


def test_the_named_events_of_a_slice_alone_give_its_verdict() -> None:
    random, explained = seeded(44), 0
    for _ in range(examples(60)):
        one = replace(made(random), actions=dict.fromkeys("abc", ""))
        one = replace(one, properties=tuple(text.replace("__RESET;", "") for text in one.properties))
        events = trace(random, 20)
        monitors = load(one.text(binding=True))
        for place, (event, values) in enumerate(events):
            outcome = monitors.process(f"/{event}", body(values), place, MessageSender(place + 1))
            for verdict in outcome.verdicts[:EXPLAINED]:
                assert verdict.why is not None
                alone, last = load(one.text(binding=False)), Outcome()
                for named in verdict.why.events:
                    assert (named.time + 1, events[named.time][0]) == (
                        named.sender.source,
                        "abc"[named.event],
                    )
                    assert named.time in slice_of(one, events, verdict.binding)
                    last = alone.process(f"/{events[named.time][0]}", body(events[named.time][1]), named.time)
                assert (verdict.property, verdict.category) in [
                    (each.property, each.category) for each in last.verdicts
                ], (one.text(binding=True), events[: place + 1], verdict)
                explained += 1
    assert explained > examples(500)


def slice_of(one: Made, trace: Trace, binding: Mapping[str, object]) -> Sequence[int]:
    shown = {name: str(given) for name, given in binding.items()}
    own = [
        place
        for place, (event, values) in enumerate(trace)
        if all(
            (f"{values[name]}.0" if name == "r" else str(values[name])) == shown[name]
            for name in one.binds[event]
        )
    ]
    begun = [place for place in own if not one.creation or trace[place][0] in one.creation]
    return [place for place in own if place >= begun[0]]


@pytest.mark.parametrize(
    ("look", "handler"),
    [("when (n < 1)", ""), ("", "ptltl: !look @violation { if (id == 1) { DROP; } }")],
    ids=["a condition", "a drop"],
)
def test_an_event_that_did_not_happen_in_a_slice_does_not_explain_it(look: str, handler: str) -> None:
    text = f"""s(int id) {{
        int n = 0;
        creation event go(int id) /go std_msgs/Int32 '{{data:id}}' {{ n = n + id - 1; }}
        event look() /look std_msgs/Empty '{{}}' {look} {{ }}
        event end(int id) /end std_msgs/Int32 '{{data:id}}' {{ }}
        ere: go look end @match {{ ROS_INFO("over"); }} @fail {{ ROS_INFO("over"); }}
        {handler}
    }}"""
    monitors = load(text)
    for place, (topic, given) in enumerate((("/go", 1), ("/go", 2), ("/look", 0), ("/end", 1), ("/end", 2))):
        sent = message("std_msgs/Empty") if topic == "/look" else message("std_msgs/Int32", data=given)
        outcome = monitors.process(topic, sent, place, MessageSender(place + 1))
        if topic == "/end":
            said = "match" if given == 1 else "fail"
            assert [(verdict.category, verdict.why) for verdict in outcome.verdicts] == [(said, None)]


GOALS = """
goals(std::string id) {
    int again = 0;
    creation event goal(std::string id) /goal std_msgs/String '{data:id}' { again = again + 1; }
    event result(std::string id) /result std_msgs/String '{data:id}' { }
    event stop() /stop std_msgs/Empty '{}' { }
    ere: goal (result | stop)
    @match { ROS_INFO("%s: %d", id.c_str(), again); }
    @fail { ROS_WARN("%s", id.c_str()); DROP; }
}
"""
# The same specification without the part that keeps a finished slice.
ANSWERED = GOALS.replace('@fail { ROS_WARN("%s", id.c_str()); DROP; }', "")


def text(value: str) -> bytes:
    return message("std_msgs/String", data=value)


def live(monitors: MonitorSet) -> int:
    slices = monitors.monitors[0].slices
    assert slices is not None
    return slices.live


def test_a_long_binding_is_a_fault() -> None:
    monitors = load(GOALS)
    assert not monitors.process("/goal", text("x" * MAX_BINDING), 1).faults
    outcome = monitors.process("/goal", text("x" * (MAX_BINDING + 1)), 2)
    assert outcome.result == "dropped"
    assert outcome.faults[0].text.startswith("a binding of 257 bytes; it may have 256")
    assert live(monitors) == 1


def test_finished_slices_are_collected_and_do_not_begin_again() -> None:
    counted = ANSWERED.replace("again = again + 1;", "if (again < 1) again = again + 1;")
    monitors = MonitorSet.of(compiled_from({"x.rv": counted}, definitions()), slices=3)
    monitors.start(0)
    for one in "abcd":
        monitors.process("/goal", text(one), 1)
        assert monitors.process("/result", text(one), 2).verdicts
        assert live(monitors) == 0
    for one, known in (("b", True), ("d", True), ("a", False)):
        monitors.process("/goal", text(one), 3)
        assert bool(monitors.process("/result", text(one), 4).verdicts) is not known


def test_a_slice_in_its_initial_state_is_forgotten() -> None:
    clients = (
        "clients(std::string id) {"
        "event connect(std::string id) /c std_msgs/String '{data:id}' { }"
        "event leave(std::string id) /l std_msgs/String '{data:id}' { }"
        'fsm: out [ connect -> in ] in [ leave -> out ] @fail { ROS_WARN("%s", id.c_str()); __RESET; } }'
    )
    monitors = MonitorSet.of(compiled_from({"x.rv": clients}, definitions()), slices=1)
    monitors.start(0)
    for number in range(5):
        assert not monitors.process("/c", text(str(number)), 1).faults
        assert live(monitors) == 1
        monitors.process("/l", text(str(number)), 2)
        assert live(monitors) == 0
    assert [line.text for line in monitors.process("/l", text("x"), 3).log] == ["x"]


def test_slices_stay_when_specifications_are_loaded_again() -> None:
    monitors = load(GOALS)
    monitors.process("/goal", text("a"), 1)
    other = "other() { event e() /o std_msgs/Empty '{}' { } }"
    monitors, _ = replaced(monitors, {"x.rv": GOALS, "y.rv": other}, definitions(), 2)
    assert monitors.process("/result", text("a"), 3).verdicts
    monitors.process("/goal", text("b"), 4)
    monitors, _ = replaced(monitors, {"x.rv": GOALS + " "}, definitions(), 5)
    assert live(monitors) == 2
    monitors, _ = replaced(monitors, {"x.rv": GOALS.replace("again + 1", "again + 2")}, definitions(), 6)
    assert live(monitors) == 0
    assert not monitors.process("/result", text("b"), 7).verdicts


def test_nan_is_one_binding() -> None:
    monitors = load(
        "s(double x) { event e(double x) /e std_msgs/Float64 '{data:x}' { } ere: e e @match { } @fail { } }"
    )
    for _ in range(3):
        monitors.process("/e", message("std_msgs/Float64", data=float("nan")), 1)
    assert live(monitors) == 1


def test_the_automaton_of_a_slice_is_certified() -> None:
    with_, without = (
        certificates_of(load(one).compiled.specifications)[0]["goals"]
        for one in (GOALS, GOALS.replace("goals(std::string id)", "goals()").replace("id.c_str()", '"x"'))
    )
    assert with_ == without
    assert "tested" not in with_[0]


def test_a_slice_takes_less_than_a_kilobyte() -> None:
    monitors = load(GOALS)
    slices = monitors.monitors[0].slices
    assert slices is not None
    head = text("x" * 36)[:4]
    gc.collect()
    tracemalloc.start()
    for number in range(200):
        assert not monitors.process("/goal", head + b"%036d" % number, 1).faults
    used, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert (live(monitors), used < 200_000) == (200, True), used


def test_runs_that_may_grow_have_a_lower_limit() -> None:
    """The run of a grammar has no size limit that would allow 100,000 of them."""
    slices = (
        load(
            "s(std::string id) { event e(std::string id) /t std_msgs/String '{data:id}' { }"
            " cfg: S -> e S e S | epsilon @fail { } }"
        )
        .monitors[0]
        .slices
    )
    assert slices is not None
    assert slices.limit == GROWING_LIMIT


def test_topics_of_parametric_specifications_have_no_lane() -> None:
    other = "other() { bool b = false; event e(bool x) /o std_msgs/Bool '{data:x}' { b = x; } }"
    monitors = on_module(compiled_from({"x.rv": GOALS, "y.rv": other}, definitions()))
    monitors.start(0)
    assert monitors.lane("/goal") is None
    assert monitors.lane("/o") is not None
    assert compile_files([parse(GOALS, "x.rv")], definitions()).specifications[0].slicing is not None


def test_one_message_may_concern_all_slices() -> None:
    monitors = load(ANSWERED)
    for number in range(200):
        monitors.process("/goal", text(str(number)), 1)
    outcome = monitors.process("/stop", b"", 2)
    assert [verdict.binding["id"] for verdict in outcome.verdicts] == [str(number) for number in range(200)]
    assert [verdict.why is not None for verdict in outcome.verdicts] == [True] * EXPLAINED + [False] * (
        200 - EXPLAINED
    )
    assert outcome.events == ("goals.stop",)
    assert live(monitors) == 0
