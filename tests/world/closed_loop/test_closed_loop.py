import pytest

from appliance.features.guards.presets import PRESETS
from tests.support.examples import ALL
from tests.world.closed_loop.planted import FAULTS, WITHIN, no_guard, stops_everything
from tests.world.closed_loop.worlds import NOT_MODELLED, PAIRS, WORLDS, replay, run_many, run_one

AT_GATE = {"separation": 10, "fence": 10, "zone": 6}
"""Worlds at the gate of presets whose worlds cost 0.1 to 0.2 s; the others cost 5 to 40 ms, and have 15."""
AT_NIGHT = {"separation": 2500, "fence": 2500, "zone": 1500, PAIRS: 1500}


def judge(preset: str, first: int, worlds: int) -> None:
    summary = run_many(preset, range(first, first + worlds))
    found = [f"{text}\n    {replay(preset, seed)}" for seed, text in summary.broken]
    assert not found, f"{len(found)} of {worlds} worlds of {preset} break a law:\n" + "\n".join(found[:5])


@pytest.mark.timeout(300)
@pytest.mark.parametrize("preset", WORLDS)
def test_no_world_breaks_a_law(preset: str) -> None:
    judge(preset, 0, AT_GATE.get(preset, 15))


@pytest.mark.nightly
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("preset", [*WORLDS, PAIRS])
def test_no_world_of_a_night_breaks_a_law(preset: str) -> None:
    judge(preset, 10_000, AT_NIGHT.get(preset, 4000))


def test_every_preset_has_a_world_or_a_reason() -> None:
    assert WORLDS.keys() | NOT_MODELLED.keys() == PRESETS.keys()
    assert not WORLDS.keys() & NOT_MODELLED.keys()


LAWS_OF = {
    "deadman": {"L3", "L4", "L6"}, "speed": {"L1", "L2"}, "separation": {"L1", "L2", "L3"}, "fence": {"L2", "L3"},
    "sensor": {"L2"}, "estop": {"L2", "L3", "L4"}, "arm": {"L2"}, "rate": {"L3"}, "agree": {"L2"},
    "sane": {"L1", "L2"}, "enable": {"L2", "L6"}, "mode": {"L2", "L6"},
    "overspeed": {"L3", "L6"}, "standstill": {"L2", "L6"}, "zone": {"L2", "L3", "L6"},
    "joints": {"L1", "L2", "L3"},
}  # fmt: skip


@pytest.mark.parametrize("preset", WORLDS)
def test_a_guard_that_does_nothing_breaks_each_law_of_its_preset(preset: str) -> None:
    summary, first = run_many(preset, range(20), no_guard), 20
    while not LAWS_OF[preset] <= summary.violations.keys() and first < 200:
        summary.join(run_many(preset, range(first, first + 20), no_guard))
        first += 20
    assert LAWS_OF[preset] <= summary.violations.keys(), str(summary)


@pytest.mark.parametrize("preset", sorted(WORLDS.keys() - {"rate"}))
def test_a_guard_that_stops_everything_is_found(preset: str) -> None:
    """A rate drops commands, and never stops, so it has no honest motion to stop."""
    found = (run_one(preset, seed, stops_everything).violations for seed in range(100))
    assert any(one.law == "live" for violations in found for one in violations)


@pytest.mark.parametrize("preset", WORLDS)
def test_a_seed_gives_the_same_world_again(preset: str) -> None:
    traces: list[list[str]] = [[], []]
    for trace in traces:
        for seed in range(4):
            run_one(preset, seed, trace=trace.append)
    assert traces[0] == traces[1] and len(traces[0]) > 10


@pytest.mark.nightly
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("name", FAULTS)
def test_each_planted_fault_is_found(name: str) -> None:
    assert FAULTS[name].first(10 * WITHIN if ALL else WITHIN) is not None
