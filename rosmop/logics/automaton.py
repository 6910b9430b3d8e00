"""Finite automata as tables: explore, minimise and walk them.

``verdicts[s]`` are the categories after a step *into* ``s``; those of the initial state count only if it is entered
again.
"""

from collections import deque
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import TypeVar

MAX_STATES = 10_000
MAX_TRANSITIONS = 500_000
"""Bounds the memory: minimising takes about 300 bytes for each transition."""

State = TypeVar("State", bound=Hashable)


class TooManyStatesError(Exception):
    """An automaton has too many states or transitions."""

    def __init__(self, limit: int, what: str = "states") -> None:
        super().__init__(f"more than {limit} {what}")
        self.limit = limit


@dataclass(frozen=True)
class Automaton:
    """A complete deterministic automaton with outputs. ``names`` are labels for people."""

    initial: int
    table: tuple[tuple[int, ...], ...]
    verdicts: tuple[tuple[str, ...], ...]
    names: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.table)

    def name(self, state: int) -> str:
        return self.names[state] if self.names else f"q{state}"


def explore(
    initial: State,
    letters: int,
    step: Callable[[State, int], State],
    verdict: Callable[[State], tuple[str, ...]],
    limit: int = MAX_STATES,
) -> Automaton:
    """Return the minimised automaton of all reachable states. Raises `TooManyStatesError`."""
    numbers: dict[State, int] = {initial: 0}
    states = [initial]
    table: list[tuple[int, ...]] = []
    for state in states:
        row = []
        for letter in range(letters):
            target = step(state, letter)
            number = numbers.get(target)
            if number is None:
                number = numbers[target] = len(states)
                states.append(target)
                if len(states) > limit:
                    raise TooManyStatesError(limit)
            row.append(number)
        table.append(tuple(row))
        if len(table) * letters > MAX_TRANSITIONS:
            raise TooManyStatesError(MAX_TRANSITIONS, "transitions")
    return minimise(Automaton(0, tuple(table), tuple(verdict(state) for state in states)))


def minimise(automaton: Automaton) -> Automaton:
    """Return the smallest automaton with the same verdicts on every trace, with states in order of discovery."""
    block_of = _coarsest_partition(automaton)
    numbers = {block_of[automaton.initial]: 0}
    order = [automaton.initial]
    table = []
    for state in order:
        row = []
        for target in automaton.table[state]:
            number = numbers.get(block_of[target])
            if number is None:
                number = numbers[block_of[target]] = len(order)
                order.append(target)
            row.append(number)
        table.append(tuple(row))
    return Automaton(0, tuple(table), tuple(automaton.verdicts[state] for state in order))


def _coarsest_partition(automaton: Automaton) -> list[int]:
    size, letters = len(automaton), len(automaton.table[0])
    sources: list[list[list[int]]] = [[[] for _ in range(size)] for _ in range(letters)]
    for state, row in enumerate(automaton.table):
        for letter, target in enumerate(row):
            sources[letter][target].append(state)
    by_verdict: dict[tuple[str, ...], set[int]] = {}
    for state, verdict in enumerate(automaton.verdicts):
        by_verdict.setdefault(verdict, set()).add(state)
    blocks = list(by_verdict.values())
    block_of = [0] * size
    for number, block in enumerate(blocks):
        for state in block:
            block_of[state] = number
    waiting = deque((number, letter) for number in range(len(blocks)) for letter in range(letters))
    queued = set(waiting)
    while waiting:
        splitter = waiting.popleft()
        queued.discard(splitter)
        number, letter = splitter
        touched: dict[int, list[int]] = {}
        for target in blocks[number]:
            for state in sources[letter][target]:
                touched.setdefault(block_of[state], []).append(state)
        for cut, members in touched.items():
            if len(members) < len(blocks[cut]):
                _split(blocks, block_of, cut, members)
                entries = _smaller_halves(blocks, cut, queued, letters)
                waiting.extend(entries)
                queued.update(entries)
    return block_of


def _smaller_halves(
    blocks: list[set[int]], cut: int, queued: set[tuple[int, int]], letters: int
) -> list[tuple[int, int]]:
    fresh = len(blocks) - 1
    small = fresh if len(blocks[fresh]) <= len(blocks[cut]) else cut
    return [(fresh if (cut, letter) in queued else small, letter) for letter in range(letters)]


def _split(blocks: list[set[int]], block_of: list[int], cut: int, members: list[int]) -> None:
    number = len(blocks)
    blocks[cut].difference_update(members)
    blocks.append(set(members))
    for state in members:
        block_of[state] = number


def reachable(automaton: Automaton) -> list[int]:
    """Return the states that a trace can enter, nearest first. The initial state must be entered again."""
    seen: dict[int, None] = {}
    frontier = [automaton.initial]
    while frontier:
        found: dict[int, None] = {}
        for state in frontier:
            found.update((target, None) for target in automaton.table[state] if target not in seen)
        seen.update(found)
        frontier = list(found)
    return list(seen)


def letter_classes(events: Sequence[str], named: Sequence[str]) -> tuple[list[int], list[int]]:
    """Group the events that a formula cannot distinguish: all events that it does not name form one class.

    Returns the class of each event and, for each class, its index in ``named`` (-1 for unnamed events).
    """
    position = {name: index for index, name in enumerate(named)}
    classes: dict[int, int] = {}
    of_event = [classes.setdefault(position.get(event, -1), len(classes)) for event in events]
    return of_event, list(classes)


def spread(automaton: Automaton, of_event: Sequence[int]) -> Automaton:
    table = tuple(tuple(row[letter] for letter in of_event) for row in automaton.table)
    return Automaton(automaton.initial, table, automaton.verdicts, automaton.names)
