"""Play an act of `rosrv demo`: the operator's link is cut at full speed, and the base keeps driving.

`rosrv guard` makes three guards from presets: `deadman` stops the base, `speed` limits it, and `fence` keeps it
inside a square.
"""

import math
import time

from examples.landshark.mistakes import Narrator, Ways
from examples.landshark.picture import FENCE
from examples.landshark.results import Result
from examples.landshark.stage import Actor, Stage

COMMANDS = "/landshark_control/base_velocity"
TOP_SPEED, CAP = 2.0, 1.0  # metres a second
NORTH_WEST = math.pi - 0.5  # so that the paths are apart on the picture
WATCHED = 3.0  # seconds after the cut
RAN_AWAY, STOPPED = 4.0, 2.0  # metres after the cut: at least without a guard, at most with one


class Runaways:
    def __init__(self, stage: Stage, narrator: Narrator) -> None:
        self._stage, self._narrator = stage, narrator

    def run(self) -> Ways:
        self._narrator.headline(
            "The operator's link is cut at full speed, and the base has no timeout of its own"
        )
        for monitor in ("obstacleAvoidance", "safeZone"):
            self._stage.order("monitor", "disable", monitor)
        metres, without = self._cut(self._stage.start_runaway(NORTH_WEST))
        self._result("without a guard it drives on", metres > RAN_AWAY, f"{metres:.1f} m in {WATCHED:g} s")
        self._guard("deadman", "silent=0.5")
        base = self._stage.start_runaway(math.pi)
        metres, guarded = self._cut(base)
        self._result(
            "the guard deadman stops it", metres < STOPPED and _speed(base) == 0, f"after {metres:.1f} m"
        )
        self._recorded()
        self._guard("speed", f"vMax={CAP:g}")
        before = base.newest("moved")["x"]
        self._stage.command("drive", str(TOP_SPEED), "0", "2")
        went = before - base.newest("moved")["x"]
        self._result(
            "the guard speed limits it", 0.5 < went < 4.0 * CAP, f"{went:.1f} m at {CAP:g} m/s at most"
        )
        edge = f"{FENCE:g}"
        corners = f"-{edge},-{edge} {edge},-{edge} {edge},{edge} -{edge},{edge}"
        self._guard("fence", f"polygon={corners}", "--by", "/landshark/odom")
        self._stage.command("drive", str(TOP_SPEED), "0", "5")
        end = base.newest("moved")
        self._result(
            "the guard fence keeps it inside",
            -FENCE < end["x"] < 2 - FENCE,
            f"{FENCE + end['x']:.1f} m before the edge",
        )
        guarded.append((end["x"], end["y"]))
        return {"cut": without, "stopped": guarded}

    def _cut(self, base: Actor) -> tuple[float, list[tuple[float, float]]]:
        """Cut the link at full speed. Return the distance that the robot then drove, and its path."""
        base.expect("moved")
        plug = self._stage.cut_while_driving(TOP_SPEED)
        try:
            begin = base.newest("moved")
            end = begin
            until = time.monotonic() + WATCHED
            while time.monotonic() < until:
                end = base.newest("moved")
        finally:
            plug()
        metres = math.dist((begin["x"], begin["y"]), (end["x"], end["y"]))
        return metres, [(0.0, 0.0), (begin["x"], begin["y"]), (end["x"], end["y"])]

    def _guard(self, preset: str, value: str, *further: str) -> None:
        new = ("guard", "new", preset, COMMANDS, *further, "--shadow", value)
        self._stage.order(*new)
        self._stage.order("guard", "enforce", preset)
        shown = [f"'{word}'" if " " in word else word for word in new]
        self._narrator.say(f"rosrv {' '.join(shown)}; rosrv guard enforce {preset}")

    def _recorded(self) -> None:
        record = self._stage.recorded(
            lambda found: next((one for one in reversed(found) if one["detail"]["monitor"] == "deadman"), None),
            "--event", "stop begun", "--limit", "100",
        )  # fmt: skip
        why = record["reason"] if record else "missing"
        self._narrator.say(f"audit record: {why}")
        self._narrator.results.append(Result("audit record: the stop of the guard", record is not None, why))

    def _result(self, what: str, good: bool, remark: str) -> None:
        self._narrator.results.append(Result(what, good, remark))
        self._narrator.say(f"{'' if good else 'NOT: '}{what}: {remark}")


def _speed(base: Actor) -> float:
    return float(base.newest("moved")["speed"])
