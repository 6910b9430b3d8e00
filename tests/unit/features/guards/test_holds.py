"""While a monitor cannot judge, it holds the topics on which it acts. It only observes the others: they flow on."""

import functools
from collections.abc import Callable

import pytest

from appliance.features.guards.presets import DRIVER_CHECK, PRESETS, Guard, Preset, text_of
from appliance.features.guards.robot_graph import VELOCITIES
from rosmop.check.sources import compiled_from
from rosmop.fast.abi import SetPart
from rosmop.run.engine import MonitorSet
from rosmop.tests.acting import message
from tests.support.features.guards.running_guard import (
    DEFINITIONS,
    MONITORS,
    interpreted,
    on_its_module,
    part_of,
)

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
MADE = pytest.mark.parametrize("made", [interpreted, on_its_module], ids=["interpreter", "module"])


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


@functools.cache
def empty(kind: str) -> bytes:
    """Return a message without elements and texts, whose other fields are zero."""
    return bytes(DEFINITIONS.layout(kind).minimum)


def started(text: str, made: Callable[[SetPart], MonitorSet] = interpreted) -> MonitorSet:
    monitors = made(part_of(text))
    monitors.start(0)
    return monitors


@pytest.mark.parametrize(("text", "acted"), CASES)
def test_the_table_of_topics_on_which_a_monitor_acts(text: str, acted: set[str]) -> None:
    for monitor in started(text).monitors:
        assert set(monitor.code.acts_on) == acted
    without = compiled_from({"guard.rv": text}, DEFINITIONS, without_code=["guard.rv"])
    assert {specification.acts_on for specification in without.specifications} == {tuple(sorted(acted))}


@MADE
@pytest.mark.parametrize(("text", "acted"), CASES)
def test_a_hold_takes_no_observed_topic_from_others(
    text: str, acted: set[str], made: Callable[[SetPart], MonitorSet]
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
def test_observations_during_a_hold_count_after_it(made: Callable[[SetPart], MonitorSet]) -> None:
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
    made: Callable[[SetPart], MonitorSet],
) -> None:
    monitors = started(_text(PRESETS["separation"]), made)
    scan = message("sensor_msgs/LaserScan", range_max=9.0, ranges=[5.0])
    monitors.hold(monitors.monitor("separation"), "test")
    monitors.advance(1)
    assert monitors.judge("/scan", bytearray(scan), 1).result == "passed"
    for topic, ready in (("/scan", True), ("/cmd_vel", False)):
        lane = monitors.lane(topic)
        assert lane is None or monitors.lane_ready(lane, 2) is ready


STAMPED = [kind for kind in VELOCITIES if kind.endswith("Stamped")]


@MADE
@pytest.mark.parametrize("kind", VELOCITIES)
@pytest.mark.parametrize("name", [name for name, preset in PRESETS.items() if "command" in preset.topics
                                  and {*preset.topics["command"]} >= {*VELOCITIES}])  # fmt: skip
def test_a_stop_passes_a_hold_whatever_its_header(
    name: str, kind: str, made: Callable[[SetPart], MonitorSet]
) -> None:
    monitors = started(text_of(Guard(name, PRESETS[name], types={"command": kind})), made)
    monitors.hold(monitors.monitors[0], "test")
    header = {"header__frame_id": "base_link", "header__seq": 7} if kind in STAMPED else {}
    stop = message(kind, **header)
    assert monitors.judge("/cmd_vel", bytearray(stop), 1).result == "passed"
    motion = bytearray(stop[:-1] + b"\x3f")
    assert monitors.judge("/cmd_vel", motion, 2).result == "dropped"


@MADE
def test_a_velocity_grows_from_zero_after_a_safe_message(made: Callable[[SetPart], MonitorSet]) -> None:
    """The base got the guard's zero after a hold, a resume, a restart with kept state, or an `enable`."""
    second, drive = 10**9, message("geometry_msgs/Twist", linear__x=0.5)
    for cause in ("hold", "restart", "enable", "stop"):
        monitors, now = started(_text(PRESETS["speed"]), made), second
        for _ in range(100):
            now += second // 20
            monitors.judge("/cmd_vel", bytearray(drive), now)
        assert monitors.value("speed", "lastX") == 0.5
        match cause:
            case "hold":
                monitors.hold(monitors.monitor("speed"), "test")
                monitors.advance(now)
                monitors.resume("speed")
            case "restart":
                kept = [
                    (one.names, one.layout, one.base(), one.cells() or None) for one in monitors.kept_groups()
                ]
                monitors = made(part_of(_text(PRESETS["speed"])))
                monitors.recover(kept, {}, now, restarted=True)
            case "enable":
                monitors.switch({"speed": False}, now)
                monitors.switch({"speed": True}, now)
            case "stop":
                monitors.stop("/cmd_vel")
        monitors.advance(now + 1)
        buffer = bytearray(drive)
        assert bytes(monitors.judge("/cmd_vel", buffer, now + second // 50).buffer) != drive, cause
        assert monitors.value("speed", "lastX") <= 0.1 + 1e-9, cause
