"""Run one event in the interpreter and in the module, from the same state, and compare the effects.

A difference between the two is a fact that needs no solver: the interpreter defines the meaning of the form, and
wasmtime runs the bytes of the module. `equality.py` runs random states (`random_states.py`), and repeats each
counterexample of z3 here.

The message ends where the memory ends, so that a read beyond it traps. All memory of the module is restored before
each run.
"""

import math
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from rosmop.fast.abi import ALTERED, BEYOND, MAX_KEPT, NOW, POSITION, SAID, UNDO, is_kept, kept_size
from rosmop.fast.batch_codegen import WasmModule
from rosmop.fast.deferred_output import HEAD
from rosmop.fast.wasm import EXPORTED_FUNCTION, section, text, unsigned
from rosmop.fast.wasm_instance import WasmInstance, WasmTrap, translate
from rosmop.fast.wasm_runner import cell_code, put_value, take_value
from rosmop.form.compiled import Compiled
from rosmop.prove.decoding import EXPORTS, Reader, sections
from rosmop.run.engine import MonitorSet
from rosmop.runtime.action_context import LogLine
from rosmop.runtime.wire import WireMessage
from rosmop.types import value_types
from rosmop.types.value_types import Type, Value
from roswire.counted import counted

HAPPENED, DROPPED, CHANGED, ELSEWHERE, REPLACED = 1, 2, 4, 8, 32
"""Bits of the result of an event's function."""

BUDGET_ONLY = "the rest of the budget"
READS_BEYOND = "it reads beyond the message"

_BITS = {
    "whether it happened": HAPPENED,
    "whether the message is dropped": DROPPED,
    "whether the safe message takes its place": REPLACED,
    "whether the message is changed": CHANGED,
}
_FUEL = 50_000_000
_NEVER = (1 << 63) - 1
_MEMORY_TRAP = "memory out of bounds"
_ADDRESS, _WORD, _TIME = struct.Struct("<I"), struct.Struct("<Q"), struct.Struct("<q")


@dataclass(frozen=True)
class EventPair:
    """An event: the name of its function in the form, the number in the module, and its channel and type of message."""

    name: str
    number: int
    topic: str
    kind: value_types.RecordType


@dataclass(frozen=True)
class EventState:
    """The state before an event. `throttled` has the time of the last line of output by context and site, and `names`
    are the host and the caller of the message.
    """

    message: bytes
    now: int
    variables: Mapping[str, Value]
    budget: int
    throttled: Mapping[tuple[str, int], int]
    names: tuple[bytes, bytes]
    altered: bool = False

    def __str__(self) -> str:
        variables = ", ".join(f"{name} = {_shown(value)}" for name, value in self.variables.items())
        host, caller = (name.decode("latin-1") for name in self.names)
        altered = ", altered" if self.altered else ""
        return (
            f"the message {self.message.hex()}{altered} at {self.now} ns from {caller!r} on {host!r},"
            f" a budget of {self.budget}, and {variables or 'no variables'}"
        )


@dataclass(frozen=True)
class _Effect:
    """The effect of an event; `rest` is the rest of the budget. `output` is None if it cannot be read."""

    bits: int
    message: bytes
    variables: Mapping[str, Value]
    output: list[LogLine] | None
    rest: int
    publishes: bool = False


class ConcreteRuns:
    """Runs the events of a set. Raises `WasmError` if the module is invalid."""

    def __init__(self, compiled: Compiled, module: WasmModule) -> None:
        self._module, self._forms = module, compiled.functions
        numbers = sorted({number for feed in module.feeds.values() for number in feed.functions})
        code = translate(_with_exports(module.code, numbers), module.memory)
        self._instance = WasmInstance(code, module.memory)
        self._memory = self._instance.memory
        self._before = bytes(self._memory[: module.frames])
        self._interpreter = MonitorSet.of(compiled).interpreter
        for stage in range(3):
            for specification in compiled.specifications:
                self._interpreter.function(specification.start[stage])()
        self._cells = [
            (name, address, kind, cells.texts.get(address, 0))
            for cells in module.cells
            for name, (address, kind) in cells.variables.items()
        ]
        names = {name for one in compiled.specifications for name in one.variables.values()}
        self._others = [
            name
            for name in names.difference(name for name, *_ in self._cells)
            if not isinstance(self._interpreter.variables[name], list)
        ]
        """Variables that the module does not have, and so does not change."""
        self._monitors = {context: each.monitor for context, each in self._interpreter.contexts.items()}
        self._latest: tuple[EventState, Mapping[str, Value]] | None = None
        self.compared = 0
        """The number of runs in which the module did not leave the message to the interpreter."""

    def difference(self, event: EventPair, state: EventState) -> str | None:
        """Return what differs, or None if nothing does or the module leaves the message."""
        try:
            done = self._in_module(event, state)
        except WasmTrap as trap:
            self.compared += trap.reason == _MEMORY_TRAP
            return READS_BEYOND if trap.reason == _MEMORY_TRAP else None
        if done is None:
            return None
        self.compared += 1
        context = self._interpreter.contexts[self._forms[event.name].context]
        meant = self._in_interpreter(event, state)
        if meant is None:
            return BUDGET_ONLY if context.budget < 0 else "it continues where the specification faults"
        for what, bit in _BITS.items():
            if (meant.bits ^ done.bits) & bit:
                return what
        if done.message != meant.message:
            return "the message"
        if done.bits & ~meant.bits:
            return "no other bits"
        for name, value in meant.variables.items():
            if not _same(value, done.variables[name]):
                return f"the variable {name}"
        if done.output != meant.output:
            return "the output"
        if meant.publishes:
            return "whether it publishes"
        # A line costs the module the most that it may cost.
        agrees = done.rest == meant.rest or (bool(done.output) and done.rest < meant.rest)
        return None if agrees else BUDGET_ONLY

    def after(self, event: EventPair, state: EventState) -> Mapping[str, Value]:
        """Return the variables after the event, or those before it if it faults."""
        if self._latest is None or self._latest[0] is not state:
            self._in_interpreter(event, state)
        assert self._latest is not None  # noqa: S101  each run sets it
        return self._latest[1]

    def _in_interpreter(self, event: EventPair, state: EventState) -> _Effect | None:
        """Return the effect, or None if the event faults."""
        interpreter = self._interpreter
        context, turn = interpreter.contexts[self._forms[event.name].context], interpreter.turn
        turn.now, turn.names = state.now, lambda _: state.names
        turn.log.clear()
        turn.published.clear()
        interpreter.variables |= {
            name: [*value] if isinstance(value, list) else value for name, value in state.variables.items()
        }
        for name, each in interpreter.contexts.items():
            each.throttled = {site: last for (own, site), last in state.throttled.items() if own == name}
        context.begin(state.budget)
        message = WireMessage(state.message, state.now, event.topic, altered=state.altered)
        self._latest = state, state.variables
        try:
            bits = HAPPENED * bool(interpreter.function(event.name)(message))
        except Exception:  # noqa: BLE001  any exception is a fault of the event, as in the engine
            return None
        bits |= DROPPED * message.dropped | REPLACED * (message.stopped is not None)
        after = state.message if message.dropped else bytes(message.buffer)
        bits |= CHANGED * (after != state.message)
        names = [*(name for name, *_ in self._cells), *self._others]
        variables = {name: interpreter.variables[name] for name in names}
        self._latest = state, variables
        return _Effect(bits, after, variables, [*turn.log], context.budget, bool(turn.published))

    def _in_module(self, event: EventPair, state: EventState) -> _Effect | None:
        """Return the effect, or None if the message is left to the interpreter. Raises `WasmTrap`."""
        module, memory = self._module, self._memory
        context = self._forms[event.name].context
        memory[: len(self._before)] = self._before
        for name, address, kind, buffer in self._cells:
            value = state.variables[name]
            word = put_value(memory, value, buffer, kind) if is_kept(kind) else value
            struct.pack_into("<" + cell_code(kind), memory, address, word)
        for key, address in module.throttles.items():
            _TIME.pack_into(memory, address, state.throttled.get(key, _NEVER))
        if context in module.senders:
            sender = module.senders[context]
            for place, raw in enumerate(state.names):
                word = put_value(memory, raw, sender + 16 + place * MAX_KEPT, value_types.STRING)
                _WORD.pack_into(memory, sender + 8 * place, word)
        _TIME.pack_into(memory, module.budgets[context], state.budget)
        _TIME.pack_into(memory, NOW, state.now)
        _ADDRESS.pack_into(memory, ALTERED, state.altered)
        _ADDRESS.pack_into(memory, UNDO, module.feeds[event.topic].log)
        _ADDRESS.pack_into(memory, SAID, module.said)
        _ADDRESS.pack_into(memory, POSITION, module.frames)
        at = len(memory) - len(state.message)
        memory[at:] = state.message
        bits = self._instance.call(f"event {event.number}", at, len(state.message), fuel=_FUEL) or 0
        if bits & ELSEWHERE:
            return None
        variables = {name: self._interpreter.variables[name] for name in self._others}
        for name, address, kind, _ in self._cells:
            (word,) = struct.unpack_from("<" + cell_code(kind), memory, address)
            variables[name] = self._kept(word, state.variables[name], kind) if is_kept(kind) else word
        rest = _TIME.unpack_from(memory, module.budgets[context])[0]
        return _Effect(bits, bytes(memory[at:]), variables, self._output(), rest)

    def _kept(self, word: int, before: Value, kind: Type) -> Value | None:
        """Return a string or an array, or None if it does not end within the memory."""
        count = word >> 32
        is_outside = (word & BEYOND) + count * kept_size(kind) > len(self._memory)
        return None if count != BEYOND and is_outside else take_value(self._memory, word, before, kind)

    def _output(self) -> list[LogLine] | None:
        memory, found = self._memory, []
        at, (end,) = self._module.said, _ADDRESS.unpack_from(memory, SAID)
        while at < end:
            number, _frame = HEAD.unpack_from(memory, at)
            if number >= len(self._module.lines):
                return None
            line = self._module.lines[number]
            found.append(line.put_out(memory, at, self._monitors[line.context]))
            at += line.size
        return found


def _with_exports(module: bytes, numbers: Iterable[int]) -> bytes:
    """Return a module that also exports the functions with these numbers."""
    more = [text(f"event {number}") + EXPORTED_FUNCTION + unsigned(number) for number in numbers]
    parts = dict(sections(module))
    reader = Reader(parts[EXPORTS])
    count = reader.read_unsigned() + len(more)
    parts[EXPORTS] = unsigned(count) + parts[EXPORTS][reader.at :] + b"".join(more)
    return module[:8] + b"".join(section(kind, content) for kind, content in parts.items())


def _same(one: object, other: object) -> bool:
    """Whether two values are equal; NaN equals NaN, and zeros have a sign."""
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(_same, one, other))
    if isinstance(one, float) and isinstance(other, float):
        if math.isnan(one) or math.isnan(other):
            return math.isnan(one) and math.isnan(other)
        return one == other and math.copysign(1, one) == math.copysign(1, other)
    return bool(one == other)


def _shown(value: Value) -> str:
    shown = repr(value)
    if len(shown) <= 100 or not isinstance(value, bytes | list):
        return shown
    return f"{shown[:90]}… ({counted(len(value), 'element')})"
