import math
import re
from itertools import pairwise, product

import pytest

from appliance.features.guards.presets import DRIVER_CHECK, Guard, text_of
from rosmop.run.outcomes import Outcome
from rosmop.tests.acting import message
from rosmop.tests.examples import examples
from tests.unit.features.guards.guarding import Guarded, legs_of, seeded, twist
from tests.unit.features.guards.test_presets import compiled

GO, STOP = twist(0.2), twist()
LIMIT = 2000


def odometry(v: float, turn: float = 0.0) -> bytes:
    return message("nav_msgs/Odometry", twist__twist__linear__x=v, twist__twist__angular__z=turn)


class Drive(Guarded):
    def __init__(self, timeout: float = math.inf) -> None:
        self.lines: list[tuple[str, float]] = []
        self.passing: list[tuple[int, bytes]] = []
        self.at, self.timeout = 0, timeout
        super().__init__("driver_check")

    def run(
        self, until: int, command: bytes | None = GO, v: float | None = None, *, odom: bool = True
    ) -> None:
        while self.at < until:
            self.at += 50
            if command is not None:
                self.tell("command", command, self.at)
            if odom:
                self.tell("by", odometry(self.speed if v is None else v), self.at)

    @property
    def speed(self) -> float:
        at, data = self.got[-1] if self.got else (0, STOP)
        return legs_of(data)[0] if self.at - at <= self.timeout else 0.0

    def longest_gap(self) -> int:
        return max(b - a for a, b in pairwise([0, *(at for at, _data in self.got), self.at]))

    def receive(self, outcome: Outcome, at: int) -> None:
        super().receive(outcome, at)
        for line in outcome.log:
            match = re.fullmatch(r"driver check: (\w+) after ([\d.]+) s", line.text)
            assert match, line.text
            self.lines.append((match[1], float(match[2])))


@pytest.mark.parametrize("timeout", [120, 480, 1500])
def test_a_driver_with_a_timeout_is_measured(timeout: int) -> None:
    base = Drive(timeout)
    base.run(6000)
    [(outcome, seconds)] = base.lines
    assert outcome == "stopped" and timeout / 1000 < seconds <= timeout / 1000 + 0.05
    assert base.longest_gap() <= timeout + 50 + 200 + 60


def test_a_driver_without_a_timeout_is_stopped_by_the_monitor() -> None:
    base = Drive()
    base.run(6000)
    [(outcome, seconds)] = base.lines
    assert outcome == "moving" and 2 < seconds <= 2.02
    [stopped] = [at for at, data in base.got if data == STOP and at > 0]
    assert base.longest_gap() <= LIMIT + 20
    assert [data for at, data in base.got if at > stopped] == [GO] * sum(
        at >= stopped for at in range(50, 6001, 50)
    )


@pytest.mark.parametrize(
    ("command", "v"),
    [(None, 0.2), (STOP, 0.2), (GO, 0.0), (GO, 0.31), (GO, math.nan), (GO, -0.5)],
    ids=["no command", "stops", "it stands", "too fast", "no number", "too fast backwards"],
)
def test_nothing_is_withheld_unless_commands_drive_the_base_slowly(command: bytes | None, v: float) -> None:
    base = Drive()
    base.run(31_000, command, v)
    assert [outcome for outcome, _seconds in base.lines] == ["idle"]
    assert len(base.got) == (0 if command is None else 620)


def test_a_stop_passes_and_ends_the_measurement() -> None:
    base = Drive()
    base.run(1500)
    base.run(1550, STOP)
    assert base.got[-1] == (1550, STOP) and [outcome for outcome, _seconds in base.lines] == ["ended"]
    base.run(5000)
    assert base.longest_gap() < 1000 and len(base.lines) == 1


def test_a_silent_odometry_ends_the_measurement_with_a_stop() -> None:
    base = Drive()
    base.run(1200)
    base.run(4000, odom=False)
    assert [outcome for outcome, _seconds in base.lines] == ["silent"]
    assert base.longest_gap() <= 720 and STOP in {data for at, data in base.got if at > 100}


def test_a_node_that_falls_silent_during_the_measurement_does_not_disturb_it() -> None:
    base = Drive(480)
    base.run(1300)
    base.run(4000, None)
    assert [outcome for outcome, _seconds in base.lines] == ["stopped"]


def test_any_trace_withholds_for_a_bounded_time_and_no_stop() -> None:
    random = seeded(11)
    for _trace in range(examples(200)):
        base = Drive(random.choice((100, 700, math.inf)))
        for _part in range(random.randrange(1, 6)):
            command = random.choice((GO, GO, GO, STOP, twist(math.nan)))
            v = random.choice((None, None, None, 0.0, math.nan, 0.2, 1.0))
            until = base.at + random.choice((50, 400, 1200, 2500))
            first = len(base.got)
            base.run(until, command, v, odom=random.random() < 0.8)
            if command == STOP:
                assert sum(data == STOP for _at, data in base.got[first:]) >= 1
        assert base.longest_gap() <= LIMIT + 60
        assert len(base.lines) <= 1


@pytest.mark.parametrize("kinds", [*product(*DRIVER_CHECK.topics.values())])
def test_the_monitor_is_valid_for_each_type(kinds: tuple[str, ...]) -> None:
    types = dict(zip(DRIVER_CHECK.topics, kinds, strict=True))
    compiled(text_of(Guard("driver_check", DRIVER_CHECK, types=types)))
