"""Worlds of two guards on one topic: the laws of the first hold, whatever the second one does to the commands.

The second guard has its evidence, and in a part of the worlds loses it for a while, so that it stops the base.
"""

import functools
import math
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from appliance.features.guards.presets import Guard, preset_named, text_of
from lab.closed_loop.guard_run import Beside
from lab.closed_loop.messages import (
    FIX,
    ODOMETRY,
    SCAN,
    battery,
    boolean,
    diagnostics,
    odometry,
    position,
    scan,
)
from lab.closed_loop.world import World
from tests.support.features.guards.running_guard import Change, Value

_FREE = scan(0, -math.pi, math.pi / 60, 0.05, 30, np.full(121, 25.0))
_STANDS = odometry(0, (0, 0, 0, 0, 0, 0, 1))
_FIXED = position(FIX, 0, 0, 0, 0)


@dataclass(frozen=True)
class Side:
    """The second guard: its values, its types, and its evidence by topic."""

    values: Mapping[str, Value] = field(default_factory=dict)
    types: Mapping[str, str] = field(default_factory=dict)
    evidence: Mapping[str, bytes] = field(default_factory=dict)
    once: Mapping[str, bytes] = field(default_factory=dict)
    """Messages that come once before."""


SIDES: Mapping[str, Side] = {
    "deadman": Side({"silent": 0.5}),
    "speed": Side({"vMax": 0.6}),
    "sane": Side(),
    "rate": Side({"interval": 0.05, "burst": 2}),
    "sensor": Side({"frozen": 0}, {"by": SCAN}, {"by": _FREE}),
    "separation": Side({}, {"by": SCAN}, {"by": _FREE}),
    "fence": Side({}, {"by": ODOMETRY}, {"by": _STANDS}),
    "zone": Side({"clear": 0}, {"by": SCAN}, {"by": _FREE}),
    "estop": Side({"silent": 0.3}, {}, {"stop": boolean(False)}),
    "hold_to_run": Side({}, {}, {"by": boolean(True)}, {"by": boolean(False)}),
    "mode": Side({"silent": 0.3}, {}, {"by": boolean(False)}),
    "diagnostics": Side({"silent": 0.3}, {}, {"by": diagnostics(0)}),
    "ready": Side({"silent": 0.3}, {}, {"by": battery(0.9)}),
    "agree": Side({"samples": 1}, {"by": ODOMETRY, "other": ODOMETRY}, {"other": _STANDS, "by": _STANDS}),
    "overspeed": Side({}, {"by": ODOMETRY}, {"by": _STANDS}),
    "standstill": Side({}, {"by": ODOMETRY}, {"by": _STANDS}),
}
TURNS_ASIDE = {"speed": ("fence",), "sane": ("fence",)}
"""Pairs without worlds: a fence limits x and y alone, and these worlds also command heights."""
WITHOUT = {
    "rate": "it may drop what the other guard would have stopped, so no motion of it has to pass",
    "joints": "no other preset works with its types and a simulated arm",
}
"""Worlds of one guard that have no pairs, each with the reason."""


@functools.lru_cache(maxsize=512)
def _text(preset: str, name: str, kind: str) -> str:
    side, chosen = SIDES[preset], preset_named(preset)
    topics = {
        topic: f"/side{default}" for topic, default in chosen.given_topics.items() if topic != "command"
    }
    in_text = {one: str(value) for one, value in side.values.items() if chosen.parameter(one).loads}
    return text_of(Guard(name, chosen, topics, {**side.types, "command": kind}, in_text))


def pair_factory(worlds: Mapping[str, type[World]]) -> Callable[..., World]:
    """Return a function that makes the world of a seed, with a guard of another preset beside its own."""
    firsts = [world for world in worlds if world not in WITHOUT]

    def make(seed: int, change: Change, trace: Callable[[str], None] | None) -> World:
        r = random.Random(f"pair {seed}")  # noqa: S311  a seed gives the same world again
        first = r.choice(firsts)
        second = r.choice([one for one in SIDES if one != first and one not in TURNS_ASIDE.get(first, ())])
        world = worlds[first](seed, change, trace)
        world.beside = _Accompanied(r, second, world)
        return world

    return make


class _Accompanied:
    """The second guard of a world, and the nodes that give it evidence."""

    def __init__(self, r: random.Random, preset: str, world: World) -> None:
        self._random, self._preset, self._world = r, preset, world
        self._name = r.choice(("early", "zz"))  # before or behind `guard`, unless the presets have phases
        self._lost = (0, 0)

    def begin(self) -> Beside:
        """Plan the evidence, and return the guard."""
        r, world, side = self._random, self._world, SIDES[self._preset]
        text = _text(self._preset, self._name, world.kind)
        if r.random() < 0.6:
            begin = r.randrange(300, 5000)
            self._lost = begin, begin + r.choice((700, 1500, 3000))
        for topic, data in side.once.items():
            world.after(1, lambda topic=topic, data=data: self._tell(topic, data))  # type: ignore[misc]  # bound now
        world.every(lambda: 50, self._say, first=2)
        loads = {parameter.name for parameter in preset_named(self._preset).parameters if parameter.loads}
        given = {name: value for name, value in side.values.items() if name not in loads}
        world.trace(
            f"beside it {self._name}: {self._preset}, without evidence from {self._lost[0]} to {self._lost[1]}"
        )
        return Beside(self._name, text, given, first=self._name < "guard")

    def _say(self) -> None:
        if not self._lost[0] <= self._world.now < self._lost[1]:
            for topic, data in SIDES[self._preset].evidence.items():
                self._tell(topic, data)

    def _tell(self, topic: str, data: bytes) -> None:
        self._world.tell_beside(f"/side{preset_named(self._preset).given_topics[topic]}", data)
