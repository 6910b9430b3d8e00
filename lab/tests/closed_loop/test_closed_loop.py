import re

import pytest

from appliance.features.guards.presets import PRESETS
from lab.closed_loop.guard_run import RunningGuard, parameters_of
from lab.closed_loop.messages import STILL, TWIST, boolean, command, legs_of, straight
from lab.closed_loop.planted import FAULTS, TERMS, WITHIN, no_guard, stops_everything
from lab.closed_loop.senders import HONEST, KINDS
from lab.closed_loop.world import ACTS, COMMAND
from lab.closed_loop.worlds import (
    EACH_NODE,
    NOT_MODELLED,
    PAIRS,
    WORLDS,
    planned_act,
    replay,
    run_many,
    run_one,
)
from tests.support.examples import ALL, seeds_of_night
from tests.support.features.guards.running_guard import Value, named
from tests.support.rows import require_rows

AT_GATE = {"zone": 3, "joints": len(KINDS)}
"""Worlds at the gate of presets whose worlds cost 0.2 s or more, of `joints` one of each sender. The others cost 5 to
100 ms, and have 6."""
AT_NIGHT = {"separation": 500, "fence": 500, "zone": 500, PAIRS: 300}


def judge(preset: str, seeds: range, alone: str = "") -> None:
    summary = run_many(preset, seeds, alone=alone)
    broken = [f"{text}\n    {replay(preset, seed, alone)}" for seed, text in summary.broken]
    assert not broken, f"{len(broken)} of {len(seeds)} worlds of {preset} break a law:\n" + "\n".join(
        broken[:5]
    )
    sent, passed = summary.honest["sent"], summary.honest["passed"]
    assert passed >= 0.999 * sent, f"of {sent} honest commands {passed} pass"


@pytest.mark.parametrize("preset", WORLDS)
def test_no_world_breaks_a_law(preset: str) -> None:
    judge(preset, range(AT_GATE.get(preset, 6)))


@pytest.mark.nightly
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("preset", [*WORLDS, PAIRS])
def test_no_world_of_a_night_breaks_a_law(preset: str) -> None:
    judge(preset, seeds_of_night(AT_NIGHT.get(preset, 1000)))


def test_a_base_that_executes_a_command_late_is_not_judged_by_the_time_without_its_guard() -> None:
    """It got a motion while its guard was disabled, and still stands when the guard is enabled."""
    judge("separation", range(700_081, 700_082))


@pytest.mark.complete
def test_every_preset_has_a_world_or_a_reason() -> None:
    where = "WORLDS of lab/closed_loop/worlds.py, or to NOT_MODELLED there with the reason"
    require_rows(PRESETS, WORLDS.keys() | NOT_MODELLED.keys(), where)
    assert not WORLDS.keys() & NOT_MODELLED.keys()


def _text(value: Value) -> str:
    try:
        return f"{float(value):g}"
    except ValueError:
        return str(value)


@pytest.mark.parametrize("preset", WORLDS)
def test_each_act_and_another_value_of_each_parameter_happen_in_the_worlds_of_each_preset(
    preset: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A world is only planned here, not run, so its guard is not compiled."""
    kind, chosen = WORLDS[preset], set[tuple[str, str]]()
    monkeypatch.setattr(
        kind,
        "guard_with",
        lambda _world, values, *_types: chosen.update(
            (name, _text(value)) for name, value in values.items() if name in parameters_of(preset)
        ),
    )
    planned = {planned_act(preset, seed) for seed in range(400)}
    parameters = PRESETS[preset].parameters
    varied = {name for name, text in chosen if text != _text(PRESETS[preset].parameter(name).default)}
    assert {parameter.name for parameter in parameters} - varied == set()
    observes = PRESETS[preset].given_topics.keys() - {COMMAND}
    assert planned - {""} == set(ACTS) - kind.not_yet.keys() - (set() if observes else {"cut"})
    assert all(kind.not_yet.values())


ALONE = [
    (preset, topic)
    for preset, world in WORLDS.items()
    if world.one_source
    for topic in (*world.one_source, COMMAND)
]
"""The topics on which a second node publishes, while the source of one of them fails in most worlds."""


@pytest.mark.parametrize(("preset", "topic"), ALONE)
def test_a_second_publisher_alone_moves_nothing(preset: str, topic: str) -> None:
    judge(preset, range(50_000, 50_200 if ALL else 50_003), topic)


def test_each_observed_topic_has_one_source_and_a_second_publisher_or_each_node_counts() -> None:
    observed = {
        (name, topic)
        for name, preset in PRESETS.items()
        for topic in preset.given_topics.keys() - {COMMAND, "cancel"}
    }
    with_one = {one for one in ALONE if one[1] != COMMAND}
    assert with_one | EACH_NODE.keys() == observed and not with_one & EACH_NODE.keys()


def _takes_any_node(text: str) -> str:
    """Let a guard take each node for the source of a topic, and see no other node beside it."""
    taken, heard = re.subn(r'when \((\w+) == "" \|\| caller\(\w+\) == \1\)', "", text)
    foreign = r"(event foreign\w*\(\) \w+(?: \S+\s+'\{\}')?\s+)when \("
    unseen, others = re.subn(foreign, r"\1when (false && ", taken)
    assert heard and others
    return unseen


@pytest.mark.parametrize(("preset", "topic"), [one for one in ALONE if one[1] != COMMAND])
def test_a_guard_that_takes_any_node_for_its_source_is_found(preset: str, topic: str) -> None:
    found = (run_one(preset, seed, _takes_any_node, alone=topic).violations for seed in range(100))
    assert any(violation.law == "L4" for violations in found for violation in violations)


LAWS_OF = {
    "deadman": {"L3", "L4", "L6"}, "speed": {"L1", "L2"}, "separation": {"L1", "L2", "L3"}, "fence": {"L2", "L3"},
    "sensor": {"L2"}, "estop": {"L2", "L3", "L4"}, "ready": {"L2"}, "rate": {"L3"}, "agree": {"L2"},
    "sane": {"L1", "L2"}, "hold_to_run": {"L2", "L6"}, "diagnostics": {"L2", "L6"}, "mode": {"L2", "L6"},
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


@pytest.mark.parametrize("sender", [one for one in KINDS if one not in HONEST])
def test_each_hostile_sender_is_found_without_a_guard_and_without_luck(sender: str) -> None:
    """In one of its first two worlds without a margin, so that a term that a preset lacks is also found."""
    first = KINDS.index(sender)
    assert run_many("joints", range(first, 4 * len(KINDS), 2 * len(KINDS)), no_guard).broken


@pytest.mark.parametrize("preset", sorted(WORLDS.keys() - {"rate"}))
def test_a_guard_that_stops_everything_is_found(preset: str) -> None:
    """A rate drops commands, and never stops, so it has no honest motion to stop."""
    found = (run_one(preset, seed, stops_everything).violations for seed in range(100))
    assert any(violation.law == "live" for violations in found for violation in violations)


@pytest.mark.parametrize("preset", WORLDS)
def test_a_seed_gives_the_same_world_again(preset: str) -> None:
    traces: list[list[str]] = [[], []]
    for trace in traces:
        for seed in range(4 if ALL else 3):
            run_one(preset, seed, trace=trace.append)
    assert traces[0] == traces[1] and len(traces[0]) > 10


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.nightly] if at >= 4 else []) for at, name in enumerate(TERMS)],
)
def test_a_forgotten_term_is_found_in_the_first_worlds(name: str) -> None:
    assert FAULTS[name].first(4) is not None


def test_each_planted_fault_changes_its_preset() -> None:
    for fault in FAULTS.values():
        text = named(fault.preset).text
        assert fault.patch or fault.change(text) != text


@pytest.mark.nightly
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("name", FAULTS)
def test_each_planted_fault_is_found(name: str) -> None:
    assert FAULTS[name].first(10 * WITHIN if ALL else WITHIN) is not None


@pytest.mark.parametrize("forget", [0, 7])
@pytest.mark.parametrize("preset", ["estop", "mode"])
def test_a_press_counts_from_the_first_millisecond(preset: str, forget: int) -> None:
    """A press before the first tick is not forgotten with what was known before."""
    guard = RunningGuard(preset, {"command": TWIST}, {"silent": 0.0, "publishers": 0, "forget": forget})
    source = guard.topics["stop" if preset == "estop" else "by"]

    def tell(topic: str, data: bytes, at: int, node: int) -> bytes | None:
        list(guard.advance(at))
        return guard.tell(topic, data, at, node)[0]

    tell(source, boolean(True), 5, 3)
    tell(source, boolean(False), 500, 4)
    if preset == "estop":
        for at, pressed in ((700, False), (1000, True), (1200, False)):
            tell(guard.topics["reset"], boolean(pressed), at, 5)
    tell(guard.topics["command"], command(TWIST, STILL, 1500), 1500, 1)
    passed = tell(guard.topics["command"], command(TWIST, straight(2.0), 1600), 1600, 1)
    assert passed is None or max(map(abs, legs_of(TWIST, passed))) <= 0.25
