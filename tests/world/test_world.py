import pytest

from tests.support.examples import seeds_of_night
from tests.world.mutants import MUTANTS, NOT_SEEN, PAIR_MUTANTS, first_broken
from tests.world.pair import PairWorld
from tests.world.unable import REASONS, UnableWorld
from tests.world.world import World, run

_AT_GATE, _PAIRS_AT_GATE = 25, 5
_AT_NIGHT, _PAIRS_AT_NIGHT = 1500, 250
_IN_ONE_CASE = 5


@pytest.mark.parametrize("first", range(0, _AT_GATE, _IN_ONE_CASE))
def test_no_history_of_an_appliance_breaks_a_promise(first: int) -> None:
    _run(range(first, first + _IN_ONE_CASE), World, "")


@pytest.mark.parametrize("first", range(0, _PAIRS_AT_GATE, _IN_ONE_CASE))
def test_no_history_of_two_appliances_breaks_a_promise(first: int) -> None:
    _run(range(first, first + _IN_ONE_CASE), PairWorld, "--pair ")


@pytest.mark.nightly
@pytest.mark.parametrize("case", range(_AT_NIGHT // _IN_ONE_CASE))
def test_no_history_of_a_night_breaks_a_promise(case: int) -> None:
    _run(seeds_of_night(_AT_NIGHT)[case * _IN_ONE_CASE :][:_IN_ONE_CASE], World, "")


@pytest.mark.nightly
@pytest.mark.parametrize("case", range(_PAIRS_AT_NIGHT // _IN_ONE_CASE))
def test_no_history_of_two_appliances_of_a_night_breaks_a_promise(case: int) -> None:
    _run(seeds_of_night(_PAIRS_AT_NIGHT)[case * _IN_ONE_CASE :][:_IN_ONE_CASE], PairWorld, "--pair ")


@pytest.mark.nightly
@pytest.mark.timeout(600)
@pytest.mark.parametrize("reason", REASONS)
def test_two_appliances_that_cannot_serve_pass_the_lease_at_most_twice_in_ten_minutes(reason: str) -> None:
    run(1, kind=type(reason, (UnableWorld,), {"reason": reason}))


def _run(seeds: range, kind: type[World], option: str) -> None:
    for seed in seeds:
        try:
            run(seed, kind=kind)
        except AssertionError as error:
            error.add_note(f"replay it with: python -m tests.world {option}--seed {seed}")
            raise


@pytest.mark.parametrize("kind", [World, PairWorld])
def test_a_seed_gives_the_same_history_again(kind: type[World]) -> None:
    traces: list[list[str]] = [[], []]
    for trace in traces:
        run(7, trace.append, kind)
    assert traces[0] == traces[1]
    assert len(traces[0]) > 10


def test_each_fault_has_its_place() -> None:
    """A night finds faults; this finds at the gate that a name has changed."""
    places = (MUTANTS | PAIR_MUTANTS).items()
    assert [fault for fault, (place, name, _other) in places if not hasattr(place, name)] == []


@pytest.mark.nightly
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("fault", sorted((MUTANTS.keys() | PAIR_MUTANTS.keys()) - NOT_SEEN))
def test_each_fault_of_the_product_is_found(fault: str) -> None:
    assert first_broken(fault, range(500)) is not None
