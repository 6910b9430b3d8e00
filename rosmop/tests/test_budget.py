from collections.abc import Callable

import pytest

from rosmop.check.sources import compiled_from
from rosmop.run.engine import MonitorSet
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
