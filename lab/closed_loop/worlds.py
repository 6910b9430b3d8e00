"""The worlds by preset, the presets that no world can judge, and runs of many worlds."""

import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from lab.closed_loop.arms import JointsWorld
from lab.closed_loop.deadman import DeadmanWorld
from lab.closed_loop.estop import EstopWorld
from lab.closed_loop.evidence import AgreeWorld, ArmWorld, SensorWorld
from lab.closed_loop.limits import RateWorld, SaneWorld, SpeedWorld
from lab.closed_loop.measured import OverspeedWorld, StandstillWorld
from lab.closed_loop.motion import FenceWorld, SeparationWorld
from lab.closed_loop.pairs import SIDES, WITHOUT, pair_factory
from lab.closed_loop.people import DiagnosticsWorld, EnableWorld, ModeWorld
from lab.closed_loop.world import LAWS, Report, World
from lab.closed_loop.zones import ZoneWorld
from tests.support.features.guards.running_guard import Change, unchanged

WORLDS: dict[str, type[World]] = {
    one.preset: one
    for one in (
        DeadmanWorld, SpeedWorld, SeparationWorld, FenceWorld, SensorWorld, EstopWorld, ArmWorld, RateWorld, AgreeWorld,
        SaneWorld, EnableWorld, ModeWorld, OverspeedWorld, StandstillWorld, ZoneWorld, JointsWorld,
        DiagnosticsWorld,
    )
}  # fmt: skip

PAIRS = "pairs"
"""Stands for a preset where worlds have two guards, of presets that the seed chooses."""
_PAIRS = pair_factory(WORLDS)
IN_PAIRS = (WORLDS.keys() - WITHOUT.keys()) | SIDES.keys()
"""The presets that take part in pairs."""

NOT_MODELLED = {
    "answer": "it cancels goals of an action, whose server moves the robot; there is no velocity to follow",
    "withhold": "it keeps a topic from hosts, and commands no motion",
}
"""Presets without a world, each with the reason."""


EACH_NODE = {
    ("estop", "stop"): "each node is a button: worlds of `estop`",
    ("estop", "reset"): "each node is a hand: worlds of `estop`",
    ("hold_to_run", "by"): "each node is a device: worlds of `hold_to_run`",
    ("diagnostics", "by"): "the entries of each node count: worlds of `diagnostics`",
    ("mode", "by"): "each node says the mode: worlds of `mode`",
    (
        "withhold",
        "by",
    ): "each node is a switch: `test_the_topic_is_withheld_until_each_known_switch_has_spoken`",
    (
        "answer",
        "by",
    ): "a result of another node ends no deadline: `test_a_goal_without_a_result_is_cancelled`",
}
"""Topics that a preset observes without one source in a world, each with the reason."""


def run_one(
    preset: str,
    seed: int,
    change: Change = unchanged,
    trace: Callable[[str], None] | None = None,
    alone: str = "",
) -> Report:
    """Run a world; `alone` is the topic on which a second node publishes alone."""
    world = (_PAIRS if preset == PAIRS else WORLDS[preset])(seed, change, trace)
    world.alone = alone
    return world.run()


def planned_act(preset: str, seed: int) -> str:
    """Return what is to happen to the guard in a world, or an empty text; the world is planned, and not run."""
    world = WORLDS[preset](seed)
    world.plan()
    return world.planned_act


def replay(preset: str, seed: int, alone: str = "") -> str:
    return f"python -m lab.closed_loop --replay {preset} {seed}{alone and f' --alone {alone}'}"


def at_most(worlds: int) -> str:
    """Return the upper bound of the share that breaks a law if none of these worlds does, by the rule of three."""
    return f"at most {300 / worlds:.2g} % with 95 % confidence" if worlds >= 3 else "too few for a bound"


@dataclass
class Summary:
    """The worlds of one preset."""

    worlds: int = 0
    seconds: float = 0.0
    """Simulated seconds."""
    clearance: float = float("inf")
    """The smallest distance, in metres, of a moving base to what it moves towards, or to its fence."""
    cost: float = 0.0
    """Seconds of the processor."""
    acts: Counter[str] = field(default_factory=Counter)
    """Worlds by what happened to the guard; an empty text: nothing."""
    violations: Counter[str] = field(default_factory=Counter)
    """Worlds that broke a law, by law."""
    broken: list[tuple[int, str]] = field(default_factory=list)
    """The seeds of these worlds, with what happened."""
    honest: Counter[str] = field(default_factory=Counter)
    """Honest commands that were `sent` and that `passed`, where worlds count them."""

    def add(self, seed: int, report: Report) -> None:
        self.worlds += 1
        self.seconds += report.seconds
        self.acts[report.act] += 1
        self.honest += report.honest
        self.clearance = min(self.clearance, report.clearance)
        for violation in report.violations:
            self.violations[violation.law] += 1
            self.broken.append((seed, str(violation)))

    def join(self, other: "Summary") -> None:
        self.worlds += other.worlds
        self.seconds += other.seconds
        self.cost += other.cost
        self.clearance = min(self.clearance, other.clearance)
        self.acts += other.acts
        self.violations += other.violations
        self.broken += other.broken
        self.honest += other.honest

    def __str__(self) -> str:
        near = f", closest {self.clearance:.3f} m" if self.clearance < float("inf") else ""
        laws = ", ".join(f"{law} {self.violations[law]}" for law in LAWS if self.violations[law])
        honest = (
            f"; {self.honest['passed']} of {self.honest['sent']} honest commands passed"
            if self.honest
            else ""
        )
        return (
            f"{self.worlds} worlds, {self.seconds:.0f} simulated s, {self.cost:.1f} s{near}"
            f"{honest}; violations: {laws or f'none, {at_most(self.worlds)}'}"
        )


def run_many(preset: str, seeds: Iterable[int], change: Change = unchanged, alone: str = "") -> Summary:
    summary = Summary()
    began = time.process_time()
    for seed in seeds:
        summary.add(seed, run_one(preset, seed, change, alone=alone))
    summary.cost = time.process_time() - began
    return summary


def run_chunk(chunk: tuple[str, int, int]) -> tuple[str, Summary]:
    """Run the worlds of a preset from one seed to another, in a process of `python -m lab.closed_loop`."""
    preset, begin, end = chunk
    return preset, run_many(preset, range(begin, end))
