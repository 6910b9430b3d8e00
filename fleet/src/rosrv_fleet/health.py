"""Report the state of robots and of the collector without the database."""

import msgspec

from appliance.base import clock
from rosrv_fleet.collector import Collector
from rosrv_fleet.enrolment import Robot
from rosrv_fleet.segment_store import StoreFullError

_SECOND = 1e9
_MAX = 10_000
_MAX_MARKS = 1000


class RobotState(msgspec.Struct, frozen=True, kw_only=True):
    """A robot's newest segment (log, number, seconds since its arrival), and its problems.

    `heard_seconds` has the time since each appliance was heard. The robot is silent if one of them is, or `off` if one
    was shut down cleanly and none is silent. `gaps` and `forks` are counted up to 1,000.
    """

    name: str
    log: str | None = None
    number: int | None = None
    age_seconds: float | None = None
    certificate_seconds: float
    heard_seconds: dict[str, float | None]
    silent: bool
    off: bool
    gaps: int
    forks: int


class FleetHealth(msgspec.Struct, frozen=True, kw_only=True):
    """The state of all robots, of the index (`waiting`, `trouble`) and of the disk.

    `waiting` is the number of segments that are not indexed yet, up to 10,000. `trouble` and `disk` are reasons of
    failures.
    """

    robots: list[RobotState]
    waiting: int
    trouble: str | None
    disk: str | None


def health_of(collector: Collector) -> FleetHealth:
    store = collector.store
    marked = {
        kind: {robot: len(store.marks(kind, robot, _MAX_MARKS)) for robot in store.robots_with(kind)}
        for kind in ("gaps", "forks")
    }
    robots = [
        _state(collector, robot, marked["gaps"].get(robot.name, 0), marked["forks"].get(robot.name, 0))
        for robot in collector.robots.known().values()
        if robot.removed is None
    ]
    try:
        store.check_space()
        disk = None
    except StoreFullError as error:
        disk = error.strerror
    trouble = collector.indexer.trouble or collector.robots.trouble or collector.pruner.trouble
    return FleetHealth(robots=robots, waiting=store.waiting(_MAX), trouble=trouble, disk=disk)


def _state(collector: Collector, robot: Robot, gaps: int, forks: int) -> RobotState:
    newest = collector.store.newest(robot.name)
    now, monotonic = clock.wall(), clock.now()
    heard = {name: collector.presence.last(robot.name, name) for name in robot.connecting}
    off = collector.presence.off(robot)
    silent = any(
        monotonic - max(sign.now if sign else 0.0, collector.robots.accepted_since(one.fingerprint))
        > collector.config.silent_seconds
        for (name, one), sign in zip(robot.connecting.items(), heard.values(), strict=True)
        if name not in off
    )
    arrived, place = (None, None) if newest is None else newest
    return RobotState(
        name=robot.name,
        log=place and place.log,
        number=place and place.number,
        age_seconds=None if arrived is None else max(0.0, (collector.store.latest_ns() - arrived) / _SECOND),
        certificate_seconds=min(one.certificate_ends for one in robot.connecting.values()) - now,
        heard_seconds={name: max(0.0, now - sign.at) if sign else None for name, sign in heard.items()},
        silent=silent,
        off=bool(off) and not silent,
        gaps=gaps,
        forks=forks,
    )
