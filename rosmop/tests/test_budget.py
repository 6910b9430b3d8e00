import gc
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from itertools import chain, permutations, repeat
from time import thread_time
from typing import Any

import pytest

from rosmop.check.sources import compiled_from
from rosmop.form.findings import Position
from rosmop.logics.catalogue import LOGICS, compile_property
from rosmop.run.engine import MonitorSet
from rosmop.runtime.action_context import ActionState, Context, FaultError
from rosmop.runtime.builtin_functions import CHARGING, FUNCTIONS
from rosmop.runtime.strings import NOT_FOUND
from rosmop.tests.acting import message
from roswire.standard import standard_definitions

JOINTS = "sensor_msgs/JointState"
NAMES = message(JOINTS, name=[""] * 200_000, position=[0.5] * 200_000)
TEXT = message("std_msgs/String", data="x" * 200_000)

WALKS = {
    "a loop": ("std_msgs/String", "std::string s", "{data:s}", "for (int i = 0; i < s.size(); i++) n += i;", TEXT),
    "a field behind strings": (JOINTS, "double x", "{position[0]:x}", "n = x;", NAMES),
    "a copy of the message": (JOINTS, "", "{}", "sensor_msgs::JointState all = MESSAGE; n = all.name.size();", NAMES),
    "a sum": (JOINTS, "double[] p", "{position:p}", "n = std::accumulate(p.begin(), p.end(), 0.0);", NAMES),
    "a search": ("std_msgs/String", "std::string s", "{data:s}", 'n = s.find_first_of("yz");', TEXT),
    "a vector": ("std_msgs/String", "std::string s", "{data:s}", "std::vector<int> v(s.size() * 4, 1); n = v.size();",
                 TEXT),
}  # fmt: skip


CALLS: dict[str, Callable[[Any, Any, bytes, bytes], object]] = {
    "a_character": lambda call, context, text, _: call(context, text, 0, 98, 0),
    "c_terminated": lambda call, context, text, _: call(context, text, 0),
    "e_fill": lambda call, context, text, _: call(context, len(text), 0.5, float, lambda _: 8, 0),
    "e_filled": lambda call, context, text, other: call(context, text, other, 0),
    "e_repeat": lambda call, context, text, _: call(context, len(text), 97, 0),
    "h_extended": lambda call, context, text, other: call(context, text, other, 0),
    "h_filled": lambda call, context, text, other: call(context, text, other, 0),
    "h_filled_at_most": lambda call, context, text, other: call(context, text, other, len(text), 0),
    "h_printed": lambda call, context, text, other: call(context, text, other, len(text), 0),
    "k_erase": lambda call, context, text, _: call(context, [*text], 0, None, 0),
    "k_insert": lambda call, context, text, _: call(context, [*text], 0, 1, 1, 0),
    "k_reverse": lambda call, context, text, _: call(context, [*text], 0, len(text), 0),
    "k_sort": lambda call, context, text, other: call(context, [text, other], 0, 2, 0),
    "l_append": lambda call, context, text, _: call(context, [*text], 1, 1, 0),
    "l_append_text": lambda call, context, text, other: call(context, [text], other, 32, 0),
    "l_filled": lambda call, context, text, _: call(context, len(text), float, 8, 0),
    "l_nearest": lambda call, context, text, _: call(context, [*text], 0, len(text), 0),
    "l_resized": lambda call, context, text, other: call(context, [*text], len(other), float, 8, 0),
    "o_charged": lambda call, context, text, _: call(context, text, 0),
    "o_extend": lambda call, context, text, other: call(context, text, other, 0),
    "o_join": lambda call, context, text, other: call(context, text, other, 0),
    "t_erase": lambda call, context, text, _: call(context, text, 1, 1, 0),
    "t_extend": lambda call, context, text, other: call(context, text, other, 0),
    "t_find": lambda call, context, text, other: call(context, text, other, 0, 0),
    "t_find_any": lambda call, context, text, other: call(context, text, other, 0, 0),
    "t_find_last": lambda call, context, text, other: call(context, text, other, NOT_FOUND, 0),
    "t_insert": lambda call, context, text, other: call(context, text, 1, other, 0),
    "t_replace": lambda call, context, text, other: call(context, text, 1, 1, other, 0),
    "t_resize": lambda call, context, text, other: call(context, text, len(other), 97, 0),
    "t_shorten": lambda call, context, text, _: call(context, text, 0),
    "t_substring": lambda call, context, text, _: call(context, text, 1, len(text), 0),
    "t_zeroed": lambda call, context, text, _: call(context, text, 0),
}

IMAGE, SCAN, POLYGON = "sensor_msgs/Image", "sensor_msgs/LaserScan", "geometry_msgs/Polygon"
PIXELS, RANGES = message(IMAGE, data=[0] * 1_000_000), message(SCAN, ranges=[0.5] * 200_000)
POINTS = message(POLYGON, points=[{"x": 0.5, "y": 1.0, "z": 2.0}] * 50_000)
LONG = message("std_msgs/String", data="x" * 1_000_000)

NINE = "for (int i = 0; i < 9; i++)"
IS = f"std::vector<uint8_t> q = p; {NINE} n += p =="
WORK = {
    "integers ==": (IMAGE, "std::vector<uint8_t> p", "{data:p}", f"{IS} q;", PIXELS),
    "integers !=": (IMAGE, "std::vector<uint8_t> p", "{data:p}", f"{IS} q; n += p != q;", PIXELS),
    "numbers ==": (SCAN, "float[] p", "{ranges:p}", f"std::vector<float> q = p; {NINE} n += p == q;", RANGES),
    "messages ==": (POLYGON, "", "{}", "geometry_msgs::Polygon p = MESSAGE, q = p; n = p == q;", POINTS),
    "copies": (POLYGON, "", "{}", f"geometry_msgs::Polygon p = MESSAGE; {NINE} {{ auto q = p; }}", POINTS),
    "publishing": (POLYGON, "", "{}", "PUBLISH(/u, geometry_msgs/Polygon, MESSAGE);", POINTS),
    "names ==": (JOINTS, "string[] p", "{name:p}", "std::vector<std::string> q = p; n = p == q;", NAMES),
    "texts ==": ("std_msgs/String", "std::string s", "{data:s}", f'auto t = s + ""; {NINE} n += s == t;', LONG),
    "texts <": ("std_msgs/String", "std::string s", "{data:s}", f'auto t = s + ""; {NINE} n += s < t;', LONG),
    "characters": ("std_msgs/String", "std::string s", "{data:s}",
                   "for (int i = 0; i < 999; i++) { char c[] = s; n += c[0]; }", LONG),
    "signs": (IMAGE, "std::vector<int8_t> p", "{data:p}", "std::vector<uint8_t> q = p; n = q.size();", PIXELS),
    "truths": (IMAGE, "bool[] p", "{data:p}", "n = p.size();", PIXELS),
}  # fmt: skip


def is_paid(context: Context, run: Callable[[], object]) -> bool:
    """Whether the processor time is at most 5 ms, 1 µs for each instruction, and 2 µs for each counted element."""
    for _ in range(3):  # the machine may be busy
        context.turn.spent = 0
        context.begin()
        gc.disable()  # the relay freezes most objects
        begun = thread_time()
        sum(range(100_000)), [0] * 1_000_000  # 2 ms, unless the machine computes or gives memory slowly
        slowness = max(1.0, (thread_time() - begun) / 0.002)
        begun = thread_time()
        with suppress(FaultError):
            run()
        taken = thread_time() - begun
        gc.enable()
        if taken <= slowness * (0.005 + (context.most - context.budget + 2 * context.turn.spent) * 1e-6):
            return True
    return False


@pytest.mark.parametrize("name", sorted(CHARGING))
def test_a_call_is_charged_for_the_time_it_takes(name: str) -> None:
    context = Context("a", ActionState(), {}, list)
    context.most = 1 << 40
    for length, other in permutations((49_000, 998_000, 1_000_000), 2):
        for wanted in (b"b" * other, b"ab" + b"a" * (other - 2), b"a" * (other - 2) + b"ba"):
            assert is_paid(context, partial(CALLS[name], FUNCTIONS[name], context, b"a" * length, wanted))


@pytest.mark.parametrize("name", WORK)
def test_a_comparison_or_copy_is_charged_for_the_time_it_takes(name: str) -> None:
    kind, parameter, pattern, action, data = WORK[name]
    text = f"a() {{ double n = 0; event e({parameter}) /t {kind} '{pattern}' {{ {action} }} }}"
    monitors = MonitorSet.of(compiled_from({"a.rv": text}, standard_definitions()))
    monitors.start(0)
    [context] = monitors.interpreter.contexts.values()
    context.most = 1 << 40
    assert not monitors.process("/t", bytearray(data), 1).faults
    assert is_paid(context, partial(monitors.process, "/t", bytearray(data), 2))


COSTLY = {  # formula, and how often `a` happens before the measured `b`
    "fsm": ("s [ a -> s, b -> t ] t [ a -> s, b -> t ]", 9),
    "tfsm": ("s [ a -> s, b -> t ] t [ a -> s, b -> t, timeout 1s -> s ]", 9),
    "ere": ("(a* b)* a", 9),
    "ltl": ("[](a => o (!a U b))", 9),
    "ptltl": ("[*](b => (*)(a S a))", 9),
    "ptcaret": ("b => (*)a", 9),
    "pattern": ("globally: a causes b within 1s", 9),
    "mtl": ("historically (a => eventually[0,1000s] (b and eventually[0,1000s] b))", 900),
    "cfg": ("S -> S S S | S S | a | b", 195),
    "srs": (
        f"{'z ' * 600} -> a . b -> c0 . "
        + "".join(f"c{i} -> c{i + 1} . " for i in range(300))
        + "c300 -> z .",
        700,
    ),
}


@pytest.mark.parametrize("logic", LOGICS)
def test_the_steps_of_properties_are_within_the_budget(logic: str) -> None:
    formula, before = COSTLY[logic]
    handler = f"@{compile_property(logic, formula, ('a', 'b'), Position('', 1, 1)).categories[-1]} {{ n++; }}"
    text = f"""m() {{ int n = 0; event a() /a std_msgs/Empty '{{}}' {{ }} event b() /b std_msgs/Empty '{{}}' {{ }}
        {f"{logic}: {formula} {handler} " * 20} }}"""
    monitors = MonitorSet.of(compiled_from({"m.rv": text}, standard_definitions(), lints=False))
    monitors.start(0)
    for number in range(before):
        monitors.process("/a", bytearray(), number)
    monitors.limit_time(chain([0.0], repeat(1.0)).__next__, 0.010)  # the time is over at once
    gc.disable()
    begun = thread_time()
    outcome = monitors.process("/b", bytearray(), before)
    taken = thread_time() - begun
    gc.enable()
    costly = logic in {"mtl", "cfg", "srs"}
    assert any("10 ms of processor time" in fault.text for fault in outcome.faults) is costly
    assert taken < (0.1 if costly else 0.01)


def ticking(readings: list[None]) -> Callable[[], float]:
    def read() -> float:
        readings.append(None)
        return len(readings) / 1000

    return read


@pytest.mark.parametrize("name", WALKS)
def test_every_walk_of_a_message_ends_with_its_time(name: str) -> None:
    kind, parameter, pattern, action, data = WALKS[name]
    text = f"a() {{ double n = 0; event e({parameter}) /t {kind} '{pattern}' {{ {action} }} }}"
    monitors = MonitorSet.of(compiled_from({"a.rv": text}, standard_definitions()))
    monitors.start(0)
    free = monitors.process("/t", bytearray(data), 1)
    assert (free.result, free.faults) == ("passed", ())
    readings: list[None] = []
    monitors.limit_time(ticking(readings), 0.010)
    outcome = monitors.process("/t", bytearray(data), 2)
    assert outcome.result == "passed"  # the topic is only observed
    assert "more than 10 ms of processor time" in outcome.faults[0].text
    assert len(readings) <= 16
    assert outcome.faults[0].over


def test_on_fault_decides_about_a_message_that_was_cut_off() -> None:
    loop = (
        "event e(std::string s) /t std_msgs/String '{data:s}' { for (int i = 0; i < s.size(); i++) n += i; }"
    )
    sources = {f"{name}.rv": f"{name}() {{ int n = 0; {loop} }}" for name in ("a", "b")}
    monitors = MonitorSet.of(compiled_from(sources, standard_definitions()), "pass")
    monitors.start(0)
    readings: list[None] = []
    monitors.limit_time(ticking(readings), 0.010)
    outcome = monitors.process("/t", bytearray(TEXT), 1)
    assert outcome.result == "passed"
    assert [fault.monitor for fault in outcome.faults] == ["a", "b"]
    assert len(readings) <= 32


def test_a_hurried_message_has_a_part_of_the_time() -> None:
    text = "a() { int n; event e(std::string s) /t std_msgs/String '{data:s}' { for (;;) n++; } }"
    monitors = MonitorSet.of(compiled_from({"a.rv": text}, standard_definitions()))
    monitors.start(0)
    monitors.limit_time(ticking([]), 0.010)
    monitors.hurry(0.1)
    assert "more than 1 ms" in monitors.process("/t", bytearray(TEXT), 1).faults[0].text


def test_a_message_costs_the_same_whatever_came_before() -> None:
    """The values are measured after some messages; so the proofs know the budget that a message leaves."""
    text = (
        """a() { std::string kept; event e(std::string s) /t std_msgs/String '{data:s}' { kept = s + s; } }"""
    )
    monitors = MonitorSet.of(compiled_from({"a.rv": text}, standard_definitions()))
    monitors.start(0)
    [context] = monitors.interpreter.contexts.values()
    data = message("std_msgs/String", data="x" * 300_000)
    rests = set()
    for time in range(1, 8):
        assert not monitors.process("/t", bytearray(data), time).faults
        rests.add(context.budget)
    assert len(rests) == 1
