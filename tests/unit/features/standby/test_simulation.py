import pytest

from tests.support.examples import examples
from tests.unit.features.standby.mutants import MUTANTS, product_of
from tests.unit.features.standby.simulation import History, Violation


@pytest.mark.parametrize("first", range(0, examples(600), 50))
def test_no_history_breaks_a_promise(first: int) -> None:
    for seed in range(first, first + 50):
        History(seed).run()


@pytest.mark.parametrize("slow", [0.3, 1.1])
@pytest.mark.parametrize("first", range(0, examples(120), 10))
def test_no_history_with_a_slow_firewall_breaks_a_promise(first: int, slow: float) -> None:
    for seed in range(first, first + 10):
        History(seed, slow=slow).run()


@pytest.mark.parametrize("name", MUTANTS)
def test_each_mutant_of_a_rule_is_found(name: str) -> None:
    mutant = MUTANTS[name]
    History(mutant.seed, faults=mutant.faults).run()
    with pytest.raises(Violation):
        History(mutant.seed, product_of(mutant), faults=mutant.faults).run()


def test_a_seed_gives_the_same_history_again() -> None:
    traces: list[list[str]] = [[], []]
    for trace in traces:
        History(7, on_event=trace.append).run()
    assert traces[0] == traces[1]
    assert {event.partition(" ")[0] for event in traces[0]} >= {"granted", "renewed", "active", "started"}
