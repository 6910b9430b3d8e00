"""A guard that waits for a zero of a node does not take the stop of another guard for it, wherever that comes from."""

import math
import re

import pytest

from appliance.features.guards.presets import PRESETS, Guard, text_of
from rosmop.run.outcomes import MessageSender
from rosmop.tests.acting import message
from tests.support.features.guards.running_guard import on_its_module, part_of
from tests.unit.features.guards.guarding import BEGIN, MS, NODES, TWIST, legs_of, twist
from tests.unit.features.guards.test_preset_laws import EVIDENCE, RECIPES

WAITING = ("enable", "estop", "mode", "overspeed", "standstill", "zone")
SAFE = f"safe {TWIST} {{ }} on command every 100ms;"
X = f"event drive(double x) command {TWIST} '{{linear.x:x}}'"
STOPPERS = {
    "replaces": f"{X} {{ STOP; }}",
    "limits": f"{X} {{ x = 0; }}",
    "publishes": f"int n = 0; {X} {{ return; }} event tick() every 20ms {{ STOP; }}",
}
BEFORE = sorted(
    name for name, one in PRESETS.items()
    if TWIST in one.topics.get("command", {}) and name not in {"rate", "speed"}
)  # fmt: skip
"""Presets that stop a node in phases of `Pair`: without evidence, after a silence, or at NaN."""


class Pair:
    """A guard behind another one, with its evidence but without that of the other."""

    def __init__(self, before: str, preset: str) -> None:
        recipe = RECIPES[preset]
        kinds = {topic: next(iter(rows)) for topic, rows in PRESETS[preset].topics.items()}
        values = {name: str(value).lower() for name, value in recipe.values.items()}
        text = text_of(Guard("waiting", PRESETS[preset], types=kinds, values=values))
        self.monitors = on_its_module(part_of(before, text))
        self.monitors.name_senders(lambda source: ("10.0.0.1", NODES[source]))
        self.topics, self.at, self.count = PRESETS[preset].given_topics, 0, 0
        self.kinds = {**kinds, **recipe.fixed}
        self.recipe = recipe
        self.monitors.start(BEGIN - 100 * MS)
        for given, kind in self.kinds.items():
            if kind in recipe.first:
                self._send(given, message(kind, **recipe.first[kind]))

    def _send(self, given: str, data: bytes) -> bytes:
        now, sender = BEGIN + self.at * MS, MessageSender(NODES.index("/a"))
        outcome = self.monitors.judge(self.topics[given], bytearray(data), now, sender)
        assert not outcome.faults
        return b"" if outcome.result == "dropped" else bytes(outcome.buffer)

    def moves(self, *legs: float) -> bool:
        """Let 50 ms pass, with evidence and a command, and return whether the command passes as a motion."""
        self.at, self.count = self.at + 50, self.count + 1
        self.monitors.advance(BEGIN + self.at * MS)
        for given, kind in self.kinds.items():
            if given != "command":
                good = {**EVIDENCE[kind](self.count), **self.recipe.typed.get(kind, {})}
                self._send(given, message(kind, **{**good, **self.recipe.evidence.get(given, {})}))
        got = self._send("command", twist(*legs))
        return bool(got) and legs_of(got) != (0,) * 6


def judge(before: str, preset: str) -> None:
    pair = Pair(before, preset)
    for place in range(20):
        assert not pair.moves(0.5 if place % 2 else math.nan)
    pair.monitors.switch({"before": False}, BEGIN + pair.at * MS)
    assert not any(pair.moves(0.5) for _ in range(20)), (
        "the stop of the other guard counts as a zero of the node"
    )
    for legs in ((0.0,), (0.5,)):
        moves = pair.moves(*legs)
    assert moves, "after a zero of its own the node moves"


@pytest.mark.parametrize("preset", WAITING)
@pytest.mark.parametrize("stopper", STOPPERS)
def test_a_stop_by_another_monitor_is_not_a_zero_of_the_node(stopper: str, preset: str) -> None:
    judge(f"before() given {{ topic command = /cmd_vel; }} {{ {SAFE} {STOPPERS[stopper]} }}", preset)


@pytest.mark.nightly
@pytest.mark.parametrize("preset", WAITING)
@pytest.mark.parametrize("first", BEFORE)
def test_a_stop_by_another_guard_is_not_a_zero_of_the_node(first: str, preset: str) -> None:
    before = PRESETS[first]
    types = {topic: next(iter(rows)) for topic, rows in before.topics.items()}
    silent = {
        topic: f"/other{default}" for topic, default in before.given_topics.items() if topic != "command"
    }
    judge(text_of(Guard("before", before, topics=silent, types=types)), preset)


def test_every_preset_that_speaks_of_a_zero_is_among_them() -> None:
    heads = {name: one.text.partition("\n\n")[0].replace("\n// ", " ") for name, one in PRESETS.items()}
    speaks = re.compile(r"node (?:must )?commands? zero")
    assert {name for name, head in heads.items() if speaks.search(head)} == {*WAITING}
