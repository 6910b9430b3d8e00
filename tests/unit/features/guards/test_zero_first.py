"""A guard that waits for a zero of a node does not take the stop of another guard for it, wherever that comes from."""

import math
import re

import pytest

from appliance.features.guards.presets import PRESETS, Guard, text_of
from tests.unit.features.guards.guarding import BEGIN, MS, TWIST
from tests.unit.features.guards.test_preset_laws import Lab

WAITING = ("diagnostics", "hold_to_run", "estop", "mode", "overspeed", "standstill", "zone")
SAFE = f"safe {TWIST} {{ }} on command every 100ms;"
X = f"event drive(double x) command {TWIST} '{{linear.x:x}}'"
STOPPERS = {
    "replaces": f"{X} {{ STOP; }}",
    "limits": f"{X} {{ x = 0; }}",
    "publishes": f"int n = 0; {X} {{ return; }} event tick() every 20ms {{ STOP; }}",
}
BEFORE = sorted(
    name for name, preset in PRESETS.items()
    if TWIST in preset.topics.get("command", {}) and name not in {"rate", "speed"}
)  # fmt: skip
"""Presets that stop a node in phases of `judge`: without evidence, after a silence, or at NaN."""


def moves(lab: Lab, velocity: float) -> bool:
    """Let 50 ms pass, with evidence and a command, and return whether the command passes as a motion."""
    lab.step()
    for given in lab.kinds:
        if given != "command":
            lab.send(given)
    return lab.passes({"linear__x": velocity})


def judge(before: str, preset: str) -> None:
    """Judge a guard behind another one, with its evidence but without that of the other."""
    lab = Lab(preset, before=[before])
    for place in range(20):
        assert not moves(lab, 0.5 if place % 2 else math.nan)
    lab.monitors.switch({"before": False}, BEGIN + lab.at * MS)
    assert not any(moves(lab, 0.5) for _ in range(20)), (
        "the stop of the other guard counts as a zero of the node"
    )
    moves(lab, 0.0)
    assert moves(lab, 0.5), "after a zero of its own the node moves"


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
    heads = {name: preset.text.partition("\n\n")[0].replace("\n// ", " ") for name, preset in PRESETS.items()}
    speaks = re.compile(r"node (?:must )?commands? zero")
    assert {name for name, head in heads.items() if speaks.search(head)} == {*WAITING}
