"""The state of monitors as data that outlives their process: written group by group, read back under limits.

A group is the specifications that share topics or variables, so a message changes the state of one group at most. What
is kept of a monitor is all that decides what it does with the next message: variables, runs of properties, timers,
whether it holds its topics. Not kept is what only explains: the events before a verdict, and when output that is
throttled was last put out.

The state of a group whose variables are numbers is kept as the bytes that the module has in its memory (`CellNames`
says what they are): that is what the common path costs. Times are those of the caller's clock, which the next process
goes on with.
"""

import hashlib
import struct
from collections.abc import Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Any

import msgspec

from rosmop.form import nodes
from rosmop.form.compiled import Compiled
from rosmop.run.monitor import CellNames, Monitor
from rosmop.run.state_of_runs import StateTooLargeError, kept, run_of
from rosmop.run.state_of_slices import KeptPart, KeptSlice, restore_slices
from rosmop.runtime.values import Values
from rosmop.types import value_types
from rosmop.types.value_types import Type

MOST_BYTES = 64 << 10
"""Bytes of a group's state, without slices. It is written with each batch that changes it."""

_CLOCK = struct.Struct("<qq")


class KeptTimer(msgspec.Struct, frozen=True, array_like=True):
    """An event that happens every so often: when its next tick is due."""

    due: int | None
    ticked: bool


class KeptMonitor(msgspec.Struct, frozen=True, array_like=True):
    """A monitor's state; `identity` and `types` say of which text, and of which definitions of messages."""

    name: str
    identity: bytes
    types: bytes
    enabled: bool
    seen: bool
    broken: bool
    faults: int
    held: bool
    why_held: str
    timers: list[KeptTimer]
    runs: list[Any]
    variables: dict[str, Any]
    first: tuple[list[Any], list[Any]] = ([], [])
    """Of a parametric specification the values of its parameters, and its slices' own variables, as slices begin."""


def encoded(states: Sequence[KeptMonitor]) -> bytes:
    """The state of a group as bytes. Raises `StateTooLargeError`."""
    data = msgspec.msgpack.encode(states)
    if len(data) > MOST_BYTES:
        raise StateTooLargeError(f"its state has {len(data)} bytes; {MOST_BYTES} are kept")
    return data


def refused(why: str) -> bytes:
    """What is written in the place of a state that is not kept."""
    return msgspec.msgpack.encode(why)


KeptGroup = tuple[Sequence[str], bytes, bytes, bytes | None]
"""What was written of a group: the names of its monitors, what its cells are (`CellNames` as MessagePack), their state
(`encoded`, `refused`), and the cells of the module if these are later.
"""


def states_of(
    groups: Sequence[KeptGroup],
) -> tuple[dict[str, KeptMonitor], dict[str, list[KeptSlice]], dict[str, str]]:
    """The states that were kept, of a monitor that is in several the last, their slices, and why others are lost."""
    found: dict[str, KeptMonitor] = {}
    slices: dict[str, list[KeptSlice]] = {}
    lost: dict[str, str] = {}
    for group in groups:
        try:
            states = _decoded(group)
        except (msgspec.MsgspecError, ValueError, struct.error, LookupError, TypeError) as error:
            states = f"its state cannot be read: {error}"
        if isinstance(states, KeptPart):
            slices.setdefault(group[0][0], []).extend(states.slices)
            continue
        for name in group[0]:
            if isinstance(states, list):
                slices[name] = []
            found.pop(name, None)
            lost[name] = states if isinstance(states, str) else "its state was not written"
        found |= {state.name: state for state in states if isinstance(state, KeptMonitor)}
    return found, slices, {name: why for name, why in lost.items() if name not in found}


_DECODER: msgspec.msgpack.Decoder[list[KeptMonitor] | KeptPart | str] = msgspec.msgpack.Decoder(
    list[KeptMonitor] | KeptPart | str
)
_NAMES = msgspec.msgpack.Decoder(CellNames | None)


def _decoded(group: KeptGroup) -> list[KeptMonitor] | KeptPart | str:
    _, names_of, base, cells = group
    states, names = _DECODER.decode(base), _NAMES.decode(names_of)
    if not isinstance(states, list) or cells is None or names is None:
        return states
    return _with_cells(states, cells, names)


def _with_cells(states: list[KeptMonitor], cells: bytes, names: CellNames) -> list[KeptMonitor]:
    found = {state.name: state for state in states}
    layout = struct.Struct(f"<{len(names.properties)}q{names.code}")
    values = layout.unpack_from(cells)
    for (name, index), value in zip(names.properties, values, strict=False):
        found[name].runs[index][0][0] = value
    for place, number in enumerate(names.clocks):
        name, index = names.properties[number]
        found[name].runs[index][0][1:] = _CLOCK.unpack_from(cells, layout.size + place * _CLOCK.size)
    for known, value in zip(names.variables, values[len(names.properties) :], strict=True):
        if known is not None:
            found[known[0]].variables[known[1]] = value
    return states


def kept_monitor(monitor: Monitor, variables: Mapping[str, Any], types: bytes) -> KeptMonitor:
    """The state of a monitor as data. Raises `StateTooLargeError`."""
    slices = monitor.slices
    first: tuple[list[Any], list[Any]] = ([], [])
    if slices is not None:
        first = [*slices.first.key[1:]], [*slices.first.values]
    if monitor.home is not None:
        monitor.home.show()
    return KeptMonitor(
        monitor.name,
        monitor.code.identity,
        types,
        monitor.enabled,
        monitor.seen,
        monitor.broken,
        monitor.faults,
        monitor.held,
        monitor.why_held,
        [KeptTimer(timer.due, timer.ticked) for timer in monitor.timers],
        [kept(running.run) for running in monitor.properties] if slices is None else [],
        {name: variables[code] for name, code in monitor.code.variables.items()},
        first,
    )


def shape(monitor: Monitor, variables: Mapping[str, Any]) -> bytes:
    """What of a state tells whether anything has happened since the beginning: all but times."""
    monitor.come_home()
    runs = [
        kept(running.run)[0][:1] if hasattr(running.run, "state") else kept(running.run)
        for running in monitor.properties
    ]
    live = monitor.slices.live if monitor.slices is not None else 0
    values = [variables[code] for code in monitor.code.variables.values()]
    return msgspec.msgpack.encode([runs, values, live])


def restore(
    monitor: Monitor,
    state: KeptMonitor,
    slices: Sequence[KeptSlice],
    variables: dict[str, Any],
    compiled: Compiled,
    *,
    time_ns: int,
) -> None:
    """Give a monitor that has just been made this state. Raises `ValueError`; then it has to begin."""
    code, values, types = monitor.code, state.variables, compiled.types
    fits = partial(_fits, Values(compiled.messages))
    properties = monitor.properties if monitor.slices is None else ()
    if (len(state.runs), len(state.timers)) != (len(properties), len(monitor.timers)):
        raise ValueError("it has other properties or timers")
    if values.keys() != code.variables.keys() or not all(
        fits(types[code.variables[name]], value) for name, value in values.items()
    ):
        raise ValueError("it has other variables")
    runs = [
        run_of(running.code.property, data, time_ns)
        for running, data in zip(properties, state.runs, strict=True)
    ]
    for name, value in values.items():
        variables[code.variables[name]] = value
    for running, run in zip(properties, runs, strict=True):
        running.run = run
        running.history.forget(run, time_ns)
    if monitor.slices is not None:
        restore_slices(monitor.slices, code, state.first, slices, types=types, fits=fits, time_ns=time_ns)
    for timer, ticking in zip(monitor.timers, state.timers, strict=True):
        timer.due, timer.ticked = ticking.due, ticking.ticked
    monitor.enabled = state.enabled
    monitor.seen, monitor.broken, monitor.faults = state.seen, state.broken, state.faults
    monitor.held, monitor.why_held = state.held, state.why_held


_HELD: Mapping[type, type | tuple[type, ...]] = MappingProxyType(
    {
        value_types.Bool: bool,
        value_types.Integer: int,
        value_types.Time: int,
        value_types.Duration: int,
        value_types.Floating: (float, int),
        value_types.String: bytes,
        value_types.Characters: bytes,
    }
)


def _fits(known: Values, kind: Type, value: Any) -> bool:
    """Whether a value is one of a type, as variables hold it."""
    if isinstance(kind, value_types.Vector):
        return (
            isinstance(value, list)
            and kind.length in (None, len(value))
            and all(_fits(known, kind.element, one) for one in value)
        )
    if isinstance(kind, value_types.Record):
        parts = known.fields(kind)
        return (
            isinstance(value, list)
            and len(value) == len(parts)
            and all(_fits(known, part, one) for part, one in zip(parts, value, strict=True))
        )
    return isinstance(value, _HELD.get(type(kind), ()))


# --- which specifications act, and have something to remember ---


def types_of(compiled: Compiled) -> dict[str, bytes]:
    """Of each specification a digest of the definitions of messages that it uses."""
    definitions = compiled.messages.definitions
    return {
        code.name: hashlib.sha256(
            msgspec.msgpack.encode([definitions.message(name) for name in sorted(code.reached)])
        ).digest()
        for code in compiled.specifications
    }


def guards(compiled: Compiled) -> frozenset[str]:
    """The specifications that can drop, change or publish a message and have a state by which they judge.

    One whose state is lost holds its topics.
    """
    starts = {name for code in compiled.specifications for name in code.start}
    acting: set[str] = set()
    used: set[str] = set()
    for name, function in compiled.functions.items():
        for node in nodes.walk(function) if name not in starts else ():
            if isinstance(node, nodes.Drop | nodes.Publish) or (
                isinstance(node, nodes.WriteBack) and node.writes
            ):
                acting.add(function.context)
            elif isinstance(node, nodes.Assign) or (
                isinstance(node, nodes.Read)
                and isinstance(node.type, value_types.Vector | value_types.Record)
            ):  # what a vector or message holds may change in place
                used.add(node.name)
    return frozenset(
        code.name
        for code in compiled.specifications
        if code.context in acting
        and (code.properties or code.slicing is not None or not used.isdisjoint(code.variables.values()))
    )
