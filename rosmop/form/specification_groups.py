"""Group the specifications of a set that share topics, services or variables."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from rosmop.form import nodes
from rosmop.form.compiled import SpecificationCode, components
from rosmop.logics.interface import ClockedProperty, FiniteProperty


@dataclass(frozen=True)
class SpecificationGroup:
    """A component, with the indices of its specifications, properties with tables, and events on each channel.

    A property or event is a pair that begins with its specification. Topics of parametric specifications have
    no events here: the engine processes their messages.
    """

    component: nodes.Component
    specifications: Sequence[int]
    properties: tuple[tuple[int, int], ...]
    events: tuple[tuple[tuple[int, int], ...], ...]


def groups(specifications: Sequence[SpecificationCode]) -> Iterator[SpecificationGroup]:
    found = components([
        [
            specification.name,
            *specification.uses,
            *(event.channel for event in specification.events if event.channel is not None),
        ]
        for specification in specifications
    ])  # fmt: skip
    for numbers in found:
        yield _group(specifications, numbers)


def _group(specifications: Sequence[SpecificationCode], numbers: Sequence[int]) -> SpecificationGroup:
    variables: list[str] = []
    noted: list[str] = []
    properties: list[tuple[int, int]] = []
    topics: dict[str, list[tuple[int, int]]] = {}
    for number in numbers:
        specification = specifications[number]
        variables += specification.variables.values()
        variables += (given.code for given in specification.givens)
        noted += (name for comparison in specification.comparisons for name in comparison.variables)
        properties += [
            (number, index)
            for index, declared in enumerate(specification.properties)
            if isinstance(declared.property, FiniteProperty | ClockedProperty)
            and specification.slicing is None
        ]
        for index, event in enumerate(specification.events):
            if event.channel is not None:
                topics.setdefault(event.channel, []).append((number, index))
    rows = []
    topics = {
        topic: events
        for topic, events in topics.items()
        if all(specifications[number].slicing is None for number, _ in events)
    }
    for topic, events in topics.items():
        met = list(dict.fromkeys(number for number, _ in events))
        rows.append(
            (
                topic,
                tuple(
                    event_of(specifications, properties, number, index, met.index(number))
                    for number, index in events
                ),
            )
        )
    component = nodes.Component(tuple(variables), len(properties), tuple(rows), tuple(noted))
    return SpecificationGroup(
        component,
        numbers,
        tuple(properties),
        tuple(map(tuple, topics.values())),
    )


def event_of(
    specifications: Sequence[SpecificationCode],
    properties: Sequence[tuple[int, int]],
    number: int,
    index: int,
    place: int,
) -> nodes.Event:
    advances = []
    for property_index, code in enumerate(specifications[number].properties):
        compiled, handlers = code.property, set(code.order)
        if isinstance(compiled, FiniteProperty):
            automaton = compiled.automaton
            handled = tuple(
                nodes.HandledCategory(
                    category,
                    code.handlers[category],
                    frozenset(state for state, told in enumerate(automaton.verdicts) if category in told),
                )
                for category in code.order
            )
            table = tuple(row[index] for row in automaton.table)
            advances.append(
                nodes.Advance(
                    properties.index((number, property_index)),
                    table,
                    index,
                    None,
                    handled,
                    automaton.initial,
                    compiled.suppresses,
                )
            )
        elif isinstance(compiled, ClockedProperty):
            quiet = [handlers.isdisjoint(verdict) for verdict in compiled.verdicts]
            table, late = (
                tuple(
                    2 * state + anew if quiet[state] else -1 for state, anew in (row[index] for row in moves)
                )
                for moves in (compiled.moves, compiled.late)
            )
            clock = nodes.PropertyClock(
                late, compiled.within, tuple(-1 if wait is None else wait.after for wait in compiled.waits)
            )
            known = properties.index((number, property_index))
            advances.append(nodes.Advance(known, table, index, clock, suppresses=compiled.suppresses))
        else:
            advances.append(nodes.Advance(None, (-1,)))
    return nodes.Event(specifications[number].events[index].function, place, tuple(advances))
