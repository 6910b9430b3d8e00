"""A night of seven robots, or twenty: no alarm is false, no robot is called silent, and each fault has its alarm."""

import random
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from rosrv_fleet.verification import prove

from appliance.audit.proof.copies import signed_checkpoints
from tests.support.alert_rules import Alert
from tests.support.features.fleet.fleet_night import FleetNight, NightRobot

_EVENING = 1_800_036_000.0  # 18:00 UTC: the day changes in the night
_HOUR = 3600.0
_STEP = 120.0
_SLOT = 1200  # seconds of an event, with the time until all is as before
_YEARS = 3 * 365 * 86_400.0
_SILENT = "RosrvFleetRobotSilent"
_SEGMENT_BYTES = 1 << 20


@pytest.fixture
def night(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FleetNight:
    return FleetNight(tmp_path, monkeypatch, _EVENING)


class _Events:
    """The events of a healthy night in random order. None lasts as long as its alarm needs, nor meets another one."""

    def __init__(self, night: FleetNight, seed: int) -> None:
        self._night = night
        self._chance = random.Random(seed)  # noqa: S311  events, no secrets
        self._robots = list(night.robots.values())
        self._parked = self._robots.pop()
        slots = range(int(0.75 * _HOUR), int(11.5 * _HOUR), _SLOT)
        self._times = iter(self._chance.sample(slots, len(slots)))
        self._plan: list[tuple[float, Callable[[], None]]] = [
            (2 * _HOUR, self._parked.switch_off), (9 * _HOUR, self._parked.start),
        ]  # fmt: skip
        for act, most in (
            (self._restart, 3),
            (self._outage, 2),
            (self._outage_at_start, 1),
            (self._cut, 8),
            (self._cut_all, 2),
        ):
            for _event in range(most):
                act(self._time)
        for _event in range(3):
            one, other = self._chance.sample(self._robots, 2)
            self._plan += [(self._time, one.renew), (self._time, other.start)]
        for robot in self._robots[:5]:
            for _event in range(12):
                self._plan.append((self._chance.uniform(0.0, 11.5 * _HOUR), self._traffic(robot)))
        for seconds in (-90.0, 2 * _HOUR, -2 * _HOUR + 90.0):  # a time server corrects the collector
            self._plan.append((self._time, self._set_clock(seconds)))
        self._plan.sort(key=lambda event: event[0])

    def take(self, until: float) -> None:
        while self._plan and self._plan[0][0] <= until:
            self._plan.pop(0)[1]()

    @property
    def _time(self) -> float:
        return float(next(self._times))

    def _database(self, *, up: bool) -> Callable[[], None]:
        return lambda: setattr(self._night, "database_is_up", up)

    def _traffic(self, robot: NightRobot) -> Callable[[], None]:
        return lambda: robot.record(self._chance.randint(1, 20))

    def _set_clock(self, seconds: float) -> Callable[[], None]:
        def set_clock() -> None:
            self._night.clock.set_wall(self._night.clock.wall_ns() / 1e9 + seconds)
            self._night.pass_time(1)  # a scrape before the robots are due again

        return set_clock

    def _restart(self, at: float) -> None:
        down = self._chance.choice((0, 2 * _STEP))
        self._plan += [(at, self._night.stop_collector), (at + down, self._night.start_collector)]

    def _outage(self, at: float) -> None:
        self._plan += [(at, self._database(up=False)), (at + 2 * _STEP, self._database(up=True))]

    def _outage_at_start(self, at: float) -> None:
        """After a power failure the collector, whose retention works at once, starts before the database."""
        self._outage(at)
        self._plan += [(at, self._night.stop_collector), (at, self._night.start_collector)]

    def _cut(self, at: float) -> None:
        self._cut_these([self._chance.choice(self._robots)], at)

    def _cut_all(self, at: float) -> None:
        self._cut_these(self._robots, at)

    def _cut_these(self, robots: list[NightRobot], at: float) -> None:
        for when, cut in ((at, True), (at + 2 * _STEP, False)):
            for robot in robots:
                self._plan.append((when, lambda robot=robot, cut=cut: setattr(robot, "is_cut", cut)))  # type: ignore[misc]  # bound here


@pytest.mark.parametrize(
    ("seed", "robots"),
    [(1, 3), *(pytest.param(seed, 20, marks=pytest.mark.nightly) for seed in range(1, 12))],
)
def test_a_healthy_night_has_no_alarm(seed: int, robots: int, night: FleetNight) -> None:
    for number in range(robots):
        kept = 0.05 if number < 2 else None
        night.add_robot(f"arm{number:02}", kept_days=kept, ahead=number - 10.0).record(3)
    night.start_collector()
    events = _Events(night, seed)
    off = []
    while night.now < 12 * _HOUR:
        night.pass_time(_STEP)
        events.take(night.now)
        off += night.off()
    assert (night.fired, night.untrue) == ({}, [])
    assert set(off) == {f"arm{robots - 1:02}"}
    assert night.collector is not None
    parts = night.collector.parts
    for name, robot in night.robots.items():
        (proof,) = prove(parts.store, parts.robots.known()[name], _SEGMENT_BYTES)
        assert proof.ok
        assert proof.last == signed_checkpoints(robot.log.path, 0, 10_000)[-1].sequence
    assert night.indexed == sum(len(list(parts.store.segments(*log))) for log in _logs(night)) > 3 * robots


def _logs(night: FleetNight) -> Iterator[tuple[str, str]]:
    assert night.collector is not None
    store = night.collector.parts.store
    return ((name, log) for name in night.robots for log in store.logs(name))


def _lose_signing_key(robot: NightRobot) -> None:
    robot.signs = False
    robot.record(1)


def _lose_own_key(robot: NightRobot) -> None:
    robot.tls_key.unlink()
    robot.start()


def _set_clock_ahead(robot: NightRobot) -> None:
    robot.ahead = _YEARS
    robot.start()


def _edit_log(robot: NightRobot) -> None:
    robot.signs = False
    robot.record(3)
    robot.edit_log()
    robot.sign_again()


_FAULTS: dict[str, tuple[Callable[[NightRobot], None], str]] = {
    "cut": (lambda robot: setattr(robot, "is_cut", True), "takes more than 60 s"),
    "unplugged": (NightRobot.unplug, ""),
    "unsigned": (_lose_signing_key, ""),
    "keyless": (_lose_own_key, "^cannot be used: No such file or directory: .*robot.key"),
    "ahead": (_set_clock_ahead, "the clock of this machine shows 20[0-9-]+ .*: correct the clock"),
    "edited": (_edit_log, "record [0-9]+ does not follow record [0-9]+: changed, missing or moved"),
}


def test_each_fault_of_a_robot_has_its_alarm(night: FleetNight) -> None:
    """Ten minutes of silence, a minute until the next report was due, five of the alert, and a scrape."""
    for name in (*_FAULTS, "healthy"):
        night.add_robot(name).record(3)
    night.start_collector()
    for _minute in range(10):
        night.pass_time(60)
    for name, (fault, _reason) in _FAULTS.items():
        fault(night.robots[name])
    begun = night.now
    for _minute in range(20):
        night.pass_time(60)
    assert night.untrue == [(at, name) for at, name in night.untrue if name in _FAULTS]
    assert night.fired.keys() == {Alert(_SILENT, name) for name in _FAULTS}
    for alert, at in night.fired.items():
        assert 14 * 60 <= at - begun <= 17 * 60, alert
    for name, (_fault, reason) in _FAULTS.items():
        pusher = night.robots[name].pusher
        if pusher is not None:
            assert re.search(reason or "^$", pusher.progress.trouble)


def _fill_disk(night: FleetNight) -> None:
    night.start_collector(reserve_bytes=1 << 60)


@pytest.mark.parametrize(
    ("fault", "alert", "minutes"),
    [
        # Without segments, the database is checked every minute; the alert takes five, and a scrape.
        (lambda night: setattr(night, "database_is_up", False), "RosrvFleetIndexDown", 7),
        (FleetNight.stop_collector, "RosrvFleetDown", 6),
        (_fill_disk, "RosrvFleetDiskFull", 1),
    ],
    ids=["database", "collector", "disk"],
)
def test_each_fault_of_the_site_has_its_alarm(
    fault: Callable[[FleetNight], None], alert: str, minutes: int, night: FleetNight
) -> None:
    night.add_robot("arm7").record(3)
    night.start_collector()
    for _minute in range(10):
        night.pass_time(60)
    fault(night)
    begun = night.now
    for _minute in range(30):
        night.pass_time(60)
    assert night.fired.keys() == {Alert(alert)}
    assert night.fired[Alert(alert)] - begun <= 60 * minutes


@pytest.mark.parametrize("joined", ["before", "after"])
def test_removed_records_are_missed_even_before_the_first_receipt(joined: str, night: FleetNight) -> None:
    """Records that were removed before the robot joined are not missed."""
    robot = night.add_robot("arm7", kept_days=0.05)
    if joined == "after":
        robot.unplug()
    robot.record(3)
    for _quarter in range(8):
        night.pass_time(15 * 60)
        robot.record(3)
    robot.start()
    night.start_collector()
    night.pass_time(60)
    assert night.collector is not None
    parts = night.collector.parts
    (proof,) = prove(parts.store, parts.robots.known()["arm7"], _SEGMENT_BYTES)
    assert proof.ok
    assert proof.begins_after > 3
    assert robot.pusher is not None
    assert robot.pusher.progress.missed == (proof.begins_after if joined == "before" else 0)
