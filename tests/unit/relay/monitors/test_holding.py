from collections.abc import Iterator

import pytest

from appliance.base import clock
from appliance.channel.messages import SpecificationsTaken
from rosmop.tests.acting import message
from tests.support.virtual_clock import VirtualClock
from tests.unit.relay.monitors.quiet import QuietMonitors

EVENT = "event e(double v) /cmd_vel geometry_msgs/Twist '{linear.x:v}' { if (v > 9) { return; } }"
ERROR = "0.rv:1:5: error: unknown variable `missing`"


@pytest.fixture
def monitors() -> Iterator[QuietMonitors]:
    with clock.using(VirtualClock()):
        yield QuietMonitors()


@pytest.mark.parametrize(("modifier", "held"), [("", True), ("hold ", True), ("begin ", False)])
def test_a_monitor_whose_file_has_an_error_holds_its_topics(
    monitors: QuietMonitors, modifier: str, held: bool
) -> None:
    because = {"s": f"its file has an error: {ERROR}"} if held else {}
    for _ in range(2):
        assert monitors.load(f"{modifier}s() {{ {EVENT} }}", unbuilt={"s": ERROR}).because == because
    twist = message("geometry_msgs/Twist")
    assert monitors.process("/cmd_vel", twist).result == ("dropped" if held else "passed")
    monitors.interceptor.resume("s")
    assert monitors.load(f"{modifier}s() {{ {EVENT} }}", unbuilt={"s": ERROR}).because == {}
    assert monitors.process("/cmd_vel", twist).result == "passed"


def test_a_disabled_monitor_whose_file_has_an_error_holds_nothing(monitors: QuietMonitors) -> None:
    assert not monitors.load(f"s() {{ {EVENT} }}", unbuilt={"s": ERROR}, enabled={"s": False}).held


SENSOR = "event s(int n) /sensor std_msgs/Int32 '{data:n}' { near = 1 / n > 0; }"
DRIVE = "event d() /cmd_vel geometry_msgs/Twist '{}' { if (near) { return; } }"


def test_a_monitor_that_holds_after_a_fault_is_reported_once(monitors: QuietMonitors) -> None:
    monitors.load(f"s() {{ bool near; {SENSOR} {DRIVE} }}")
    told = len(monitors.reports.sent)
    twist, zero = message("geometry_msgs/Twist"), message("std_msgs/Int32")
    assert [monitors.process(topic, data).result for topic, data in (("/cmd_vel", twist), ("/sensor", zero))] == [
        "passed", "dropped"
    ]  # fmt: skip
    assert [monitors.process("/cmd_vel", twist).result for _ in range(3)] == ["dropped"] * 3
    [taken] = [one for one in monitors.reports.sent[told:] if isinstance(one, SpecificationsTaken)]
    assert taken.held == ["s"]
    assert taken.because["s"] == "an event that it depends on had a fault: 0.rv:1:76: division by zero"
