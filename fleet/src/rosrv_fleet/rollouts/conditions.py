"""Determine whether each robot of a group has the bundle that it should have. No I/O."""

import enum
from collections.abc import Collection, Mapping
from typing import NamedTuple

from rosrv_fleet.rollouts.machine import BundleRollout, HealthGates, RobotSeen, selected, unhealthy


class ConditionKind(enum.StrEnum):
    """The conditions of a robot, most severe first."""

    UNHEALTHY = "unhealthy"
    SILENT = "silent"
    NEVER_SEEN = "never seen"
    BEHIND = "behind"
    IN_FORCE = "in force"
    NO_BUNDLE = "no bundle"
    OFF = "off"


class RobotCondition(NamedTuple):
    """A robot's condition, with the reason if it needs one."""

    kind: ConditionKind
    why: str = ""


def conditions(
    rollout: BundleRollout | None, robots: Mapping[str, RobotSeen], now: float, off: Collection[str] = ()
) -> dict[str, RobotCondition]:
    """Return the condition of each robot. `rollout` is the group's last one; `off` robots are switched off.

    After a revert, reports about the reverted bundle no longer count.
    """
    sick = {} if rollout is None or rollout.state == "reverted" else unhealthy(rollout, robots, now)
    silent = (HealthGates() if rollout is None else rollout.gates).silent_seconds
    found = {}
    for robot, seen in robots.items():
        wanted = "" if rollout is None else selected(rollout, robot, seen)
        if not seen.seen:
            found[robot] = RobotCondition(ConditionKind.NEVER_SEEN, "it never reported")
        elif now - seen.seen > silent and robot in off:
            found[robot] = RobotCondition(ConditionKind.OFF, "it was shut down cleanly")
        elif now - seen.seen > silent:
            found[robot] = RobotCondition(ConditionKind.SILENT, f"no report for {now - seen.seen:.0f} s")
        elif robot in sick:
            found[robot] = RobotCondition(ConditionKind.UNHEALTHY, sick[robot])
        elif wanted and seen.refused == wanted:
            found[robot] = RobotCondition(ConditionKind.UNHEALTHY, f"refused: {seen.reason[:200]}")
        elif wanted and seen.in_force != wanted:
            found[robot] = RobotCondition(ConditionKind.BEHIND, seen.trouble[:200] or f"{wanted} is selected")
        else:
            found[robot] = _settled(seen)
    return found


def _settled(seen: RobotSeen) -> RobotCondition:
    if not seen.in_force:
        return RobotCondition(ConditionKind.NO_BUNDLE)
    return RobotCondition(
        ConditionKind.IN_FORCE, "changed by an operator on the robot" if seen.changed else ""
    )
