"""A guard of a real scanner judges each message within the budget of a relay, on however slow or busy a machine.

The clock of processor time stands for such a machine: every look at it finds the time over. So a message has the
module's fuel and, in the interpreter, the instructions that it always has. The texts of the last release are in force
on robots after an upgrade, so the engine alone must let them judge.
"""

import itertools
from collections.abc import Callable, Iterator
from functools import partial

import pytest

from appliance.features.guards.presets import PRESETS, Guard, text_of
from appliance.features.guards.released import released_preset
from rosmop.run.engine import MonitorSet
from rosmop.run.outcomes import MessageSender, Outcome
from rosmop.tests.acting import message
from tests.support.features.guards.running_guard import DEFINITIONS, on_its_module, part_of

Clock = Iterator[int]
RAYS = 1650
MS = 10**6
SCANNER, DRIVER = 1, 2


def scan(rays: int = RAYS) -> bytes:
    return message(
        "sensor_msgs/LaserScan", angle_min=-3.14, angle_max=3.14, angle_increment=6.28 / (rays - 1), range_min=0.1,
        range_max=30.0, ranges=[5.0 + ray % 7 / 100 for ray in range(rays)],
    )  # fmt: skip


SCAN, HUGE = scan(), scan(20_000)
STILL, DRIVE = (message("geometry_msgs/Twist", linear__x=speed) for speed in (0.0, 0.1))


def texts() -> dict[str, str]:
    of_0_4_0 = {"separation": 2, "zone": 1}
    found = {f"{name} {version}": released_preset(name, version).text for name, version in of_0_4_0.items()}
    return found | {name: text_of(Guard(name, PRESETS[name])) for name in of_0_4_0}


TEXTS = pytest.mark.parametrize("text", [pytest.param(text, id=name) for name, text in texts().items()])


def monitors_of(text: str, *others: str) -> MonitorSet:
    monitors = on_its_module(part_of(text, *others))
    monitors.limit_time(itertools.count().__next__, 0.010)
    monitors.name_senders(lambda source: (f"10.0.0.{source}", f"/node{source}"))
    return monitors


def begun(text: str, *others: str) -> tuple[MonitorSet, Clock]:
    monitors = monitors_of(text, *others)
    monitors.start(0)
    return monitors, itertools.count(50 * MS, 50 * MS)


def tell(monitors: MonitorSet, topic: str, data: bytes, now: int, source: int) -> Outcome:
    monitors.advance(now)
    return monitors.judge(topic, bytearray(data), now, MessageSender(source))


def drive(monitors: MonitorSet, clock: Clock, *, data: bytes = SCAN) -> list[Outcome]:
    """Return what becomes, in a second, of scans at 20 Hz and of commands, which are zero at first."""
    outcomes = []
    for number in range(20):
        now = next(clock)
        outcomes += [tell(monitors, "/scan", data, now, SCANNER)] if data else []
        outcomes.append(tell(monitors, "/cmd_vel", DRIVE if number > 14 else STILL, now, DRIVER))
    return outcomes


def moves(outcomes: list[Outcome]) -> bool:
    return outcomes[-1].result == "passed"


def hold(monitors: MonitorSet, clock: Clock, text: str) -> MonitorSet:
    monitors.hold(monitors.monitors[0], "a person asks for it")
    assert not moves(drive(monitors, clock))
    return resume(monitors, clock, text)


def resume(monitors: MonitorSet, _clock: Clock, _text: str) -> MonitorSet:
    monitors.resume(monitors.names[0])
    return monitors


def switch(monitors: MonitorSet, clock: Clock, _text: str) -> MonitorSet:
    for enabled in (False, True):
        monitors.switch({monitors.names[0]: enabled}, next(clock))
    return monitors


def load(monitors: MonitorSet, clock: Clock, text: str) -> MonitorSet:
    after = monitors_of(text)
    after.succeed(monitors, next(clock))
    return after


def restart(monitors: MonitorSet, clock: Clock, text: str, *, lost: bool) -> MonitorSet:
    kept = [(one.names, one.layout, one.base(), one.cells() or None) for one in monitors.kept_groups()]
    after = monitors_of(text)
    after.recover([] if lost else kept, {"": "power cut"} if lost else {}, next(clock), restarted=True)
    return after


def hear(monitors: MonitorSet, clock: Clock, _text: str, *, data: bytes) -> MonitorSet:
    tell(monitors, "/scan", data, next(clock), SCANNER)
    return monitors


def other_node(monitors: MonitorSet, clock: Clock, _text: str) -> MonitorSet:
    tell(monitors, "/scan", SCAN, next(clock), DRIVER)
    assert not moves(drive(monitors, clock))  # while the message is not older than a second
    return monitors


def silence(monitors: MonitorSet, clock: Clock, _text: str) -> MonitorSet:
    assert not moves(drive(monitors, clock, data=b""))
    return monitors


ACTS: dict[str, Callable[[MonitorSet, Clock, str], MonitorSet]] = {
    "none": lambda monitors, _clock, _text: monitors,
    "hold and resume": hold,
    "resume without a hold": resume,
    "disable and enable": switch,
    "a restart of the relay": partial(restart, lost=False),
    "a restart without its state": partial(restart, lost=True),
    "a takeover by another set": load,
    "a malformed message": partial(hear, data=b"\1\2\3"),
    "a message over the budget": partial(hear, data=HUGE),
    "another node": other_node,
    "silence": silence,
}


@TEXTS
@pytest.mark.parametrize("act", ACTS.values(), ids=ACTS)
def test_motion_returns_within_a_second_after_each_act(
    text: str, act: Callable[[MonitorSet, Clock, str], MonitorSet]
) -> None:
    monitors, clock = begun(text)
    assert moves(drive(monitors, clock))
    outcomes = drive(act(monitors, clock, text), clock)
    assert moves(outcomes)
    assert not any(outcome.faults or outcome.result == "dropped" for outcome in outcomes)


def test_a_guard_goes_on_with_the_last_scan_until_that_is_too_old() -> None:
    monitors, clock = begun(released_preset("separation", 2).text)
    assert moves(drive(monitors, clock))
    for _ in range(4):  # 200 ms: the last scan is not yet too old
        outcome = tell(monitors, "/scan", HUGE, now := next(clock), SCANNER)
        assert outcome.result == "passed"
        assert "separation goes on with what it knew before, until that is too old" in outcome.faults[0].text
        assert tell(monitors, "/cmd_vel", DRIVE, now, DRIVER).result == "passed"
    assert not moves(drive(monitors, clock, data=HUGE))
    assert moves(drive(monitors, clock))


def test_a_monitor_over_its_budget_blinds_no_other() -> None:
    costly = """costly() { int n = 0; event scan(std::vector<float> r) /scan sensor_msgs/LaserScan '{ranges:r}' {
        for (int i = 0; i < r.size(); i++) { for (int j = 0; j < 300; j++) { n = (n * 31 + j) % 1000003; } } } }"""
    texts_of_both = [released_preset("separation", 2).text, costly]
    for order in (texts_of_both, texts_of_both[::-1]):
        monitors, clock = begun(*order)
        outcomes = drive(monitors, clock)
        assert moves(outcomes)
        assert not any(outcome.result == "dropped" for outcome in outcomes)
        assert {one.name: one.faults for one in monitors.monitors} == {"separation": 0, "costly": 20}


JOINTS = [f"joint_{number}" for number in range(7)]
POINTS = [
    {
        "positions": [0.001 * point] * 7,
        "velocities": [0.01] * 7,
        "accelerations": [0.1] * 7,
        "time_from_start": {"sec": point + 1, "nanosec": 0},
    }
    for point in range(50)
]
LARGEST = {
    "sensor_msgs/LaserScan": SCAN,
    "sensor_msgs/JointState": message("sensor_msgs/JointState", name=JOINTS, position=[0.0] * 7),
    "trajectory_msgs/JointTrajectory": message(
        "trajectory_msgs/JointTrajectory", joint_names=JOINTS, points=POINTS
    ),
    "sensor_msgs/Image": message(
        "sensor_msgs/Image", height=480, width=640, step=1920, data=[7] * (480 * 1920)
    ),
}
"""The largest honest messages; those of other types are small."""


@pytest.mark.parametrize("name", PRESETS)
def test_the_largest_honest_messages_of_a_preset_are_within_the_budget(name: str) -> None:
    monitors, clock = begun(text_of(Guard(name, PRESETS[name])))
    assert monitors.topics
    for _ in range(4):
        now = next(clock)
        outcomes = monitors.advance(now)
        for number, (topic, kind) in enumerate(monitors.topics.items(), 1):
            data = LARGEST.get(kind) or bytes(DEFINITIONS.layout(kind).minimum)
            outcomes.append(tell(monitors, topic, data, now, number))
        assert not any(outcome.faults for outcome in outcomes)
