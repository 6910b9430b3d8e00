"""Write the WebAssembly module of a set: a loop over received frames runs the events of every message.

For each topic the module exports `feed(at, end, now)` for the frames (a length of 4 bytes, little-endian, and
the message) from `at` to before `end`. The result has the address of the first frame that is left (i64: the
low 32 bits), the number of effects (the next 24 bits), and `LEFT` if that frame is for the interpreter.

- A message is either processed, with all consequences, or left; `TopicCode.undo` lists the data to restore then.
After a trap, that message begins at the address stored at `POSITION` (0: no message had begun).
- A dropped or replaced message does not change the states of properties that suppress it
(`nodes.Advance.suppresses`).
- At `Cells.source` are four options: the sender; *told*, a bit for each event whose drops are left, and `LOUD` if all
changes are left as well; *enabled*, a bit for each specification of the topic; and *counted*, a bit for each verdict
that is only counted. A message with any other verdict is left.
- An effect is 16 bytes: a set of events (i64) and the number (i64) of consecutive messages that they changed. For
dropped frames it is -1 and their start and end (i32, i32).
- If a message gives a property a deadline before the time at `Cells.until`, the loop ends after it with `SOONER`.
- `TopicCode.counters` counts the events that happened, then the drops of each event, then the verdicts (`TOLD`).
"""

import struct
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass

from rosmop.fast.abi import (
    ALTERED,
    AREA,
    LEFT,
    MARK,
    NOW,
    POSITION,
    SAID,
    SURE,
    TOLD,
    UNDO,
    USED,
    Cells,
    CompiledModule,
    TopicCode,
)
from rosmop.fast.arithmetic import ELSEWHERE, in_seconds
from rosmop.fast.codegen import CHANGED, DROPPED, HAPPENED, REPLACED, RESET, ModuleCodegen, WasmFunction
from rosmop.fast.memory_layout import NotCompiledError, reason_of
from rosmop.fast.strings_codegen import mismatch
from rosmop.fast.wasm import (
    ACTIVE,
    BLOCK,
    DROP,
    ELSE,
    END,
    EXPORTED_FUNCTION,
    EXPORTED_MEMORY,
    HEADER,
    I32,
    I32_ADD,
    I32_AND,
    I32_EQ,
    I32_EQZ,
    I32_GE_U,
    I32_GT_U,
    I32_LT_S,
    I32_LT_U,
    I32_MUL,
    I32_NE,
    I32_OR,
    I32_SHL,
    I32_SHR_S,
    I32_SHR_U,
    I32_SUB,
    I32_WRAP_I64,
    I64,
    I64_ADD,
    I64_AND,
    I64_EQ,
    I64_EQZ,
    I64_EXTEND_I32_U,
    I64_GE_S,
    I64_GT_S,
    I64_LT_S,
    I64_NE,
    I64_OR,
    I64_SHL,
    I64_SHR_U,
    I64_SUB,
    I64_XOR,
    IF,
    LIMITED,
    LOOP,
    NOTHING,
    RETURN,
    SELECT,
    br,
    br_if,
    call,
    constant,
    function,
    function_type,
    i32_load,
    i32_load16_s,
    i32_store,
    i64_load,
    i64_store,
    load,
    local_get,
    local_set,
    row,
    section,
    store,
    text,
    unsigned,
)
from rosmop.form import nodes
from rosmop.form.compiled import Compiled
from rosmop.form.specification_groups import groups
from rosmop.run.explain import CLOCKED_ROOM, ENTRY, KEPT, RING, RUNS
from rosmop.run.outcomes import NO_NUMBER, SEQ
from rosmop.runtime.action_context import BUDGET
from rosmop.runtime.values import ValueCodec
from rosmop.types import value_types

EFFECT = 4

MAX_EVENTS = 63
MAX_VERDICTS = 63
MAX_EFFECTS = 4096
MAX_TABLES = 8 << 20

PAGE = 1 << 16

_SLACK = 16  # bytes after the frames that may be read


@dataclass(frozen=True)
class WasmModule(CompiledModule):
    """A module whose `code` is WebAssembly, with data for its proof and certificate."""

    budgets: Mapping[str, int]
    strings: Mapping[bytes, int]
    references: Sequence[range]
    handlers: Mapping[str, Sequence[int]]
    functions: int
    refused: Mapping[str, NotCompiledError]
    left: Mapping[str, Sequence[NotCompiledError]]
    routines: Mapping[str, int]
    names: Sequence[Sequence[str]]


def write(
    functions: Mapping[str, nodes.Function],
    components: Sequence[nodes.Component],
    values: ValueCodec,
    stamped: Container[str] = (),
) -> WasmModule:
    """Write the module of all topics that can be compiled. Messages of `stamped` begin with a `std_msgs/Header`."""
    shared: dict[str, Cells] = {}
    writer = ModuleCodegen(functions, shared, values)
    cells = []
    for component in components:
        variables = (*component.variables, *component.noted)
        room = component.properties + len(variables)
        base, source, until = writer.take(8 * room), writer.take(32), writer.take(8)
        cells.append(Cells(base, component.properties, source, component.noted, until=until))
        shared |= dict.fromkeys(variables, cells[-1])
    effects = writer.take(16 * (MAX_EFFECTS + 2))
    feeds: dict[str, TopicCode] = {}
    refused: dict[str, NotCompiledError] = {}
    walks: dict[str, TopicCodegen] = {}
    tables = _Tables(writer)
    for component, own in zip(components, cells, strict=True):
        for topic, events in component.topics:
            # If the module cannot send safe messages of a topic, the interpreter takes only the messages that stop.
            for channel in (topic, ""):
                try:
                    walks[topic] = TopicCodegen(
                        writer, own, tables, effects, events, topic=channel, stamped=topic in stamped
                    )
                    refused.pop(topic, None)
                    break
                except (NotCompiledError, RecursionError) as error:
                    refused[topic] = reason_of(error)
                    if not any(map(writer.stops, events)):
                        break
    settled = [writer.settling(own) for own in cells if own.kept]
    codes: list[bytes] = []
    for topic, walk in walks.items():
        try:
            codes.append(walk.code())
        except (NotCompiledError, RecursionError) as error:
            refused[topic] = reason_of(error)
            continue
        feeds[topic] = walk.feed(f"feed {len(feeds)}")
    frames = -(-writer.take(0) // PAGE) * PAGE  # the kernel copies aligned memory faster
    memory = -(-(frames + AREA + _SLACK) // PAGE) * PAGE
    wholes = [(one.parameters, one.result, one.code) for one in writer.written]
    exports = {f"settle {number}": number for number in settled}
    exports |= {feed.name: len(wholes) + place for place, feed in enumerate(feeds.values())}
    wholes += [(_PARAMETERS, I64, code) for code in codes]
    code = _assemble(wholes, exports, writer.constants, memory)
    return WasmModule(
        code,
        memory,
        frames,
        effects,
        feeds,
        cells,
        writer.throttles,
        writer.lines,
        writer.said,
        writer.senders,
        writer.budgets,
        {raw: writer.constants[raw] for raw in writer.strings},
        writer.references,
        {topic: [handler.number for handler in walks[topic].handlers()] for topic in feeds},
        len(writer.written),
        refused,
        writer.left,
        {
            name: number
            for name, write in (("mismatch", mismatch), ("seconds", in_seconds))
            if (number := writer.routine_of(write)) is not None
        },
        [function.names for function in writer.written],
    )


def written_of(compiled: Compiled) -> WasmModule:
    components = [group.component for group in groups(compiled.specifications)]
    return write(compiled.functions, components, ValueCodec(compiled.messages), compiled.stamped)


def _assemble(
    functions: Sequence[tuple[Sequence[int], int, bytes]],
    exports: Mapping[str, int],
    constants: Mapping[bytes, int],
    memory: int,
) -> bytes:
    types = [function_type(given, result) for given, result, _ in functions]
    exported = [text(name) + EXPORTED_FUNCTION + unsigned(number) for name, number in exports.items()]
    pages = unsigned(memory // PAGE)
    data = [
        ACTIVE + constant(I32, address) + END + unsigned(len(raw)) + raw for raw, address in constants.items()
    ]
    sections = (
        (1, row(types)),
        (3, row([unsigned(index) for index in range(len(types))])),
        (5, row([LIMITED + pages + pages])),
        (7, row([*exported, text("memory") + EXPORTED_MEMORY])),
        (10, row([code for _, _, code in functions])),
        (11, row(data)),
    )
    return HEADER + b"".join(section(number, part) for number, part in sections)


class _Tables:
    """Allocates tables: 2 bytes for each state, 8 bytes for each time."""

    def __init__(self, writer: ModuleCodegen) -> None:
        self._writer = writer
        self._size = 0

    def address(self, table: tuple[int, ...], code: str = "h") -> int:
        try:
            raw = struct.pack(f"<{len(table)}{code}", *table)
        except struct.error:
            raise NotCompiledError("has a property with too many states") from None
        if raw not in self._writer.constants:
            self._size += len(raw)
            if self._size > MAX_TABLES:
                raise NotCompiledError(f"has properties with tables of more than {MAX_TABLES >> 20} MiB")
        return self._writer.constant(raw)


_AT, _END, _NOW, _TOLD, _ENABLED = range(5)
_SIZE, _NEXT, _WHO, _LAST, _FIRST = range(5, 10)
_PARAMETERS = (I32, I32, I64)


def _set(local: int, value: bytes) -> bytes:
    return value + local_set(local)


class TopicCodegen:
    """Writes the code for one topic. Raises `NotCompiledError` if every message would be left.

    If `topic` is empty, messages that a safe message would replace are left to the interpreter.
    """

    def __init__(
        self,
        writer: ModuleCodegen,
        cells: Cells,
        tables: _Tables,
        effects: int,
        events: Sequence[nodes.Event],
        *,
        topic: str,
        stamped: bool,
    ) -> None:
        if len(events) > MAX_EVENTS:
            raise NotCompiledError(f"has more than {MAX_EVENTS} events on one topic")
        self._cells = cells
        self._events = events
        self._effects = effects
        self._writer = writer
        self._written = [writer.event(event.function, topic) for event in events]
        self._known_tables = tables
        self._handlers: dict[tuple[int | None, int], tuple[int, WasmFunction | None]] = {}
        self.verdicts: list[tuple[int, int, int]] = []
        self._tables = [
            [self._table(number, place) for place in range(len(event.advances))]
            for number, event in enumerate(events)
        ]
        functions = [*self._written, *self.handlers()]
        self._says = any(written.effects.says for written in functions)
        if self._says and stamped and any(written.effects.early for written in functions):
            raise NotCompiledError("prints a line about a message whose header it changes")
        self._budgets = sorted({writer.budget(writer.functions[event.function].context) for event in events})
        self._counters = writer.take(16 * len(events) + 8 * len(self.verdicts))
        assigned = sorted(
            {name for written in functions for name in written.assigned}.difference(cells.noted)
        )
        if any(written.effects.changes_elements for written in functions) and any(
            isinstance(cells.variables[name][1], value_types.VectorType) for name in assigned
        ):
            raise NotCompiledError("keeps an array, and changes an element of one")
        addresses = [cells.variables[name][0] for name in assigned]
        self._settles = not set(addresses).isdisjoint(cells.kept)
        self._replaces = any(written.effects.replaces for written in self._written)
        if self._replaces and self._settles and any(map(self._reads_in_place, events)):
            raise NotCompiledError("keeps a string or an array, and sends the safe message")
        self._undo = tuple((address, writer.take(8)) for address in addresses)
        self._log = writer.take(16 * sum(written.effects.writes for written in self._written))
        properties = {
            advance.property for event in events for advance in event.advances if advance.property is not None
        }
        self._suppressing = {
            advance.property for event in events for advance in event.advances if advance.suppresses
        }
        self._states = {
            number: _FIRST + len(events) + place for place, number in enumerate(sorted(properties))
        }
        for advance in (advance for event in events for advance in event.advances):
            if advance.property is not None and advance.property not in cells.exits:
                room = ENTRY.size * len(advance.table) if advance.clock is None else CLOCKED_ROOM
                cells.exits[advance.property] = writer.take(room)
                if advance.clock is not None:
                    cells.clocks[advance.property] = writer.take(16)
        self._stamped = stamped
        self._following = _FIRST + len(events) + len(self._states)
        self._sooner = self._following + 2
        clocked = sorted(properties.intersection(cells.clocks))
        self._clocks = {number: self._following + 3 + 3 * place for place, number in enumerate(clocked)}
        self._telling = self._following + 3 + 3 * len(clocked)

    def _reads_in_place(self, event: nodes.Event) -> bool:
        body = self._writer.functions[event.function].body
        return any(isinstance(node, nodes.ReadValue) for node in nodes.walk(body))

    def feed(self, name: str) -> TopicCode:
        return TopicCode(
            name,
            any(map(self._drops, range(len(self._events)))),
            any(written.effects.writes for written in self._written),
            self.verdicts,
            self._counters,
            self._log,
            self._undo,
            all(written.brief for written in (*self._written, *self.handlers())),
            [written.number for written in self._written],
            self._says,
            f"settle {self._cells.settle}" if self._settles else "",
            self._budgets,
        )

    def handlers(self) -> list[WasmFunction]:
        return [written for _, written in self._handlers.values() if written is not None]

    def _drops(self, number: int) -> bool:
        run = [written for advance in self._events[number].advances for _, written in self._handled(advance)]
        return any(written.effects.drops for written in (self._written[number], *run))

    def _table(self, number: int, place: int) -> int | None:
        advance = self._events[number].advances[place]
        left: set[int] = set()
        for index, handled in enumerate(advance.handlers):
            key = advance.property, index
            if key not in self._handlers and not handled.states.isdisjoint(advance.table):
                written = None
                try:
                    if len(self.verdicts) == MAX_VERDICTS:
                        raise NotCompiledError(f"more than {MAX_VERDICTS} verdicts of one topic")
                    written = self._writer.event(handled.function)
                except (NotCompiledError, RecursionError) as error:
                    self._writer.leave(handled.function, reason_of(error))
                self._handlers[key] = len(self.verdicts), written
                self.verdicts += [(number, place, index)] if written is not None else []
            if key in self._handlers and self._handlers[key][1] is None:
                left |= handled.states
        table = tuple(-1 if state in left else state for state in advance.table)
        if not self._written[number].passes and max(table) < 0:
            raise NotCompiledError("reaches a verdict with each message")
        idle = advance.clock is None and not self._handled(advance) and table == tuple(range(len(table)))
        return None if idle else self._known_tables.address(table)

    def _handled(self, advance: nodes.Advance) -> dict[tuple[int, WasmFunction], frozenset[int]]:
        found = {}
        for index, handled in enumerate(advance.handlers):
            verdict, written = self._handlers.get((advance.property, index), (0, None))
            if written is not None and not handled.states.isdisjoint(advance.table):
                found[verdict, written] = handled.states
        return found

    def code(self) -> bytes:
        here = local_get(_AT) + I64_EXTEND_I32_U + load(I32, EFFECT) + constant(I32, self._effects) + I32_SUB
        here += constant(I32, 4) + I32_SHR_U + I64_EXTEND_I32_U + constant(I64, 32) + I64_SHL + I64_OR
        if self.verdicts:
            told = constant(I64, TOLD.bit_length() - 1) + I64_SHL
            here += local_get(self._telling + 2) + I64_EXTEND_I32_U + told + I64_OR
        settle = call(self._cells.settle) + DROP if self._settles else b""
        over = store(I32, POSITION, constant(I32, 0))
        body = [
            store(I64, NOW, local_get(_NOW)),
            store(I32, EFFECT, constant(I32, self._effects)),
            store(I32, SAID, constant(I32, self._writer.said)) if self._says else b"",
            store(I32, USED, constant(I32, 0)) if self._writer.has_arena else b"",
            _set(_TOLD, load(I64, self._cells.source + 8)),
            _set(_ENABLED, load(I64, self._cells.source + 16)),
            *(_set(local, load(I32, self._state(number))) for number, local in self._states.items()),
            *(_set(local, load(I64, at)) for _, local, at in self._clock_cells()),
            _set(self._telling + 1, load(I64, self._cells.source + 24)) if self.verdicts else b"",
            self._begin(), BLOCK, BLOCK, LOOP,
            self._frame(),
            BLOCK, BLOCK,
            *(self._event(number) for number in range(len(self._events))),
            self._changed() if any(written.effects.writes for written in self._written) else b"",
            br(1), END,
            self._dropped(), END,
            self._done(),
            br(0), END, END,
            settle, over, here, local_get(self._sooner), I64_EXTEND_I32_U, constant(I64, 61), I64_SHL, I64_OR,
            RETURN, END,
            over, here, constant(I64, LEFT), I64_OR,
        ]  # fmt: skip
        numbered = [I32] * (len(self._events) + len(self._states) + 3)
        made = [I64, I64, I32, I32, I64, I32, *numbered, *[I64] * (3 * len(self._clocks) + 2)]
        made += [I32] * (4 + len(self.verdicts))  # see `_handle`
        return function([(1, machine) for machine in made], b"".join(body))

    def _state(self, number: int) -> int:
        return self._cells.base + 8 * number

    def _clock_cells(self) -> Iterator[tuple[int, int, int]]:
        for number, local in self._clocks.items():
            clock = self._cells.clocks[number]
            for place, at in enumerate((clock, clock + 8, self._cells.exits[number])):
                yield number, local + place, at

    def _begin(self) -> bytes:
        """Mark the current frame as untouched.

        No mark is needed elsewhere, because the runtime stops only at calls and at the start of loops.
        """
        code = store(I32, POSITION, local_get(_AT)) + store(I32, UNDO, constant(I32, self._log))
        code += store(I32, SURE, load(I32, SAID)) if self._says else b""
        code += store(I32, MARK, load(I32, USED)) if self._writer.has_arena else b""
        return code + b"".join(store(I64, kept, load(I64, address)) for address, kept in self._undo)

    def _frame(self) -> bytes:
        room = local_get(_END) + local_get(_AT) + I32_SUB
        stop = br_if(1)
        code = room + constant(I32, 4) + I32_LT_U + stop
        code += _set(_SIZE, local_get(_AT) + i32_load(0))
        code += local_get(_SIZE) + room + constant(I32, 4) + I32_SUB + I32_GT_U + stop
        full = constant(I32, self._effects + 16 * MAX_EFFECTS)
        code += load(I32, EFFECT) + full + I32_GE_U + stop
        code += _set(_NEXT, local_get(_AT) + local_get(_SIZE) + I32_ADD + constant(I32, 4) + I32_ADD)
        code += _set(_WHO, constant(I64, 0))
        code += b"".join(store(I64, budget, constant(I64, BUDGET)) for budget in self._budgets)
        return code + b"".join(_set(_FIRST + number, constant(I32, 0)) for number in range(len(self._events)))

    def _event(self, number: int) -> bytes:
        """Blocks from here: the `if`, dropped (1), done (2), the loop (3), out (4), left (5)."""
        event, written, bits = self._events[number], self._written[number], _FIRST + number
        left = br_if(5)
        enabled = local_get(_ENABLED) + constant(I64, 1 << event.specification) + I64_AND
        code = enabled + I64_EQZ + I32_EQZ + IF + NOTHING
        message = local_get(_AT) + constant(I32, 4) + I32_ADD + local_get(_SIZE)
        body = self._writer.functions[event.function].body
        if any(isinstance(node, nodes.Altered) for node in nodes.walk(body)):
            code += store(I32, ALTERED, load(I32, UNDO) + constant(I32, self._log) + I32_NE)
        code += _set(bits, message + call(written.number))
        code += self._is(bits, ELSEWHERE) + left
        if written.effects.writes:
            loud = local_get(_TOLD) + constant(I64, 0) + I64_LT_S
            changed = self._is(bits, CHANGED) + constant(I32, 0) + I32_NE
            code += changed + loud + I32_AND + left
            wrote = (
                changed
                if not written.effects.replaces
                else self._is(bits, CHANGED | REPLACED) + constant(I32, 0) + I32_NE
            )
            which = wrote + I64_EXTEND_I32_U + constant(I64, number) + I64_SHL
            code += _set(_WHO, local_get(_WHO) + which + I64_OR)
        if written.effects.drops:
            code += self._drop(number, self._is(bits, DROPPED))
        if written.effects.replaces:
            code += self._is(bits, REPLACED) + IF + NOTHING + self._suppressed() + END
        gone = self._telling + 3
        steps = [
            self._advance(advance, table)
            for advance, table in zip(event.advances, self._tables[number], strict=True)
            if table is not None
        ]
        if steps:
            happened = self._is(bits, HAPPENED)
            if written.effects.replaces:
                happened = self._is(bits, HAPPENED | REPLACED) + constant(I32, HAPPENED) + I32_EQ
            code += happened + IF + NOTHING + b"".join(steps) + END
        if any(written.effects.drops for advance in event.advances for _, written in self._handled(advance)):
            code = _set(gone, constant(I32, 0)) + code + self._drop(number, local_get(gone))
        return code + END

    def _drop(self, number: int, condition: bytes) -> bytes:
        dropped = condition + constant(I32, 0) + I32_NE
        hidden = local_get(_TOLD) + constant(I64, 1 << number) + I64_AND + I64_EQZ
        code = dropped + hidden + I32_EQZ + I32_AND + br_if(5)
        return code + self._count(len(self._events) + number, dropped) + condition + br_if(1)

    def _is(self, bits: int, which: int) -> bytes:
        return local_get(bits) + constant(I32, which) + I32_AND

    def _advance(self, advance: nodes.Advance, table: int) -> bytes:
        left = 6  # the number of the block "left"
        if advance.property is None:
            return br(left)
        if advance.clock is not None:
            return self._advance_clock(advance.property, advance.clock, advance.event, table)
        state = self._states[advance.property]
        following, room = self._following, self._following + 1
        code = _set(following, local_get(state) + constant(I32, 1) + I32_SHL + i32_load16_s(table))
        code += local_get(following) + constant(I32, 0) + I32_LT_S + br_if(left)
        code += local_get(following) + local_get(state) + I32_NE + IF + NOTHING
        code += _set(room, local_get(state) + constant(I32, ENTRY.size) + I32_MUL)
        kind = constant(I64, (SEQ if self._stamped else NO_NUMBER) << 24 | advance.event)
        exits = self._cells.exits[advance.property]
        for offset, value in ((0, local_get(_NOW)), (8, load(I64, self._cells.source) + kind + I64_OR)):
            code += local_get(room) + value + i64_store(exits + offset)
        if self._stamped:
            code += local_get(room) + local_get(_AT) + i32_load(4) + i32_store(exits + 16)
        code += _set(state, local_get(following)) + END
        return code + self._handle(advance, state) if self._handled(advance) else code

    def _handle(self, advance: nodes.Advance, state: int) -> bytes:
        """Run the handlers of the entered state, in their order; then the property may restart.

        Blocks from here: the `if` of the event's steps and of the event, ..., left (6).
        """
        handlers = self._handled(advance)
        which, counted, _, gone, anew, some = range(self._telling, self._telling + 6)
        masks = [0] * len(advance.table)
        for (verdict, _), states in handlers.items():
            for each in states:
                masks[each] |= 1 << verdict
        table = self._known_tables.address(tuple(masks), "q")
        code = _set(which, local_get(state) + constant(I32, 3) + I32_SHL + i64_load(table))
        code += local_get(which) + I64_EQZ + I32_EQZ + IF + NOTHING
        code += local_get(which) + local_get(counted) + I64_AND + local_get(which) + I64_NE + br_if(7)
        code += _set(anew, constant(I32, 0)) + _set(some, constant(I32, 1))
        bits, message = self._following, local_get(_AT) + constant(I32, 4) + I32_ADD + local_get(_SIZE)
        for verdict, written in handlers:
            entered = local_get(which) + constant(I64, 1 << verdict) + I64_AND
            code += entered + I64_EQZ + I32_EQZ + IF + NOTHING
            code += _set(bits, message + call(written.number))
            code += self._is(bits, ELSEWHERE) + br_if(8)
            for kept, bit in ((gone, DROPPED), (anew, RESET)):
                code += _set(kept, local_get(kept) + self._is(bits, bit) + I32_OR)
            count = some + 1 + verdict
            code += _set(count, local_get(count) + constant(I32, 1) + I32_ADD) + END
        again = local_get(anew) + IF + NOTHING + _set(state, constant(I32, advance.initial)) + END
        return code + again + END

    def _advance_clock(self, number: int, clock: nodes.PropertyClock, event: int, table: int) -> bytes:
        state, (since, now, count) = (
            self._states[number],
            range(self._clocks[number], self._clocks[number] + 3),
        )
        following, room, exits = self._following, self._following + 1, self._cells.exits[number]

        def slot(entries: int, size: int, shift: int) -> bytes:
            place = local_get(count) + constant(I64, shift) + I64_SHR_U + constant(I64, entries - 1) + I64_AND
            return _set(room, place + I32_WRAP_I64 + constant(I32, size) + I32_MUL)

        code = local_get(count) + constant(I64, KEPT - 1) + I64_AND + I64_EQZ + IF + NOTHING
        code += slot(RUNS, 24, KEPT.bit_length() - 1)
        run = (local_get(state) + I64_EXTEND_I32_U, local_get(since), local_get(now))
        for place, value in enumerate(run):
            code += local_get(room) + value + i64_store(exits + 8 + 8 * place)
        code += END + slot(RING, ENTRY.size, 0)
        kind = constant(I64, (SEQ if self._stamped else NO_NUMBER) << 24 | event)
        for place, value in enumerate((local_get(_NOW), load(I64, self._cells.source) + kind + I64_OR)):
            code += local_get(room) + value + i64_store(exits + 8 + 24 * RUNS + 8 * place)
        seq = local_get(_AT) + i32_load(4) if self._stamped else constant(I32, 0)
        code += local_get(room) + seq + i32_store(exits + 8 + 24 * RUNS + 16)
        code += _set(count, local_get(count) + constant(I64, 1) + I64_ADD)
        both = local_get(_NOW) + local_get(now)
        code += _set(now, both + both + I64_GT_S + SELECT)
        late, waits = (
            self._known_tables.address(*table) for table in ((clock.late, "h"), (clock.waits, "q"))
        )
        is_late = local_get(now) + local_get(since) + I64_SUB + constant(I64, clock.within) + I64_GT_S
        code += constant(I32, late) + constant(I32, table) + is_late + SELECT
        code += local_get(state) + constant(I32, 1) + I32_SHL + I32_ADD + i32_load16_s(0)
        code = _set(following, code) + local_get(following) + constant(I32, 0) + I32_LT_S + br_if(6)
        code += local_get(following) + constant(I32, 1) + I32_AND
        code += IF + NOTHING + _set(since, local_get(now)) + END
        code += _set(state, local_get(following) + constant(I32, 1) + I32_SHR_S)
        wait = local_get(state) + constant(I32, 3) + I32_SHL + i64_load(waits)
        sooner = local_get(since) + wait + I64_ADD + load(I64, self._cells.until) + I64_LT_S
        code += wait + constant(I64, 0) + I64_GE_S + sooner + I32_AND
        return code + IF + NOTHING + _set(self._sooner, constant(I32, 1)) + END

    def _count(self, place: int, more: bytes) -> bytes:
        address = self._counters + 8 * place
        return store(I64, address, load(I64, address) + more + I64_EXTEND_I32_U + I64_ADD)

    def _changed(self) -> bytes:
        """Note the events that changed the message. Blocks: dropped, done, the loop, out, left.

        After several changes the bytes may again be the original ones, so the message is left to the engine unless
        the first changed word differs.
        """
        entry = self._log
        size = constant(I64, 64) + load(I64, entry) + constant(I64, 32) + I64_SHR_U
        size += constant(I64, 3) + I64_SHL + I64_SUB
        differs = load(I32, entry) + i64_load(0) + load(I64, entry + 8) + I64_XOR + size + I64_SHL
        several = local_get(_WHO) + local_get(_WHO) + constant(I64, 1) + I64_SUB + I64_AND + I64_EQZ + I32_EQZ
        unsure = several + IF + NOTHING + differs + I64_EQZ + br_if(6) + END
        last, one = local_get(_LAST), constant(I64, 1)
        same = _set(_LAST, load(I32, EFFECT)) + last + i64_load(0) + local_get(_WHO) + I64_EQ
        again = last + last + i64_load(8) + one + I64_ADD + i64_store(8)
        new = self._next_effect() + last + local_get(_WHO) + i64_store(0) + last + one + i64_store(8)
        counted = same + IF + NOTHING + again + ELSE + new + END
        if self._replaces:  # the message may have been the safe one already
            counted = load(I32, UNDO) + constant(I32, entry) + I32_NE + IF + NOTHING + counted + END
        return local_get(_WHO) + I64_EQZ + I32_EQZ + IF + NOTHING + unsure + counted + END

    def _next_effect(self) -> bytes:
        more = _set(_LAST, local_get(_LAST) + constant(I32, 16) + I32_ADD)
        return more + store(I32, EFFECT, local_get(_LAST))

    def _dropped(self) -> bytes:
        last = local_get(_LAST)
        same = last + i64_load(0) + constant(I64, -1) + I64_EQ
        same += last + i32_load(12) + local_get(_AT) + I32_EQ + I32_AND
        new = self._next_effect() + last + constant(I64, -1) + i64_store(0)
        new += last + local_get(_AT) + i32_store(8)
        code = self._suppressed() + _set(_LAST, load(I32, EFFECT)) + same + I32_EQZ + IF + NOTHING + new + END
        return code + last + local_get(_NEXT) + i32_store(12)

    def _suppressed(self) -> bytes:
        code = b"".join(
            _set(local, load(I32, self._state(number)))
            for number, local in self._states.items()
            if number in self._suppressing
        )
        return code + b"".join(
            _set(local, load(I64, at)) for number, local, at in self._clock_cells()
            if number in self._suppressing and at != self._cells.clocks[number] + 8
        )  # fmt: skip

    def _done(self) -> bytes:
        code = b"".join(
            self._count(number, self._is(_FIRST + number, HAPPENED)) for number in range(len(self._events))
        )
        code += b"".join(
            store(I32, self._state(number), local_get(local)) for number, local in self._states.items()
        )
        code += b"".join(store(I64, at, local_get(local)) for _, local, at in self._clock_cells())
        if self.verdicts:
            _, _, ever, _, _, some = range(self._telling, self._telling + 6)
            code += local_get(some) + IF + NOTHING
            for verdict in range(len(self.verdicts)):
                count = some + 1 + verdict
                code += self._count(2 * len(self._events) + verdict, local_get(count))
                code += _set(count, constant(I32, 0))
            code += _set(some, constant(I32, 0)) + _set(ever, constant(I32, 1)) + END
        code += _set(_AT, local_get(_NEXT)) + self._begin()
        return code + (local_get(self._sooner) + br_if(1) if self._clocks else b"")
