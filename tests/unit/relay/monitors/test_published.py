from collections.abc import Iterator

import pytest

from appliance.base import clock
from appliance.channel.messages import MonitorsReported
from rosmop.tests.acting import fields, message
from tests.support.virtual_clock import VirtualClock
from tests.unit.relay.monitors.quiet import QuietMonitors

MUX = """mux() { event in(geometry_msgs::Twist t) /joy geometry_msgs/TwistStamped '{twist:t}' {
    PUBLISH(/cmd_vel, geometry_msgs/Twist, t); } }"""
CAP = """cap() { event c(double v) /cmd_vel geometry_msgs/Twist '{linear.x:v}' {
    if (v > 5) { return; } if (v > 0.22) { v = 0.22; } } }"""


@pytest.fixture
def monitors() -> Iterator[QuietMonitors]:
    with clock.using(VirtualClock()):
        yield QuietMonitors()


def test_a_published_command_is_capped_dropped_and_recorded(monitors: QuietMonitors) -> None:
    monitors.load(MUX, CAP)
    for speed in (9.0, 0.5, 0.1):
        monitors.process("/joy", message("geometry_msgs/TwistStamped", twist__linear__x=speed))
    sent = [
        fields("geometry_msgs/Twist", data).linear.x
        for topic, data in monitors.published
        if topic == "/cmd_vel"
    ]
    assert sent == [0.22, 0.1]
    monitors.interceptor.observations.flush()
    events = [
        event for said in monitors.reports.sent if isinstance(said, MonitorsReported) for event in said.events
    ]
    assert [(event.kind, event.monitor, event.resource) for event in events] == [
        ("publish", "mux", "/cmd_vel"), ("drop", "cap", "/cmd_vel"), ("change", "cap", "/cmd_vel")
    ]  # fmt: skip
