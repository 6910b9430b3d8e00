"""Few worlds of every preset, so that `make check` finds a fault in a preset before the gate does."""

import pytest

from lab.closed_loop.planted import no_guard, stops_everything
from lab.closed_loop.worlds import WORLDS, replay, run_one

SEEDS = {
    "deadman": (1, 3), "speed": (0, 6), "separation": (0, 14), "fence": (14,), "sensor": (7,), "estop": (4,),
    "ready": (0, 34), "agree": (0, 6), "mode": (0, 6), "overspeed": (0, 6), "standstill": (1, 2), "diagnostics": (0, 3),
    "zone": (0, 17), "joints": (3, 7, 12),
}  # fmt: skip
"""Worlds that find a guard that does nothing, and one that stops everything; 0 and 1 do so for the other presets.

`answer` and `withhold` have no world: `make check` runs their tests in `test_watching_presets.py`.
"""


@pytest.mark.complete
@pytest.mark.parametrize("preset", WORLDS)
def test_no_world_of_the_sample_breaks_a_law(preset: str) -> None:
    for seed in SEEDS.get(preset, (0, 1)):
        broken = run_one(preset, seed).violations
        assert not broken, f"{broken[0]}\n{replay(preset, seed)}"


@pytest.mark.parametrize("preset", WORLDS)
def test_the_sample_finds_a_guard_that_does_nothing_and_one_that_stops_everything(preset: str) -> None:
    """A rate drops commands, and never stops, so it has no honest motion to stop."""
    for change in (no_guard, stops_everything)[: 1 if preset == "rate" else 2]:
        assert any(run_one(preset, seed, change).violations for seed in SEEDS.get(preset, (0, 1)))
