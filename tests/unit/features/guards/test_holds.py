"""While a monitor cannot judge, it holds the topics on which it acts. It only observes the others: they flow on."""

from collections.abc import Callable
from pathlib import Path

import pytest

from appliance.features.guards.presets import DRIVER_CHECK, PRESETS, Guard, Preset, text_of
from rosmop.check.sources import compiled_from
from rosmop.form.compiled import Compiled
from rosmop.run.engine import MonitorSet
from rosmop.tests.acting import message
from rosmop.tests.on_module import on_module
from roswire.definitions import Definitions
from tests.unit.features.guards.guarding import DEFINITIONS

MONITORS = Path(__file__).parents[4] / "monitors"
COMMAND = {"command"}
ACTED = {
    **dict.fromkeys(PRESETS, COMMAND),
    "logging": set(),
    "goals": set(),
    "safe_triggering": {"/landshark_control/trigger"},
    "safe_zone": {"/landshark_control/base_velocity"},
    "obstacle_avoidance": {"/landshark_control/base_velocity"},
    "driver_check": COMMAND,
}
"""The topics on which each preset (by the name of the topic in its text) and each shipped monitor acts."""
MADE = pytest.mark.parametrize("made", [MonitorSet.of, on_module], ids=["interpreter", "module"])


def definitions() -> Definitions:
    trigger = MONITORS / "msg" / "landshark_msgs" / "PaintballTrigger.msg"
    return DEFINITIONS.extended(
        Definitions.from_files({"landshark_msgs/PaintballTrigger.msg": trigger.read_text()})
    )


def shipped() -> dict[str, tuple[str, set[str]]]:
    presets = {**PRESETS, DRIVER_CHECK.name: DRIVER_CHECK}
    found = {name: (_text(preset), _topics(name, preset)) for name, preset in presets.items()}
    others = [path for path in MONITORS.glob("*.rv") if path.stem not in found]
    return found | {path.stem: (path.read_text(), ACTED[path.stem]) for path in others}


def _text(preset: Preset) -> str:
    return text_of(Guard(preset.name, preset))


def _topics(name: str, preset: Preset) -> set[str]:
    return {preset.given_topics[topic] for topic in ACTED[name]}


CASES = [pytest.param(*case, id=name) for name, case in shipped().items()]


def empty(kind: str) -> bytes:
    """Return a message without elements and texts, whose other fields are zero."""
    return bytes(definitions().layout(kind).minimum)


def started(text: str, made: Callable[[Compiled], MonitorSet] = MonitorSet.of) -> MonitorSet:
    monitors = made(compiled_from({"guard.rv": text}, definitions()))
    monitors.start(0)
    return monitors


@pytest.mark.parametrize(("text", "acted"), CASES)
def test_the_table_of_topics_on_which_a_monitor_acts(text: str, acted: set[str]) -> None:
    for monitor in started(text).monitors:
        assert set(monitor.code.acts_on) == acted
    without = compiled_from({"guard.rv": text}, definitions(), without_code=["guard.rv"])
    assert {one.acts_on for one in without.specifications} == {tuple(sorted(acted))}


@MADE
@pytest.mark.parametrize(("text", "acted"), CASES)
def test_a_hold_takes_no_observed_topic_from_others(
    text: str, acted: set[str], made: Callable[[Compiled], MonitorSet]
) -> None:
    for cause in ("held", "broken"):
        monitors = started(text, made)
        for monitor in monitors.monitors:
            if cause == "held":
                monitors.hold(monitor, "test")
            else:
                monitor.broken = True
        for time in (1, 2):
            passed = {
                topic: monitors.judge(topic, bytearray(empty(kind)), time).result != "dropped"
                for topic, kind in monitors.topics.items()
            }
            safe = {one.topic for monitor in monitors.monitors for one in monitor.code.safes}
            expected = {topic: topic not in acted or topic in safe for topic in passed}
            assert passed == expected


@MADE
def test_observations_during_a_hold_count_after_it(made: Callable[[Compiled], MonitorSet]) -> None:
    """An emergency stop that is pressed while its guard holds stops the base after `resume`."""
    for pressed in (True, False):
        monitors = started(_text(PRESETS["estop"]), made)
        monitors.hold(monitors.monitor("estop"), "test")
        still, drive = message("geometry_msgs/Twist"), message("geometry_msgs/Twist", linear__x=1.0)
        press = message("std_msgs/Bool", data=pressed)
        assert monitors.judge("/emergency_stop", bytearray(press), 1).result == "passed"
        assert monitors.judge("/cmd_vel", bytearray(drive), 2).result == "dropped"
        monitors.resume("estop")
        monitors.judge("/cmd_vel", bytearray(still), 3)
        outcome = monitors.judge("/cmd_vel", bytearray(drive), 4)
        assert outcome.result == ("changed" if pressed else "passed")


@MADE
def test_a_holding_monitor_keeps_the_fast_path_of_what_it_observes(
    made: Callable[[Compiled], MonitorSet],
) -> None:
    monitors = started(_text(PRESETS["separation"]), made)
    scan = message("sensor_msgs/LaserScan", range_max=9.0, ranges=[5.0])
    monitors.hold(monitors.monitor("separation"), "test")
    monitors.advance(1)
    assert monitors.judge("/scan", bytearray(scan), 1).result == "passed"
    for topic, ready in (("/scan", True), ("/cmd_vel", False)):
        lane = monitors.lane(topic)
        assert lane is None or monitors.lane_ready(lane, 2) is ready
