"""Play an act of `rosrv demo`: the operator makes mistakes that no policy can forbid, but monitors prevent.

The expected results depend on the simulated robot (`examples/landshark/nodes/physics.py`): it moves through
obstacles, and continues for half a second after its last command.
"""

from collections.abc import Sequence
from typing import Any, Protocol

from examples.landshark.results import Result
from examples.landshark.stage import Event, Stage

OBSTACLE = ("8", "0.5")  # the middle of the obstacle
OUTSIDE = ("24", "0.5")  # metres; the zone ends at 20
BACK = ("3", "0.5")
ASIDE = ("6", "6")
OUTSIDE_ASIDE = ("24", "6")
FAR_OUT = 23.0

Ways = dict[str, Sequence[Sequence[float]]]
"""The robot's paths in metres, `without` monitors and `guarded` by them."""


class Narrator(Protocol):
    """Prints the demonstration, and collects its results."""

    results: list[Result]

    def headline(self, text: str) -> None:
        """Begin an act."""

    def say(self, text: str) -> None:
        """Print a line of an act."""


class Mistakes:
    def __init__(self, stage: Stage, narrator: Narrator) -> None:
        self._stage, self._narrator = stage, narrator

    def run(self) -> Ways:
        self._narrator.headline(
            "The operator makes a mistake and fires while the gun points at the robot itself"
        )
        self._shoot_itself()
        self._narrator.headline("The operator drives at top speed without looking")
        return {"without": self._unguarded(), "guarded": self._guarded()}

    def _shoot_itself(self) -> None:
        self._stage.command("aim", "0", "-0.6")
        self._fires("without a monitor the robot hits itself", hit=True)
        self._enable("safeTrigger", "safe_triggering.rv")
        self._fires("with the monitor it does not hit itself", hit=False)
        self._recorded("message dropped", "safeTrigger", "the dropped trigger")
        self._stage.command("aim", "0", "0.2")
        self._fires("it still fires away from itself", hit=True)

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
        self._recorded("message changed", "obstacleAvoidance", "the speed set to 0")
        around = self._reach(ASIDE)
        self._result("it drives on after turning away", around["there"], _nearest(around))
        held = self._reach(OUTSIDE_ASIDE)
        self._result(
            "with the monitor it stops at the zone's border", held["farthest"] < FAR_OUT, _farthest(held)
        )
        self._recorded("message dropped", "safeZone", "the dropped command")
        return [*stopped["way"], *around["way"], *held["way"]]

    def _reach(self, place: tuple[str, str]) -> Event:
        return self._stage.command("reach", *place)

    def _enable(self, name: str, file: str) -> None:
        self._stage.order("monitor", "enable", name)
        self._narrator.say(f"rosrv monitor enable {name}  ({self._stage.monitors / file})")

    def _fires(self, what: str, *, hit: bool) -> None:
        """Pull the trigger. `hit` is whether a shot is expected."""
        fired = self._stage.command("fire")
        shots = fired["shots"] - fired["before"]
        self._result(what, shots == (1 if hit else 0), "1 shot" if shots == 1 else f"{shots} shots")

    def _recorded(self, event: str, monitor: str, what: str) -> None:
        record = self._stage.recorded(
            # the oldest record, which is not folded
            lambda found: next((one for one in reversed(found) if one["detail"]["monitor"] == monitor), None),
            "--event", event, "--limit", "100",
        )  # fmt: skip
        why = record["reason"] if record else "missing"
        self._narrator.say(f"audit record: {why}")
        self._narrator.results.append(Result(f"audit record: {what}", record is not None, why))

    def _result(self, what: str, good: bool, remark: str) -> None:
        self._narrator.results.append(Result(what, good, remark))
        self._narrator.say(f"{'' if good else 'NOT: '}{what}: {remark}")


def _nearest(drive: Event) -> str:
    metres = drive["to_obstacle"]
    return f"{-metres:.2f} m into it" if metres < 0 else f"{metres:.2f} m before it"


def _farthest(drive: Event) -> str:
    return f"{drive['farthest']:.1f} m from its start; 20 m are allowed"
