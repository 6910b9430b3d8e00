"""A guard of a real scanner judges each message within the budget of a relay, on however slow or busy a machine.

The clock of processor time stands for such a machine: every look at it finds the time over. So a message has the
module's fuel and, in the interpreter, the instructions that it always has. The texts of the last release are in force
on robots after an upgrade, so the engine alone must let them judge.
"""

import itertools
from collections.abc import Callable

import pytest

from appliance.features.guards.presets import PRESETS, Guard, text_of
from appliance.features.guards.released import FOLDER, released
from rosmop.fast.abi import SetPart
from rosmop.run.engine import MonitorSet
from rosmop.run.outcomes import MessageSender, Outcome
from rosmop.tests.acting import message
from tests.support.features.guards.running_guard import on_its_module, part_of

RAYS = 1650
MS = 10**6
SCANNER, DRIVER, STRANGER = 1, 2, 3


def scan(rays: int = RAYS) -> bytes:
    return message(
        "sensor_msgs/LaserScan", angle_min=-3.14, angle_max=3.14, angle_increment=6.28 / (rays - 1), range_min=0.1,
        range_max=30.0, ranges=[5.0 + ray % 7 / 100 for ray in range(rays)],
    )  # fmt: skip


SCAN, HUGE = scan(), scan(20_000)
STILL, DRIVE = (message("geometry_msgs/Twist", linear__x=speed) for speed in (0.0, 0.1))


def texts() -> dict[str, str]:
    last = {
        name: max(int(path.stem.rpartition("-")[2]) for path in FOLDER.glob(f"{name}-*.rv"))
        for name in ("separation", "zone")
    }
    found = {f"released {name}": released(name, version).text for name, version in last.items()}
    return found | {name: text_of(Guard(name, PRESETS[name])) for name in last}


TEXTS = pytest.mark.parametrize("text", [pytest.param(text, id=name) for name, text in texts().items()])


class Robot:
    """A base under a guard: a scanner at 20 Hz, and a driver that stands at first and then drives."""

    def __init__(self, text: str, *others: str) -> None:
        self.part = part_of(text, *others)
        self.now = 0
        self.monitors = self.made(self.part)
        self.monitors.start(0)
        self.lost = 0
        self.faults: list[str] = []

    @staticmethod
    def made(part: SetPart) -> MonitorSet:
        monitors = on_its_module(part)
        monitors.limit_time(itertools.count().__next__, 0.010)
        monitors.name_senders(lambda source: (f"10.0.0.{source}", f"/node{source}"))
        return monitors

    @property
    def name(self) -> str:
        return self.monitors.names[0]

    def tell(self, topic: str, data: bytes, source: int) -> Outcome:
        outcome = self.monitors.judge(topic, bytearray(data), self.now, MessageSender(source))
        self.lost += outcome.result == "dropped"
        self.faults += [fault.text for fault in outcome.faults]
        return outcome

    def drives(self, *, scans: bool = True, milliseconds: int = 1000, data: bytes = SCAN) -> bool:
        """Whether the base moves at the end of this time."""
        moves = False
        for since in range(0, milliseconds, 50):
            self.now += 50 * MS
            self.monitors.advance(self.now)
            if scans:
                self.tell("/scan", data, SCANNER)
            outcome = self.tell("/cmd_vel", DRIVE if since > 700 else STILL, DRIVER)
            moves = outcome.result == "passed" and since > 700
        return moves

    def replaced(self, *, lost: bool) -> None:
        kept = [
            (one.names, one.layout, one.base(), one.cells() or None) for one in self.monitors.kept_groups()
        ]
        self.monitors = self.made(self.part)
        self.monitors.recover(
            [] if lost else kept, {"": "power cut"} if lost else {}, self.now, restarted=True
        )

    def reloaded(self) -> None:
        after = self.made(self.part)
        after.succeed(self.monitors, self.now)
        self.monitors = after

    def switched(self) -> None:
        for enabled in (False, True):
            self.now += 100 * MS
            self.monitors.switch({self.name: enabled}, self.now)

    def held(self) -> None:
        self.monitors.hold(self.monitors.monitor(self.name), "a person asks for it")
        assert not self.drives()
        self.monitors.resume(self.name)


ACTS: dict[str, Callable[[Robot], object]] = {
    "none": lambda _robot: None,
    "hold and resume": Robot.held,
    "resume without a hold": lambda robot: robot.monitors.resume(robot.name),
    "disable and enable": Robot.switched,
    "a restart of the relay": lambda robot: robot.replaced(lost=False),
    "a restart without its state": lambda robot: robot.replaced(lost=True),
    "a takeover by another set": Robot.reloaded,
    "a malformed message": lambda robot: robot.tell("/scan", b"\1\2\3", SCANNER),
    "silence": lambda robot: robot.drives(scans=False),
    "a message over the budget": lambda robot: robot.tell("/scan", HUGE, SCANNER),
}


@TEXTS
@pytest.mark.parametrize("act", ACTS.values(), ids=ACTS)
def test_motion_returns_within_a_second_after_each_act(text: str, act: Callable[[Robot], object]) -> None:
    robot = Robot(text)
    assert robot.drives()
    act(robot)
    robot.faults.clear()
    robot.lost = 0
    assert robot.drives()
    assert robot.faults == []
    assert robot.lost == 0


def test_a_guard_goes_on_with_the_last_scan_until_that_is_too_old() -> None:
    robot = Robot(texts()["released separation"])
    assert robot.drives()
    for _ in range(4):  # 200 ms: the last scan is not yet too old
        robot.now += 50 * MS
        robot.tell("/scan", HUGE, SCANNER)
        assert robot.tell("/cmd_vel", DRIVE, DRIVER).result == "passed"
    assert robot.lost == 0
    assert len(robot.faults) == 4
    assert f"{robot.name} goes on with what it knew before, until that is too old" in robot.faults[0]
    assert not robot.drives(data=HUGE)
    robot.faults.clear()
    assert robot.drives()
    assert robot.faults == []


def test_a_monitor_over_its_budget_blinds_no_other() -> None:
    costly = """costly() { int n = 0; event scan(std::vector<float> r) /scan sensor_msgs/LaserScan '{ranges:r}' {
        for (int i = 0; i < r.size(); i++) { for (int j = 0; j < 300; j++) { n = (n * 31 + j) % 1000003; } } } }"""
    for order in (0, 1):
        robot = Robot(*[texts()["released separation"], costly][:: 1 - 2 * order])
        assert robot.drives()
        assert robot.lost == 0
        assert len(robot.faults) == 20
        assert {one.name: one.faults for one in robot.monitors.monitors} == {"separation": 0, "costly": 20}
