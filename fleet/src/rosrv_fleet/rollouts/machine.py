"""Advance a rollout from ring to ring while its robots stay healthy, and otherwise stop it. No I/O, no clock.

1. A robot gets the bundle only if its ring is open, and no ring opens before its signed time.
2. The next ring opens only after enough robots of all open rings have had the bundle in force, and been healthy, for
   a time without interruption, and once one of its own robots reports: otherwise no robot could be judged. A ring
   whose robots have never reported opens as well.
3. If too many robots of an open ring are unhealthy, the rollout stops, and never continues.
4. Every selection is the bundle of the rollout, the one before it, or one that the robot has from an earlier rollout,
   which was stopped.
5. A robot that has left the group does not count, but a ring that has lost all its robots stops the rollout.
"""

from collections.abc import Collection, Mapping, Sequence
from typing import Literal

import msgspec

from appliance.base.counted import counted
from appliance.formats.terms import BundlePath, Terms

RolloutState = Literal["running", "stopped", "reverted", "done"]


class RobotSeen(msgspec.Struct, frozen=True):
    """The last report of a robot, which arrived at `seen` (seconds since the epoch), or 0 if it never reported."""

    seen: float = 0.0
    in_force: str = ""
    trying: str = ""
    refused: str = ""
    reason: str = ""
    changed: bool = False
    denials: int = 0
    failing: int = 0
    trouble: str = ""


class HealthGates(msgspec.Struct, frozen=True):
    """The conditions for a healthy ring (docs/fleet.md): shares of the ring's robots, and times in seconds."""

    share: float = 0.95
    tolerance: float = 0.05
    healthy_seconds: float = 600.0
    ring_seconds: float = 3600.0
    silent_seconds: float = 120.0
    denial_factor: float = 3.0
    least_denials: int = 10


class Baseline(msgspec.Struct, frozen=True):
    """A robot's numbers when its ring opened: denials a minute, and failing monitors."""

    denials: int
    failing: int


class OperatorAct(msgspec.Struct, frozen=True):
    """An act of an operator: its time in seconds since the epoch, and the name of the token."""

    at: float
    who: str
    act: Literal["start", "stop", "revert"]


class BundleRollout(msgspec.Struct, frozen=True):
    """A rollout of the bundle `path`, which replaces the bundle `before` (empty for none).

    The rings up to `ring` are open; it is -1 before the first one opens at `opened`. `healthy` is the time since
    which all open rings have had the bundle and been healthy. `baselines` has the robots that were not silent when
    their ring opened; of robots that were, only a refusal counts. `kept` has the bundles of earlier rollouts that were
    stopped: a robot that has one keeps it until its ring opens. It is unset in rollouts that an earlier release stored.
    """

    path: str
    before: str
    terms: Terms
    gates: HealthGates
    started: float
    state: RolloutState = "running"
    ring: int = -1
    opened: float = 0.0
    healthy: float | None = None
    baselines: dict[str, Baseline] = {}
    why: str = ""
    acts: list[OperatorAct] = []
    kept: list[str] | msgspec.UnsetType = msgspec.UNSET

    @property
    def bundle(self) -> BundlePath:
        return BundlePath.parse(self.path)


def ring_of(rollout: BundleRollout, robot: str) -> int:
    return rollout.terms.ring_of(robot, rollout.bundle)


def fault_of_rings(rollout: BundleRollout, robots: Collection[str]) -> str:
    place = f"{rollout.bundle.site}/{rollout.bundle.group}"
    for ring in rollout.terms.rings:
        unknown = [robot for robot in ring.robots if robot not in robots]
        if unknown:
            return (
                f"ring {ring.name} names {', '.join(unknown[:10])}, not enrolled in {place}: see rosrv-fleet robot"
                " list, and add the bundle again with the right names"
            )
    first = rollout.terms.rings[0]
    if not any(ring_of(rollout, robot) == 0 for robot in robots):
        known = counted(len(robots), "robot")
        return f"the first ring, {first.name}, has none of the {known} of {place}: name robots in it"
    return ""


def target(rollout: BundleRollout, robot: str, seen: RobotSeen | None) -> str:
    """Return the bundle that a robot should have, or "". After a stop, robots with the new one in force keep it.

    No robot moves back to `before` because the next rollout starts.
    """
    if rollout.state == "reverted":
        return rollout.before
    if rollout.state == "done":
        return rollout.path
    in_force = "" if seen is None else seen.in_force
    is_open = ring_of(rollout, robot) <= rollout.ring
    if is_open and (rollout.state == "running" or in_force == rollout.path):
        return rollout.path
    return in_force if in_force in kept_by(rollout) else rollout.before


def kept_by(rollout: BundleRollout) -> list[str]:
    return [] if rollout.kept is msgspec.UNSET else rollout.kept


def kept_after(rollout: BundleRollout) -> set[str]:
    """Return the bundles that robots keep when the next rollout starts."""
    return {*kept_by(rollout), rollout.path} if rollout.state == "stopped" else set()


def advance(rollout: BundleRollout, robots: Mapping[str, RobotSeen], now: float) -> BundleRollout:
    if rollout.state != "running":
        return rollout
    if rollout.ring < 0:
        return _open(rollout, robots, now)
    unhealthy_ring = _unhealthy_ring(rollout, robots, now)
    if unhealthy_ring:
        return _stop(rollout, unhealthy_ring)
    missing = _not_taken(rollout, robots)
    if missing:
        if now - rollout.opened > rollout.gates.ring_seconds:
            return _stop(rollout, f"{missing}, after {rollout.gates.ring_seconds:g} s")
        return msgspec.structs.replace(rollout, healthy=None, why=missing)
    return _healthy(rollout, robots, now)


def _healthy(rollout: BundleRollout, robots: Mapping[str, RobotSeen], now: float) -> BundleRollout:
    healthy = now if rollout.healthy is None else rollout.healthy
    since = msgspec.structs.replace(rollout, healthy=healthy, why="healthy")
    if now - healthy < rollout.gates.healthy_seconds:
        return since
    if rollout.ring + 1 == len(rollout.terms.rings):
        taken = sum(seen.in_force == rollout.path for seen in robots.values())
        missing = "" if taken == len(robots) else "; the others get it when they report"
        why = f"in force on {taken} of {counted(len(robots), 'robot')}{missing}"
        return msgspec.structs.replace(since, state="done", why=why)
    return _open(since, robots, now)


def stop(rollout: BundleRollout, why: str) -> BundleRollout:
    return _stop(rollout, why) if rollout.state == "running" else rollout


def revert(rollout: BundleRollout, why: str) -> BundleRollout:
    if rollout.state == "reverted":
        return rollout
    return msgspec.structs.replace(rollout, state="reverted", healthy=None, why=why)


def resume(rollout: BundleRollout, seconds: float) -> BundleRollout:
    """Start the times of all gates again after `seconds` in which the collector heard no robot."""
    if rollout.state != "running":
        return rollout
    why = f"the collector heard no robot for {seconds:.0f} s; the time of health begins again"
    opened = max(rollout.opened, rollout.started) + seconds
    return msgspec.structs.replace(rollout, opened=opened, healthy=None, why=why)


def rewound(rollout: BundleRollout, now: float) -> BundleRollout:
    """Begin the times of all gates at `now` at the latest: the clock was ahead, and has been corrected."""
    healthy = None if rollout.healthy is None else min(rollout.healthy, now)
    started, opened = min(rollout.started, now), min(rollout.opened, now)
    return msgspec.structs.replace(rollout, started=started, opened=opened, healthy=healthy)


def counts(rollout: BundleRollout, robots: Mapping[str, RobotSeen], now: float) -> list[dict[str, object]]:
    sick = unhealthy(rollout, robots, now)
    rows: list[dict[str, object]] = []
    for index, ring in enumerate(rollout.terms.rings):
        members = [robot for robot in robots if ring_of(rollout, robot) == index]
        rows.append(
            {
                "name": ring.name,
                "open": index <= rollout.ring,
                "robots": len(members),
                "in_force": sum(robots[robot].in_force == rollout.path for robot in members),
                "refused": sum(robots[robot].refused == rollout.path for robot in members),
                "unhealthy": sum(robot in sick for robot in members),
            }
        )
    return rows


def _open(rollout: BundleRollout, robots: Mapping[str, RobotSeen], now: float) -> BundleRollout:
    index = rollout.ring + 1
    earliest = rollout.terms.signed + rollout.terms.rings[index].after
    if now < earliest:
        why = f"ring {rollout.terms.rings[index].name} is signed to begin in {earliest - now:.0f} s"
        return msgspec.structs.replace(rollout, why=why)
    members = {robot: seen for robot, seen in robots.items() if ring_of(rollout, robot) == index}
    fresh = {
        robot: Baseline(seen.denials, seen.failing)
        for robot, seen in members.items()
        if now - seen.seen <= rollout.gates.silent_seconds
    }
    if not fresh and (index == 0 or any(seen.seen for seen in members.values())):
        why = f"ring {rollout.terms.rings[index].name} has no robot that reports"
        if index == 0 and now - max(rollout.started, rollout.opened, earliest) > rollout.gates.ring_seconds:
            return _stop(rollout, f"{why}, after {rollout.gates.ring_seconds:g} s")
        return msgspec.structs.replace(rollout, why=why)
    return msgspec.structs.replace(
        rollout,
        ring=index,
        opened=now,
        healthy=None,
        baselines=rollout.baselines | fresh,
        why=f"ring {rollout.terms.rings[index].name} is open",
    )


def unhealthy(rollout: BundleRollout, robots: Mapping[str, RobotSeen], now: float) -> dict[str, str]:
    found = {}
    for robot, seen in robots.items():
        why = _why(rollout, seen, rollout.baselines.get(robot), now) if _judged(rollout, robot, seen) else ""
        if why:
            found[robot] = why
    return found


def _members(rollout: BundleRollout, robots: Mapping[str, RobotSeen], index: int) -> list[str]:
    return [robot for robot in rollout.baselines if robot in robots and ring_of(rollout, robot) == index]


def _judged(rollout: BundleRollout, robot: str, seen: RobotSeen) -> bool:
    """Return whether a robot of an open ring was heard when its ring opened, or is heard since the last one opened."""
    late = seen.seen > rollout.opened and ring_of(rollout, robot) <= rollout.ring
    return late or robot in rollout.baselines


def _why(rollout: BundleRollout, seen: RobotSeen, baseline: Baseline | None, now: float) -> str:
    gates = rollout.gates
    if baseline is not None and now - seen.seen > gates.silent_seconds:
        return f"silent for {now - seen.seen:.0f} s"
    if seen.refused == rollout.path:
        return f"refused: {seen.reason[:200]}"
    if baseline is None or rollout.path not in (seen.in_force, seen.trying):
        return ""
    if seen.failing > baseline.failing:
        return f"{counted(seen.failing, 'monitor fails', 'monitors fail')}, {baseline.failing} before"
    if seen.denials >= max(gates.least_denials, gates.denial_factor * max(1, baseline.denials)):
        return f"{counted(seen.denials, 'denial')} a minute, {baseline.denials} before"
    return ""


def _unhealthy_ring(rollout: BundleRollout, robots: Mapping[str, RobotSeen], now: float) -> str:
    sick = unhealthy(rollout, robots, now)
    for index in range(rollout.ring + 1):
        members = _members(rollout, robots, index)
        if not members and any(ring_of(rollout, robot) == index for robot in rollout.baselines):
            return f"no robot of ring {rollout.terms.rings[index].name} is enrolled in the group any more"
        judged = [
            robot
            for robot, seen in robots.items()
            if ring_of(rollout, robot) == index and _judged(rollout, robot, seen)
        ]
        for all_of in (members, judged):  # robots that came later make the tolerance for the others no larger
            ill = [robot for robot in all_of if robot in sick]
            if len(ill) > rollout.gates.tolerance * len(all_of):
                return _why_sick(rollout, index, ill, len(all_of), sick[ill[0]])
    return ""


def _why_sick(rollout: BundleRollout, index: int, ill: Sequence[str], size: int, why: str) -> str:
    name = rollout.terms.rings[index].name
    are = "is" if len(ill) == 1 else "are"
    return f"{len(ill)} of {counted(size, 'robot')} of ring {name} {are} unhealthy, such as {ill[0]}: {why}"


def _not_taken(rollout: BundleRollout, robots: Mapping[str, RobotSeen]) -> str:
    for index in range(rollout.ring + 1):
        members = _members(rollout, robots, index)
        taken = sum(robots[robot].in_force == rollout.path for robot in members)
        if taken < rollout.gates.share * len(members):
            name = rollout.terms.rings[index].name
            have = "has" if taken == 1 else "have"
            return f"{taken} of {counted(len(members), 'robot')} of ring {name} {have} it in force"
    return ""


def _stop(rollout: BundleRollout, why: str) -> BundleRollout:
    return msgspec.structs.replace(rollout, state="stopped", healthy=None, why=why)
