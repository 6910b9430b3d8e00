# ruff: noqa: E501  the rows of tables

from collections.abc import Callable

import pytest

from rosmop.check.sources import compiled_from
from rosmop.form.findings import SpecificationError
from rosmop.run.engine import MonitorSet
from rosmop.run.outcomes import Outcome
from rosmop.run.timers import MAX_TICKS
from rosmop.runtime.wire import WireMessage
from rosmop.tests.acting import definitions, load, message
from rosmop.tests.examples import examples
from rosmop.tests.random_specifications import Messages, Specifications
from rosmop.tests.random_specifications import definitions as random_definitions
from rosmop.tests.reload import replaced
from roswire.definitions import Definitions

SECOND = 10**9


def number(value: int) -> bytes:
    return message("std_msgs/Int32", data=value)


def on(topic: str, name: str = "e", body: str = "", parameters: str = "") -> str:
    return f"event {name}(int x{parameters}) {topic} std_msgs/Int32 '{{data:x}}' {{ {body} }}\n"


def printed(outcome: Outcome) -> list[str]:
    assert not outcome.faults, outcome.faults
    return [line.text for line in outcome.log]


# Order and sharing


def test_a_message_without_events_keeps_its_buffer() -> None:
    monitors = load("a() {" + on("/t") + "}")
    buffer = bytearray(b"anything")
    outcome = monitors.process("/other", buffer, 0)
    assert (outcome.result, outcome.buffer is buffer, monitors.wants("/other")) == ("passed", True, False)


@pytest.mark.parametrize(
    ("parameter", "when", "body"),
    [
        ("shared", "when (shared < 3)", ""),
        ("shared", "", "shared = 1 / (shared - 3);"),
        ("x", "", "int shared = 3, other = 1 / (shared - x); x = other;"),
        ("x", "", "for (int shared = 3; shared < 5; shared += 2) { x++; }"),
        ("x", "", "std::vector<int> all = {x}; for (int shared : all) { x = 1 / shared; }"),
    ],
)
def test_a_name_of_its_own_does_not_use_the_variable_of_another_specification(
    parameter: str, when: str, body: str
) -> None:
    event = f"event e(int {parameter}) /t std_msgs/Int32 '{{data:{parameter}}}' {when} {{ {body} }}"
    other = "other() { int shared = 0; event e() /u std_msgs/Empty '{}' { shared++; } }"
    for text, uses in (("", set()), ("event f() /u std_msgs/Empty '{}' when (shared > 1) { }", {"other"})):
        monitors = load(f"own() {{ {event} {text} }}", other=other)
        assert monitors.monitor("own").code.uses == uses


# The monitor that made a change


def test_the_events_of_a_change_are_those_found_by_comparing_all_bytes() -> None:
    most = 0
    for seed in range(examples(60)):
        try:
            monitors = MonitorSet.of(
                compiled_from(
                    {f"{place}.rv": text for place, text in enumerate(Specifications(seed).texts())},
                    random_definitions(),
                ),
                ("drop", "pass")[seed % 2],
            )
        except SpecificationError:
            continue
        found: list[str] = []
        for step in (step for monitor in monitors.monitors for step in monitor.steps):
            step.function = _compared(step.name, step.function, found)
        monitors.start(0)
        messages = Messages(seed)
        for traffic in (messages.traffic() for _ in range(20)):
            for body in traffic.bodies():
                found.clear()
                outcome = monitors.process(traffic.topic, bytearray(body), 5)
                changed = outcome.result != "dropped" and bytes(outcome.buffer) != body
                assert (outcome.result == "changed") == changed
                assert list(outcome.changed_by) == (found if changed else [])
                most = max(most, len(outcome.changed_by))
    assert most > 1


def _compared(
    name: str, function: Callable[[WireMessage | None], bool], found: list[str]
) -> Callable[[WireMessage | None], bool]:
    def compared(seen: WireMessage | None) -> bool:
        assert seen is not None
        before = bytes(seen.buffer)
        try:
            return function(seen)
        finally:
            if bytes(seen.buffer) != before:
                found.append(name)

    return compared


# Properties


# Time


def test_timers_wait_for_messages_that_a_recording_has() -> None:
    monitors = MonitorSet.of(
        compiled_from({"x.rv": "a() { event tick() every 1s { }" + on("/t") + "}"}, definitions())
    )
    monitors.start(0, frozenset({"/t"}))
    assert monitors.next_due is None
    monitors.process("/t", number(0), 10 * SECOND)
    assert monitors.next_due == 11 * SECOND


def test_a_leap_of_the_clock_skips_ticks() -> None:
    monitors = load("a() { event tick() every 1ms { } }")
    ticks = monitors.advance(10**18)
    assert len(ticks) == MAX_TICKS
    assert "were skipped: the clock has jumped" in ticks[-1].log[0].text
    assert monitors.next_due is not None
    assert monitors.next_due > 10**18


def test_late_ticks_are_skipped_and_deadlines_wait() -> None:
    text = """a() { int n; event e() /t std_msgs/Bool '{}' { } event tick() every 1ms { n++; ROS_INFO("%d", n); } }
    b() { event x() /t std_msgs/Bool '{}' { }
        tfsm: s [ x -> s, timeout 1ms -> late ] late [ ] @timeout { ROS_WARN("late"); } }"""
    answers = iter([False, False, True])
    monitors = load(text, patience=lambda: lambda: next(answers))
    monitors.process("/t", number(0), 0)
    outcomes = monitors.advance(SECOND)
    lines = [line.text for outcome in outcomes for line in outcome.log]
    assert lines == ["1", "late", "2", "998 ticks of a.tick were skipped: they take too long"]
    assert monitors.next_due == SECOND + SECOND // 1000


# Faults


def test_faults_are_counted() -> None:
    monitors = load("a() {" + on("/t", "e", "x = 1 / x;") + "}")
    seen = []
    for i in range(12):
        seen.append(monitors.monitor("a").failing)
        monitors.process("/t", number(0), i)
    assert monitors.monitor("a").faults == 12
    assert seen == [False] * 10 + [True] * 2


def test_each_message_has_a_whole_budget() -> None:
    monitors = load(
        "a() {" + on("/t", "e", "for (int i = 0; i < 100000; i++) { x = i; } if (x == 3) while (1);") + "}"
    )
    for i in range(20):
        assert not monitors.process("/t", number(0), i).faults


# Switching, holding, swapping


def test_a_set_with_an_error_is_rejected_whole() -> None:
    monitors = load("a() {" + on("/t", "e", "return;") + "}")
    with pytest.raises(SpecificationError):
        replaced(monitors, {"x.rv": "a() {"}, definitions(), 0)
    assert monitors.process("/t", number(0), 1).result == "dropped"


def test_a_specification_whose_variables_others_use_cannot_be_removed_alone() -> None:
    user = "b() {" + on("/u", "e", "n = 1;") + "}"
    monitors = load("a() { int n;" + on("/t") + "}", y=user)
    assert monitors.monitor("b").code.uses == {"a"}
    with pytest.raises(SpecificationError, match=r"y\.rv:1.*unknown variable `n`"):
        replaced(monitors, {"y.rv": user}, definitions(), 0)


# Publishing and services


# Names


def test_a_changed_message_type_resets_the_state() -> None:
    text = "a() { own::T v; int n; event e(int x) /t own/T '{x:x}' { n++; ROS_INFO(\"%d\", n); } }"
    first = Definitions.from_files({"own/T.msg": "int32 x\n"})
    monitors = MonitorSet.of(compiled_from({"x.rv": text}, first))
    monitors.start(0)
    monitors.process("/t", b"\1\0\0\0", 1)
    same, _ = replaced(monitors, {"x.rv": text}, Definitions.from_files({"own/T.msg": "int32 x\n"}), 2)
    assert printed(same.process("/t", b"\1\0\0\0", 3)) == ["2"]
    other, _ = replaced(
        monitors, {"x.rv": text}, Definitions.from_files({"own/T.msg": "int32 y\nint32 x\n"}), 2
    )
    assert printed(other.process("/t", b"\1\0\0\0" * 2, 3)) == ["1"]


def test_only_specifications_that_use_a_changed_message_type_are_reset() -> None:
    texts = {
        "deep": "nested() { int n; event e() /a own/Outer '{}' { n++; ROS_INFO(\"%d\", n); } }",
        "kept": "kept() { int n; event e() /b own/Other '{}' { n++; ROS_INFO(\"%d\", n); } }",
        "value": "value() { own::T v; int n; event e() /c own/Other '{}' { n++; ROS_INFO(\"%d\", n); } }",
    }
    files = {"own/T.msg": "int32 x\n", "own/Outer.msg": "own/T[] all\n", "own/Other.msg": "int32 x\n"}
    monitors = MonitorSet.of(compiled_from(texts, Definitions.from_files(files)))
    monitors.start(0)
    for topic in ("/a", "/b", "/c"):
        monitors.process(topic, b"\0\0\0\0", 1)
    files["own/T.msg"] = "int32 y\nint32 x\n"
    other, _ = replaced(monitors, texts, Definitions.from_files(files), 2)
    assert other.began == ("nested", "value")
    counts = [printed(other.process(topic, b"\0\0\0\0", 3)) for topic in ("/a", "/b", "/c")]
    assert counts == [["1"], ["2"], ["1"]]


def test_a_set_knows_its_topics_services_and_publications() -> None:
    monitors = load("""a() { std_msgs::String s; event e() /t std_msgs/Int32 '{}' { PUBLISH("/said", "std_msgs::String", s); }
        event ask() service /set std_srvs/SetBool request '{}' { } }""")
    assert monitors.wants("/t")
    monitors.switch({"a": False}, 1)
    assert not monitors.wants("/t")
    assert dict(monitors.topics) == {"/t": "std_msgs/Int32"}
    assert dict(monitors.services) == {"/set": "std_srvs/SetBool"}
    assert dict(monitors.publications) == {"/said": "std_msgs/String"}
