"""Find the *guards*: specifications whose actions on messages depend on variables or properties.

A guard cannot judge if its state is lost, or if an event that keeps the state up to date faults.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from rosmop.form import nodes
from rosmop.form.compiled import Compiled, SpecificationCode
from rosmop.types import value_types


@dataclass(frozen=True, slots=True)
class Guards:
    """The guards; `depending` has, for each specification, the guards that depend on its state.

    A fault in the function of an event in `judging` only drops the event's own message, because the guards that
    depend on the event act on its topic alone: no subscriber saw the events that the state lacks. `observing` has
    the functions of the other events, if their specification only observes the topic.
    """

    names: frozenset[str]
    depending: Mapping[str, tuple[str, ...]]
    judging: frozenset[str]
    observing: frozenset[str]


def guards_of(compiled: Compiled) -> Guards:
    codes = {code.name: code for code in compiled.specifications}
    used = {name: set(_used(codes, name)) for name in codes}
    starts = {name for code in codes.values() for name in code.start}
    acts = {name for name, function in compiled.functions.items() if name not in starts and _acts(function)}
    changing = _changing(compiled, starts)
    acting = {compiled.functions[name].context for name in acts}
    names = [
        name
        for name, code in codes.items()
        if (code.context in acting or code.withholdings)
        and (
            code.properties
            or code.slicing is not None
            or any(not changing.isdisjoint(codes[other].variables.values()) for other in used[name])
        )
    ]
    depending = {name: tuple(guard for guard in names if name in used[guard]) for name in codes}
    places = {name: _places(codes[name], compiled, acts) for name in names}
    judging = {
        event.function
        for code in codes.values()
        for event in code.events
        if all(places[guard] <= {event.channel} for guard in depending[code.name])
    }
    observing = {
        event.function
        for name, code in codes.items()
        for event in code.events
        if depending[name] and event.channel not in (None, *code.acts_on)
    }
    return Guards(frozenset(names), depending, frozenset(judging), frozenset(observing - judging))


def _used(codes: Mapping[str, SpecificationCode], name: str) -> Iterator[str]:
    waiting, found = [name], set[str]()
    while waiting:
        name = waiting.pop()
        if name in codes and name not in found:
            found.add(name)
            yield name
            waiting += codes[name].uses


def _places(code: SpecificationCode, compiled: Compiled, acts: set[str]) -> set[str | None]:
    """Return the channels of the messages by which a guard acts, and None for a tick or deadline.

    A handler or a helper function may act by each message.
    """
    mine = {name for name in acts if compiled.functions[name].context == code.context}
    events = {event.function: event.channel for event in code.events}
    withheld = {withholding.topic for withholding in code.withholdings}
    if mine <= events.keys():
        return {events[name] for name in mine} | withheld
    timed = any(one.property.timed for one in code.properties)
    return {*events.values(), *withheld, *([None] if timed else [])}


def _acts(function: nodes.Function) -> bool:
    return any(
        isinstance(node, nodes.Drop | nodes.StopMessage | nodes.Publish)
        or (isinstance(node, nodes.WriteBack) and node.writes)
        for node in nodes.walk(function)
    )


def _changing(compiled: Compiled, starts: set[str]) -> set[str]:
    return {
        node.name
        for name, function in compiled.functions.items()
        if name not in starts
        for node in nodes.walk(function)
        if isinstance(node, nodes.Assign)
        or (  # the content of a vector or message may change in place
            isinstance(node, nodes.Read)
            and isinstance(node.type, value_types.VectorType | value_types.RecordType)
        )
    }
