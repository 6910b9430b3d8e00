"""Monitors that hold their topics: when, why, and until when."""

from collections.abc import Iterator

import pytest

from appliance.base import clock
from rosmop.tests.acting import message
from tests.support.virtual_clock import VirtualClock
from tests.unit.relay.monitors.quiet import QuietMonitors

EVENT = "event e() /cmd_vel geometry_msgs/Twist '{}' { }"
ERROR = "0.rv:1:5: error: unknown variable `missing`"


@pytest.fixture
def monitors() -> Iterator[QuietMonitors]:
    """Yield the monitors of a relay, with a clock that stands still."""
    with clock.using(VirtualClock()):
        yield QuietMonitors()


@pytest.mark.parametrize(("modifier", "held"), [("", True), ("hold ", True), ("begin ", False)])
def test_a_monitor_whose_file_has_an_error_holds_its_topics(
    monitors: QuietMonitors, modifier: str, held: bool
) -> None:
    """Its own modifier decides; only an operator releases the topics, also when control is restarted."""
    because = {"s": f"its file has an error: {ERROR}"} if held else {}
    for _ in range(2):
        assert monitors.load(f"{modifier}s() {{ {EVENT} }}", unbuilt={"s": ERROR}).because == because
    twist = message("geometry_msgs/Twist")
    assert monitors.process("/cmd_vel", twist).result == ("dropped" if held else "passed")
    monitors.interceptor.resume("s")
    assert monitors.load(f"{modifier}s() {{ {EVENT} }}", unbuilt={"s": ERROR}).because == {}
    assert monitors.process("/cmd_vel", twist).result == "passed"


def test_a_disabled_monitor_whose_file_has_an_error_holds_nothing(monitors: QuietMonitors) -> None:
    """It guarded nothing before."""
    assert not monitors.load(f"s() {{ {EVENT} }}", unbuilt={"s": ERROR}, enabled={"s": False}).held
