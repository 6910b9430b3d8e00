import pytest

from rosmop.check.sources import compiled_from
from rosmop.run.engine import MonitorSet
from rosmop.run.outcomes import Outcome
from rosmop.tests.acting import definitions, fields, load, message
from rosmop.tests.on_module import on_module

MUX = """mux() { event in(geometry_msgs::Twist t) /joy geometry_msgs/TwistStamped '{twist:t}' {
    PUBLISH(/cmd_vel, geometry_msgs/Twist, t); } }"""
CAP = (
    "cap() { event c(double v) /cmd_vel geometry_msgs/Twist '{linear.x:v}' { if (v > 0.22) { v = 0.22; } } }"
)
COUNT = """count() { int n; event c() /cmd_vel geometry_msgs/Twist '{}' { n++; }
    ere: c c @match { DROP; __RESET; } }"""
FAST = message("geometry_msgs/TwistStamped", twist__linear__x=9.0)


def speeds(outcome: Outcome) -> list[float]:
    return [fields("geometry_msgs/Twist", one.data).linear.x for one in outcome.sent_messages()]


def test_a_cap_limits_what_a_mux_publishes() -> None:
    assert speeds(load(MUX, y=CAP).process("/joy", FAST, 1)) == [0.22]
    assert speeds(load(CAP, y=MUX).process("/joy", FAST, 1)) == [9.0]


def test_published_messages_step_properties_and_are_dropped() -> None:
    monitors = load(MUX, y=COUNT)
    outcomes = [monitors.process("/joy", FAST, time) for time in (1, 2, 3)]
    assert [speeds(outcome) for outcome in outcomes] == [[9.0], [], [9.0]]
    assert [one.verdicts[0].category for one in outcomes[1].judged.values()] == ["match"]
    assert monitors.value("count", "n") == 3


def test_messages_of_timers_are_judged() -> None:
    tick = """p() { geometry_msgs::Twist t;
        event e() every 1s { t.linear.x = 9; PUBLISH(/cmd_vel, geometry_msgs/Twist, t); } }"""
    [outcome] = load(tick, y=CAP).advance(10**9)
    assert speeds(outcome) == [0.22]


@pytest.mark.parametrize("module", [True, False])
@pytest.mark.parametrize("kind", ["Time", "Duration"])
def test_a_time_that_no_message_can_hold_is_a_fault_that_says_so(kind: str, module: bool) -> None:
    """It is not said of the bytes of the message, which are right."""
    most = {"Time": "4294967295u", "Duration": "2147483647"}[kind]
    set_parts = f"t.sec = {most}; t.nsec = 2000000000;"
    for action in (
        set_parts,
        f"std_msgs::{kind} m; {set_parts.replace('t.', 'm.data.')} PUBLISH(/q, std_msgs/{kind}, m);",
    ):
        text = f"s() {{ event a(ros::{kind} t) /a std_msgs/{kind} '{{data:t}}' {{ {action} }} }}"
        compiled = compiled_from({"x.rv": text}, definitions())
        monitors = on_module(compiled, "drop") if module else MonitorSet.of(compiled)
        monitors.start(0)
        outcome = monitors.process("/a", message(f"std_msgs/{kind}"), 1)
        [fault] = outcome.faults
        assert ("out of range" in fault.text, fault.malformed, outcome.result) == (True, False, "dropped")


CHAIN = [
    f"s{n}() {{ event e(int x) /n std_msgs/Int32 '{{data:x}}' {{ std_msgs::Int32 m; m.data = x + 1;"
    f" PUBLISH(/n, std_msgs/Int32, m); }} }}"
    for n in range(6)
]


def test_a_circle_ends_with_the_order() -> None:
    monitors = load(CHAIN[0], **dict(zip("yzuvw", CHAIN[1:], strict=True)))  # type: ignore[arg-type]  # the keys are names

    def count(outcome: Outcome) -> int:
        return len(outcome.published) + sum(map(count, outcome.judged.values()))

    assert count(monitors.process("/n", message("std_msgs/Int32", data=1), 1)) == 2 ** len(CHAIN) - 1


def test_a_monitor_that_holds_drops_what_others_publish() -> None:
    monitors = load(MUX, y=COUNT)
    monitors.monitor("count").hold("its state is lost")
    outcome = monitors.process("/joy", FAST, 1)
    assert (outcome.result, speeds(outcome)) == ("passed", [])


@pytest.mark.parametrize("name", ["cap", "mux"])
def test_a_disabled_monitor_judges_nothing(name: str) -> None:
    monitors: MonitorSet = load(MUX, y=CAP)
    monitors.switch({name: False}, 0)
    assert speeds(monitors.process("/joy", FAST, 1)) == ([9.0] if name == "cap" else [])


@pytest.mark.parametrize(
    ("first", "second", "warned"),
    [(CAP, MUX, True), (MUX, CAP, False), (COUNT, MUX, True), (MUX.replace("mux", "m"), MUX, False)],
)
def test_a_pair_in_the_wrong_order_is_a_warning(first: str, second: str, warned: bool) -> None:
    warnings = [str(one) for one in load(first, y=second).warnings if "does not see them" in one.text]
    assert bool(warnings) is warned
    assert not warned or warnings[0].startswith("y.rv:2:5: warning: mux publishes /cmd_vel, but ")
