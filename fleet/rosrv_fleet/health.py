"""Report the state of robots and of the collector, from the store alone."""

import time
from collections import Counter

import msgspec

from rosrv_fleet.collector import Collector
from rosrv_fleet.robots import Robot
from rosrv_fleet.segment_store import SegmentPlace, StoreFullError

_SECOND = 1e9
_MOST = 10_000


class RobotState(msgspec.Struct, frozen=True, kw_only=True):
    """A robot: its newest segment (log, number, seconds since it arrived; None: none yet), and what is wrong.

    `gaps` is the number of places where segments are missing; `forks` the number of segments with equal numbers.
    """

    name: str
    log: str | None = None
    number: int | None = None
    age_seconds: float | None = None
    silent: bool
    gaps: int
    forks: int


class FleetHealth(msgspec.Struct, frozen=True, kw_only=True):
    """The state of the collector.

    `waiting` is the number of stored segments that the index does not have yet, at most 10,000; `trouble` and `disk`
    say why indexing or storing is impossible, or are None.
    """

    robots: list[RobotState]
    waiting: int
    trouble: str | None
    disk: str | None


def health_of(collector: Collector) -> FleetHealth:
    """Return the present state. Raises `OSError` and `EnrolmentError`."""
    store = collector.store
    marks = {kind: Counter(place.robot for place in store.marked(kind, _MOST)) for kind in ("gaps", "forks")}
    robots = [
        _state(collector, robot, marks["gaps"][robot.name], marks["forks"][robot.name])
        for robot in collector.robots.all().values()
        if robot.removed is None
    ]
    try:
        store.check_space()
        disk = None
    except StoreFullError as error:
        disk = error.strerror
    waiting = len(store.marked("pending", _MOST))
    return FleetHealth(robots=robots, waiting=waiting, trouble=collector.indexer.trouble, disk=disk)


def _state(collector: Collector, robot: Robot, gaps: int, forks: int) -> RobotState:
    newest = _newest(collector, robot.name)
    now, silent_after = time.time_ns(), collector.config.silent_seconds
    if newest is None:
        since_added = (now - robot.added) / _SECOND
        return RobotState(name=robot.name, silent=since_added > silent_after, gaps=gaps, forks=forks)
    received, place = newest
    age = max(0.0, (now - received) / _SECOND)
    return RobotState(
        name=robot.name, log=place.log, number=place.number, age_seconds=age, silent=age > silent_after, gaps=gaps,
        forks=forks,
    )  # fmt: skip


def _newest(collector: Collector, robot: str) -> tuple[int, SegmentPlace] | None:
    heads = [collector.store.head(robot, log) for log in collector.store.logs(robot)]
    return max(((collector.store.received(one), one) for one in heads if one is not None), default=None)
