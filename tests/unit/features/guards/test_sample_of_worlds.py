"""Few worlds of every preset, so that `make check` finds a fault in a preset before the gate does."""

import pytest

from lab.closed_loop.worlds import WORLDS, replay, run_one

SEEDS = {
    "deadman": (0, 3), "separation": (0, 14), "fence": (14,), "sensor": (7,), "estop": (4,), "agree": (2,),
    "mode": (0, 6), "zone": (0, 17), "joints": (3, 7, 12),
}  # fmt: skip
"""Worlds that find a guard that does nothing, and one that stops everything; 0 and 1 do so for the other presets."""


@pytest.mark.complete
@pytest.mark.parametrize("preset", WORLDS)
def test_no_world_of_the_sample_breaks_a_law(preset: str) -> None:
    for seed in SEEDS.get(preset, (0, 1)):
        broken = run_one(preset, seed).violations
        assert not broken, f"{broken[0]}\n{replay(preset, seed)}"
