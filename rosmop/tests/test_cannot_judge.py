"""A monitor that has missed an event because of a fault cannot judge, so it passes nothing."""

import pytest

from rosmop.check.sources import compiled_from
from rosmop.run.engine import MonitorSet
from rosmop.tests.acting import definitions, load, message

SCAN = """event scan(std::vector<float> ranges) /scan sensor_msgs/LaserScan '{ranges:ranges}' {
    nearest = INFINITY;
    for (int i = 0; i < ranges.size(); i++) { nearest = std::min(nearest, ranges[i]); } }"""
JOINTS = """event joints(std::vector<std::string> names, std::vector<double> at) /joint_states sensor_msgs/JointState
    '{name:names, position:at}' {
    for (int i = 0; i < names.size(); i++) { if (names[i] == "tilt") { nearest = at[i]; } } }"""
DRIVE = "event drive(double v) /cmd_vel geometry_msgs/Twist '{linear.x:v}' { if (nearest < 0.5 && v > 0) { return; } }"
STATE = "float nearest = INFINITY;"
TWIST = message("geometry_msgs/Twist", linear__x=1.0)
FREE, NEAR = (message("sensor_msgs/LaserScan", ranges=[distance]) for distance in (9.0, 0.1))
HUGE = message("sensor_msgs/LaserScan", ranges=[9.0] * 400_000)
SHORT = message("sensor_msgs/JointState", name=["pan", "tilt"], position=[0.0])


def guard(*members: str, head: str = "guard()") -> str:
    return f"{head} {{ {' '.join(members)} }}"


def drives(monitors: MonitorSet) -> bool:
    return monitors.process("/cmd_vel", TWIST, 9).result == "passed"


@pytest.mark.parametrize(
    ("event", "topic", "data"), [(SCAN, "/scan", HUGE), (JOINTS, "/joint_states", SHORT)]
)
@pytest.mark.parametrize("apart", [False, True])
def test_a_fault_in_an_observing_event_stops_the_robot(
    event: str, topic: str, data: bytes, apart: bool
) -> None:
    sensor, driving = guard(STATE, event, head="sensor()"), guard(DRIVE)
    monitors = load(sensor, y=driving) if apart else load(guard(STATE, event, DRIVE))
    assert drives(monitors)
    outcome = monitors.process(topic, data, 2)
    assert (outcome.began_holding, drives(monitors)) == (("guard",), False)
    assert monitors.monitor("guard").why_held.startswith("an event that it depends on had a fault: x.rv:")
    monitors.resume("guard")
    assert drives(monitors)


def test_a_monitor_that_is_declared_begin_starts_again() -> None:
    monitors = load(guard("float nearest = 0;", SCAN, DRIVE, head="begin guard()"))
    seen = []
    for data in (FREE, HUGE, FREE, NEAR):
        monitors.process("/scan", data, 2)
        seen.append(drives(monitors))
    assert seen == [True, False, True, False]


@pytest.mark.parametrize(
    "text",
    [
        guard("int n;", DRIVE.replace("{ if (nearest < 0.5 && v > 0)", "{ n = 1 / int(v); if (n)")),
        guard(SCAN.replace("nearest", "at"), "float at;", "event e() /cmd_vel geometry_msgs/Twist '{}' { }"),
    ],
)  # fmt: skip
def test_other_faults_drop_only_their_message(text: str) -> None:
    monitors = load(text)
    zero = message("geometry_msgs/Twist")
    assert not monitors.process("/cmd_vel", zero, 1).began_holding
    assert not monitors.process("/scan", HUGE, 2).began_holding
    assert [monitor.held for monitor in monitors.monitors] == [False]


def test_a_timer_that_faults_stops_the_robot() -> None:
    """A deadman whose timer cannot run does not see that commands are missing."""
    monitors = load(guard("int n; bool stopped;", "event t() every 1s { n = 1 / n; stopped = true; }",
                          DRIVE.replace("nearest < 0.5", "stopped")))  # fmt: skip
    assert monitors.advance(10**9)[0].began_holding == ("guard",)
    assert not drives(monitors)


def test_a_monitor_in_shadow_mode_holds_nothing() -> None:
    compiled = compiled_from({"x.rv": guard(STATE, SCAN, DRIVE)}, definitions())
    monitors = MonitorSet.of(compiled, shadows=["guard"])
    monitors.start(0)
    monitors.process("/scan", HUGE, 1)
    [copy] = monitors.tapped
    outcome = copy.give()
    assert outcome.faults and not outcome.began_holding
    passing = load(guard(STATE, SCAN, DRIVE), on_fault="pass")
    assert passing.process("/scan", HUGE, 2).faults and drives(passing)


def test_a_timer_goes_on_while_its_monitor_holds() -> None:
    monitors = load("""deadman() { ros::Time last; geometry_msgs::Twist zero;
        event command() /cmd_vel geometry_msgs/Twist '{}' { last = ros::Time::now(); }
        event silent() every 100ms {
            if ((ros::Time::now() - last).toSec() > 0.3) { PUBLISH(/cmd_vel, geometry_msgs/Twist, zero); } } }""")
    monitors.hold_lost(monitors.monitor("deadman"), "its state is lost")
    sent = []
    for time in range(1, 9):
        assert not drives(monitors)
        sent += [one.topic for outcome in monitors.advance(time * 10**8) for one in outcome.published]
    assert sent == ["/cmd_vel"] * 5
