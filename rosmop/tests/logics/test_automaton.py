from random import Random

import pytest

from rosmop.logics.automaton import Automaton, TooManyStatesError, explore, letter_classes, minimise
from rosmop.logics.ltl import strong_components
from rosmop.tests.logics.driving import seeded


def drawn(random: Random) -> Automaton:
    size, letters = random.randint(1, 9), random.randint(1, 3)
    table = [[random.randrange(size) for _ in range(letters)] for _ in range(size)]
    for state in range(1, size):
        table[random.randrange(state)][random.randrange(letters)] = state
    verdicts = tuple(random.choice([(), (), ("v",), ("w",)]) for _ in range(size))
    return Automaton(0, tuple(map(tuple, table)), verdicts)


def classes_by_refinement(automaton: Automaton) -> list[int]:
    known: list[object] = list(automaton.verdicts)
    while True:
        signatures = [(known[s], tuple(known[t] for t in row)) for s, row in enumerate(automaton.table)]
        numbers = {signature: number for number, signature in enumerate(dict.fromkeys(signatures))}
        refined = [numbers[signature] for signature in signatures]
        if len(set(refined)) == len(set(known)):
            return refined
        known = list(refined)


def reached(automaton: Automaton) -> set[int]:
    found = {automaton.initial}
    while fresh := {target for state in found for target in automaton.table[state]} - found:
        found |= fresh
    return found


def test_minimal_and_equivalent() -> None:
    random = seeded(18)
    for _ in range(1500):
        automaton = drawn(random)
        small = minimise(automaton)
        classes = classes_by_refinement(automaton)
        assert len(small) == len({classes[state] for state in reached(automaton)})
        for _ in range(5):
            mine = theirs = 0
            for _ in range(12):
                letter = random.randrange(len(automaton.table[0]))
                mine, theirs = automaton.table[mine][letter], small.table[theirs][letter]
                assert automaton.verdicts[mine] == small.verdicts[theirs]


def test_a_long_chain_is_minimised_in_time() -> None:
    size = 10_000
    table = tuple((min(state + 1, size - 1),) for state in range(size))
    verdicts = tuple(("v",) if state == size - 1 else () for state in range(size))
    assert len(minimise(Automaton(0, table, verdicts))) == size


def test_exploring_stops_at_the_limit() -> None:
    with pytest.raises(TooManyStatesError, match="more than 100 states"):
        explore(0, 1, lambda state, _: state + 1, lambda _: (), 100)


def test_events_that_are_not_named_are_one_class() -> None:
    assert letter_classes(("x", "a", "y", "b"), ("b", "a")) == ([0, 1, 0, 2], [-1, 1, 0])


def test_components_against_reachability() -> None:
    """Two nodes are in one component if and only if each leads to the other."""
    random = seeded(19)
    for _ in range(300):
        size = random.randint(1, 8)
        edges = {node: [n for n in range(size) if random.random() < 0.2] for node in range(size)}
        leads = {node: {node} for node in edges}
        for _ in range(size):
            leads = {node: {far for near in leads[node] for far in (near, *edges[near])} for node in edges}
        components = strong_components(edges, edges.__getitem__)
        place = {node: number for number, component in enumerate(components) for node in component}
        assert sorted(place) == list(range(size))
        for edge in edges:
            for other in edges:
                assert (place[edge] == place[other]) == (other in leads[edge] and edge in leads[other])
                assert other not in leads[edge] or place[other] <= place[edge]


def test_many_states_with_many_ways_out_are_refused() -> None:
    with pytest.raises(TooManyStatesError, match="more than 500000 transitions"):
        explore(0, 1000, lambda state, _letter: min(state + 1, 9_000), lambda _state: ())
