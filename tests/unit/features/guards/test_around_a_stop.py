"""A guard that comes into force, or back into force, as the page says it for every preset with a stop."""

import re

import pytest

from appliance.features.guards.presets import PRESETS
from rosmop.run.engine import MonitorSet
from rosmop.run.outcomes import MessageSender
from rosmop.tests.acting import message
from tests.support.features.guards.running_guard import on_its_module, part_with
from tests.unit.features.guards.guarding import BEGIN, MS, NODES, Guarded, twist

STOPPING = [name for name, preset in PRESETS.items() if "\n    safe " in preset.text]
REPLACED = ("deadman", "estop", "speed")
CASES = [(name, how) for name in STOPPING for how in ("enabled", "promoted")]
CASES += [(name, "replaced") for name in REPLACED]


def come_into_force(preset: str, how: str) -> MonitorSet:
    part, _given = part_with(preset, {}, {})
    if how == "enabled":
        monitors = on_its_module(part)
        monitors.start(BEGIN)
        for enabled in (False, True):
            monitors.switch({"guard": enabled}, BEGIN)
        return monitors
    before = MonitorSet.of(part.compiled, shadows=["guard"] if how == "promoted" else [])
    before.start(BEGIN)
    if how == "replaced":
        part, _given = part_with(preset, {}, {}, lambda text: text.replace("every 100ms", "every 99ms"))
    monitors = on_its_module(part)
    monitors.succeed(before, BEGIN)
    return monitors


def stops(monitors: MonitorSet, first: int, last: int) -> list[bytes]:
    """Return what the guard sends between two times in milliseconds."""
    outcomes = [one for at in range(first, last, 10) for one in monitors.advance(BEGIN + at * MS)]
    return [bytes(sent.data) for outcome in outcomes for sent in outcome.sent_messages()]


@pytest.mark.parametrize(("preset", "how"), CASES)
def test_a_guard_that_comes_into_force_sends_stops_until_a_command(preset: str, how: str) -> None:
    monitors, topics = come_into_force(preset, how), PRESETS[preset].given_topics
    # `joints` sends them each second: a further one would prolong the stop of the arm.
    interval = 1000 if re.search(r"safe \{ \} on command every 1s;", PRESETS[preset].text) else 100
    assert (preset == "joints") is (interval == 1000)
    for begin in range(10, 1000, interval):
        sent = stops(monitors, begin, begin + interval)
        assert sent and all(monitors.is_safe(topics["command"], data) for data in sent)
    rows = (
        [("stop", message("std_msgs/Bool"))] if preset == "estop" else []
    )  # or it stops for a silent button
    command = message(next(iter(PRESETS[preset].topics["command"])))
    for given, data in [*rows, ("command", command)]:
        monitors.judge(topics[given], bytearray(data), BEGIN + 1000 * MS, MessageSender(NODES.index("/a")))
    assert stops(monitors, 1010, 1200) == []


def test_the_time_while_a_guard_was_disabled_is_not_silence() -> None:
    guard = Guarded("deadman", resume=0)
    guard.drive(twist(0.5), 100, "/a")
    for enabled, at in ((False, 200), (True, 5000)):
        guard.advance(at)
        guard.monitors.switch({"guard": enabled}, BEGIN + at * MS)
    guard.drive(twist(), 5001, "/b")
    guard.got.clear()
    guard.advance(6000)
    assert guard.got == []


@pytest.mark.parametrize("enabled", [True, False])
def test_an_emergency_stop_knows_nothing_of_a_press_while_it_was_disabled(enabled: bool) -> None:
    guard = Guarded("estop", silent=0)
    guard.tell("stop", message("std_msgs/Bool"), 1)
    guard.monitors.switch({"guard": enabled}, BEGIN + 50 * MS)
    guard.tell("stop", message("std_msgs/Bool", data=True), 60)
    guard.monitors.switch({"guard": True}, BEGIN + 100 * MS)
    guard.drive(twist(), 110)
    assert (guard.drive(twist(0.5), 120)[0] == 0.5) is not enabled
