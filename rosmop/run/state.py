"""Keep the state of monitors as data that outlives their process, group by group, and read it back under limits.

The state is everything that affects later messages: variables, runs of properties, timers, and whether a
monitor holds its topics; not the events that explain a verdict. If the variables of a group are numbers, its
state is the bytes in the module's memory (`CellNames`). Times are those of the caller's clock, which the next
process continues.
"""

import hashlib
import struct
from collections.abc import Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Any

import msgspec

from rosmop.form.compiled import Compiled
from rosmop.logics.interface import ClockedRun, FiniteRun
from rosmop.run.monitor import CellNames, MonitorInstance
from rosmop.run.origins import Origin
from rosmop.run.state_of_runs import StateTooLargeError, dump, run_of
from rosmop.run.state_of_slices import PartSnapshot, SliceSnapshot, restore_slices
from rosmop.runtime.values import ValueCodec
from rosmop.types import value_types
from rosmop.types.value_types import Type, Value

MAX_STATE_BYTES = 64 << 10

_CLOCK = struct.Struct("<qq")


class TimerSnapshot(msgspec.Struct, frozen=True, array_like=True):
    """The state of a periodic event."""

    due: int | None
    ticked: bool


class MonitorSnapshot(msgspec.Struct, frozen=True, array_like=True):
    """The state of a monitor; `identity` and `types` stand for its text and its message definitions."""

    name: str
    identity: bytes
    types: bytes
    enabled: bool
    seen: bool
    broken: bool
    faults: int
    held: bool
    why_held: str
    timers: list[TimerSnapshot]
    runs: list[Any]
    variables: dict[str, Any]
    first: tuple[list[Any], list[Any]] = ([], [])
    """The initial values of parameters, and of the slices' own variables."""
    sources: dict[str, tuple[str | None, list[str], bool, list[str]]] = {}
    """By topic: the first node, the nodes whose last bytes were not a message, whether it awaits the first, and the
    nodes that have a say of their own."""


def encode(states: Sequence[MonitorSnapshot]) -> bytes:
    data = msgspec.msgpack.encode(states)
    if len(data) > MAX_STATE_BYTES:
        raise StateTooLargeError(f"its state has {len(data)} bytes; {MAX_STATE_BYTES} are kept")
    return data


def encode_refusal(why: str) -> bytes:
    return msgspec.msgpack.encode(why)


GroupSnapshot = tuple[Sequence[str], bytes, bytes, bytes | None]
"""A group's monitors, the layout of its cells (`CellNames` as MessagePack), their state, and the cells if newer."""


def states_of(
    groups: Sequence[GroupSnapshot],
) -> tuple[dict[str, MonitorSnapshot], dict[str, list[SliceSnapshot]], dict[str, str]]:
    snapshots: dict[str, MonitorSnapshot] = {}
    slices: dict[str, list[SliceSnapshot]] = {}
    lost: dict[str, str] = {}
    for group in groups:
        try:
            states = _decode(group)
        except (ValueError, struct.error, LookupError, TypeError) as error:
            states = f"its state cannot be read: {error}"
        if isinstance(states, PartSnapshot):
            slices.setdefault(group[0][0], []).extend(states.slices)
            continue
        for name in group[0]:
            if isinstance(states, list):
                slices[name] = []
            snapshots.pop(name, None)
            lost[name] = states if isinstance(states, str) else "its state was not written"
        snapshots |= {state.name: state for state in states if isinstance(state, MonitorSnapshot)}
    return snapshots, slices, {name: why for name, why in lost.items() if name not in snapshots}


_DECODER: msgspec.msgpack.Decoder[list[MonitorSnapshot] | PartSnapshot | str] = msgspec.msgpack.Decoder(
    list[MonitorSnapshot] | PartSnapshot | str
)
_NAMES = msgspec.msgpack.Decoder(CellNames | None)


def _decode(group: GroupSnapshot) -> list[MonitorSnapshot] | PartSnapshot | str:
    _, names_of, base, cells = group
    states, names = _DECODER.decode(base), _NAMES.decode(names_of)
    if not isinstance(states, list) or cells is None or names is None:
        return states
    return _with_cells(states, cells, names)


def _with_cells(states: list[MonitorSnapshot], cells: bytes, names: CellNames) -> list[MonitorSnapshot]:
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


def kept_monitor(monitor: MonitorInstance, variables: Mapping[str, Value], types: bytes) -> MonitorSnapshot:
    slices = monitor.slices
    first: tuple[list[Any], list[Any]] = ([], [])
    if slices is not None:
        first = [*slices.first.key[1:]], [*slices.first.values]
    if monitor.home is not None:
        monitor.home.show()
    return MonitorSnapshot(
        monitor.name,
        monitor.code.identity,
        types,
        monitor.enabled,
        monitor.seen,
        monitor.broken,
        monitor.faults,
        monitor.held,
        monitor.why_held,
        [TimerSnapshot(timer.due, timer.ticked) for timer in monitor.timers],
        [dump(running.run) for running in monitor.properties] if slices is None else [],
        {name: variables[code] for name, code in monitor.code.variables.items()},
        first,
        {
            topic: (source.first, sorted(source.unreadable), source.waits, sorted(source.known))
            for topic, source in monitor.sources.items()
        },
    )


def shape(monitor: MonitorInstance, variables: Mapping[str, Value]) -> bytes:
    monitor.move_to_python()
    runs = [
        dump(running.run)[0][:1] if isinstance(running.run, FiniteRun | ClockedRun) else dump(running.run)
        for running in monitor.properties
    ]
    live = monitor.slices.live if monitor.slices is not None else 0
    values = [variables[code] for code in monitor.code.variables.values()]
    return msgspec.msgpack.encode([runs, values, live])


def restore(
    monitor: MonitorInstance,
    state: MonitorSnapshot,
    slices: Sequence[SliceSnapshot],
    variables: dict[str, Value],
    compiled: Compiled,
    *,
    time_ns: int,
) -> None:
    """Restore a new monitor. After a `ValueError`, the monitor must be started."""
    code, values, types = monitor.code, state.variables, compiled.types
    fits = partial(_fits, ValueCodec(compiled.messages))
    properties = monitor.properties if monitor.slices is None else ()
    if (len(state.runs), len(state.timers)) != (len(properties), len(monitor.timers)):
        raise ValueError("its properties or timers differ")
    if values.keys() != code.variables.keys() or not all(
        fits(types[code.variables[name]], value) for name, value in values.items()
    ):
        raise ValueError("its variables differ")
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
    for topic, source in monitor.sources.items():
        if topic in state.sources:
            first, unreadable, waits, known = state.sources[topic]
            source.follow(Origin(first, set(unreadable), waits, known=set(known)))


_HELD: Mapping[type, type | tuple[type, ...]] = MappingProxyType(
    {
        value_types.BoolType: bool,
        value_types.IntegerType: int,
        value_types.TimeType: int,
        value_types.DurationType: int,
        value_types.FloatingType: (float, int),
        value_types.StringType: bytes,
        value_types.CharactersType: bytes,
    }
)


def _fits(known: ValueCodec, kind: Type, value: object) -> bool:
    if isinstance(kind, value_types.VectorType):
        return (
            isinstance(value, list)
            and kind.length in (None, len(value))
            and all(_fits(known, kind.element, one) for one in value)
        )
    if isinstance(kind, value_types.RecordType):
        parts = known.fields(kind)
        return (
            isinstance(value, list)
            and len(value) == len(parts)
            and all(_fits(known, part, one) for part, one in zip(parts, value, strict=True))
        )
    return isinstance(value, _HELD.get(type(kind), ()))


def types_of(compiled: Compiled) -> dict[str, bytes]:
    definitions = compiled.messages.definitions
    return {
        code.name: hashlib.sha256(
            msgspec.msgpack.encode([definitions.message(name) for name in sorted(code.reached)])
        ).digest()
        for code in compiled.specifications
    }
