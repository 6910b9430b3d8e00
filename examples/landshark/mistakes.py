"""The last act of `rosrv demo`: what a policy cannot forbid, for it is the operator who does it; monitors can.

Each mistake is made twice: without a monitor, and with the one that is meant for it, enabled while the robot runs.
The limits in which the results are good are those of the simulated robot: it moves through obstacles, and goes on
for half a second after its last command (`examples/landshark/nodes/physics.py`).
"""

from collections.abc import Sequence
from typing import Any, Protocol

from examples.landshark.results import Result
from examples.landshark.stage import Event, Stage

OBSTACLE = ("8", "0.5")  # the middle of it
OUTSIDE = ("24", "0.5")  # metres; the zone ends at 20
BACK = ("3", "0.5")
ASIDE = ("6", "6")
OUTSIDE_ASIDE = ("24", "6")
FAR_OUT = 23.0

Ways = dict[str, Sequence[Sequence[float]]]
"""Where the robot was, in metres: `without` and `guarded`."""


class Teller(Protocol):
    """Who shows the demonstration, and keeps its results."""

    results: list[Result]

    def headline(self, text: str) -> None:
        """Begin an act."""

    def say(self, text: str) -> None:
        """One line of an act."""


class Mistakes:
    """The operator's mistakes, one after the other."""

    def __init__(self, stage: Stage, teller: Teller) -> None:
        self._stage, self._teller = stage, teller

    def run(self) -> Ways:
        """All of them; the ways of the robot without and with monitors."""
        self._teller.headline(
            "The operator makes a mistake: he fires while the gun points at the robot itself"
        )
        self._shoot_itself()
        self._teller.headline("He drives at top speed, and does not look where")
        return {"without": self._unguarded(), "guarded": self._guarded()}

    def _shoot_itself(self) -> None:
        self._stage.command("aim", "0", "-0.6")
        self._fires("without a monitor the robot hits itself", hit=True)
        self._enable("safeTrigger", "safe_triggering.rv")
        self._fires("with the monitor it does not", hit=False)
        self._recorded("message dropped", "safeTrigger", "the dropped trigger")
        self._stage.command("aim", "0", "0.2")
        self._fires("away from the robot it still fires", hit=True)

    def _unguarded(self) -> list[Any]:
        hit, out = self._reach(OBSTACLE), self._reach(OUTSIDE)
        self._result("without a monitor it runs into the obstacle", hit["to_obstacle"] < 0, _nearest(hit))
        self._result("without a monitor it leaves its zone", out["farthest"] > FAR_OUT, _farthest(out))
        back = self._reach(BACK)
        return [*hit["way"], *out["way"], *back["way"]]

    def _guarded(self) -> list[Any]:
        self._enable("obstacleAvoidance", "obstacle_avoidance.rv")
        self._enable("safeZone", "safe_zone.rv")
        stopped = self._reach(OBSTACLE)
        good = stopped["to_obstacle"] > 0 and not stopped["there"]
        self._result("with the monitor it stops before the obstacle", good, _nearest(stopped))
        self._recorded("message changed", "obstacleAvoidance", "the speed that became 0")
        around = self._reach(ASIDE)
        self._result("turning away it goes on", around["there"], _nearest(around))
        held = self._reach(OUTSIDE_ASIDE)
        self._result("with the monitor it stays in its zone", held["farthest"] < FAR_OUT, _farthest(held))
        self._recorded("message dropped", "safeZone", "the command that drove on")
        return [*stopped["way"], *around["way"], *held["way"]]

    def _reach(self, place: tuple[str, str]) -> Event:
        return self._stage.command("reach", *place)

    def _enable(self, name: str, file: str) -> None:
        self._stage.enable_monitor(name)
        self._teller.say(f"rosrv monitor enable {name}  ({self._stage.monitors / file})")

    def _fires(self, what: str, *, hit: bool) -> None:
        """Pull the trigger; `hit`: a shot is to come."""
        fired = self._stage.command("fire")
        shots = fired["shots"] - fired["before"]
        self._result(what, shots == (1 if hit else 0), "1 shot" if shots == 1 else f"{shots} shots")

    def _recorded(self, event: str, monitor: str, what: str) -> None:
        """The record of what a monitor did."""
        found = self._stage.audit("--event", event, "--limit", "100")
        mine = [one for one in found if one["detail"]["monitor"] == monitor]
        why = mine[-1]["reason"] if mine else "missing"  # the first: it is in full
        self._teller.say(f"audit record: {why}")
        self._teller.results.append(Result(f"audit record: {what}", bool(mine), why))

    def _result(self, what: str, good: bool, remark: str) -> None:
        self._teller.results.append(Result(what, good, remark))
        self._teller.say(f"{'' if good else 'NOT: '}{what}: {remark}")


def _nearest(drive: Event) -> str:
    metres = drive["to_obstacle"]
    return f"{-metres:.2f} m into it" if metres < 0 else f"{metres:.2f} m before it"


def _farthest(drive: Event) -> str:
    return f"{drive['farthest']:.1f} m from its start, 20 m are allowed"
