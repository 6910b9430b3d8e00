from collections.abc import Callable

import pytest

from rosmop.check.sources import compiled_from
from rosmop.run.engine import MonitorSet
from rosmop.tests.acting import definitions, load, message
from rosmop.tests.logics.driving import seeded
from rosmop.tests.on_module import on_module

NETWORKS = ("10.0.0.7/32", "10.8.0.0/16")
TEXT = """begin w() {
    bool hidden = true;
    withhold /image from "10.0.0.7", "10.8.0.0/16" while hidden;
    event frame() /image std_msgs/String '{}' { }
    event at(double[] p) /pose std_msgs/Float64MultiArray '{data:p}' { hidden = p[0] > 1; }
    event back() every 1s { hidden = true; }
}"""
FRAME = message("std_msgs/String")
HIDE, SHOW, SHORT = (message("std_msgs/Float64MultiArray", data=data) for data in ([2.0], [0.5], []))


@pytest.mark.parametrize("made", [MonitorSet.of, on_module])
def test_hosts_get_messages_exactly_while_the_variable_is_false(
    made: Callable[..., MonitorSet],
) -> None:
    monitors, chance = made(compiled_from({"x.rv": TEXT}, definitions())), seeded(1)
    monitors.start(0)
    assert monitors.withheld_from("/image") == NETWORKS
    hidden, time = True, 0
    for _ in range(1000):
        time += chance.randrange(400) * 10**6
        hidden = hidden or time >= (monitors.next_due or 0)
        monitors.advance(time)
        data = chance.choice([HIDE, SHOW, SHORT, FRAME])
        topic = "/image" if data is FRAME else "/pose"
        outcome = monitors.judge(topic, bytearray(data), time)
        hidden = hidden if data is FRAME else data is not SHOW
        assert bool(outcome.faults) is (data is SHORT)
        assert monitors.withheld_from("/image") == (NETWORKS if hidden else ())
        assert monitors.withholds(monitors.monitor("w")) is hidden
    assert monitors.withheld_from("/pose") == ()


def test_only_an_enabled_monitor_in_force_withholds() -> None:
    monitors = load(TEXT)
    assert monitors.may_withhold("/image")
    monitors.switch({"w": False}, 1)
    assert (monitors.may_withhold("/image"), monitors.withholds(monitors.monitor("w"))) == (False, False)
    shadowed = MonitorSet.of(compiled_from({"x.rv": TEXT}, definitions()), shadows=["w"])
    assert not shadowed.may_withhold("/image")


def test_a_monitor_without_begin_holds_its_topics_after_a_fault() -> None:
    monitors = load(TEXT.removeprefix("begin "))
    monitors.process("/pose", SHOW, 1)
    assert monitors.process("/pose", SHORT, 2).began_holding == ("w",)
    assert monitors.process("/image", FRAME, 3).result == "dropped"
