"""Run the compiled module of a set: decide when it may process a topic or a part of a service (a *lane*).

- A batch ends before the first message that the module leaves to the engine; nothing of that message has happened.
- The earlier messages have the same effect as if `MonitorSet.process` had processed each at the time of the batch.
- The state of specifications that share topics or variables is in one place at a time: in the module's memory from
  the first batch on (`ModuleState.prepare`), in Python whenever Python reads it (`ModuleState.leave`).
- Frames in the module's memory (`Lanes.area`) are changed in place. The beginning of any other frame is copied to the
  module, and back if it was changed; code that reads beyond it leaves the message to the engine.
"""

import struct
from collections.abc import Collection, Mapping, Sequence
from itertools import zip_longest
from types import MappingProxyType
from typing import Any

from rosmop.fast.abi import (
    AREA,
    BEYOND,
    LEFT,
    LOUD,
    MAX_KEPT,
    MAX_TEXTS,
    POSITION,
    REST,
    SOONER,
    SURE,
    TOLD,
    UNDO,
    Cells,
    CompiledModule,
    is_kept,
    is_texts,
    most_kept,
    room_of,
)
from rosmop.fast.deferred_output import HEAD
from rosmop.fast.wasm_instance import WasmInstance, WasmTrap, failure
from rosmop.form.compiled import Compiled
from rosmop.form.specification_groups import groups
from rosmop.run.explain import ClockedSteps, Exits
from rosmop.run.fast_path import MESSAGE_FUEL, BatchOptions, BatchResult, Lanes, NativeCall, NextDue, Pieces
from rosmop.run.interpreter import Interpreter
from rosmop.run.monitor import CellNames, MonitorInstance, RunningProperty
from rosmop.run.outcomes import FUEL_PER_SECOND, Outcome, Verdict
from rosmop.runtime.action_context import Context, LogLine
from rosmop.runtime.values import struct_code
from rosmop.runtime.wire import Buffer
from rosmop.types import value_types
from rosmop.types.value_types import Type, Value

FUEL = FUEL_PER_SECOND // 1000
"""The maximum number of instructions of one call: about a millisecond.

The rest is left for the next calls, because setting the fuel costs a quarter of a call. When the fuel is used up, the
batch pauses before the current message.
"""

BEGINNING = 8192
"""The maximum number of bytes that are copied from a frame outside the module's memory."""

_FIRST = 512  # bytes that are copied if they suffice: a large frame leaves cold caches

_NO_FUEL = "out of fuel"
_ADDRESS = 0xFFFFFFFF
_LENGTH = struct.Struct("<I")
_POSITION = struct.Struct("<II")
_EFFECT = struct.Struct("<qq")
_SPANS = struct.Struct("<QQ")
_LOG = struct.Struct("<II8s")
_PREPARED = struct.Struct("<4q")
_TIME = struct.Struct("<q")
_CLOCK = struct.Struct("<qq")
_NEVER = (1 << 63) - 1  # later than every time, so that output is due


class ModuleState:
    """Holds the state of specifications that share topics or variables, in the module's memory or in Python."""

    def __init__(
        self,
        machine: WasmInstance,
        cells: Cells,
        interpreter: Interpreter,
        running: Sequence[RunningProperty],
        throttles: Sequence[tuple[Context, int, int]],
        *,
        senders: Sequence[int] = (),
        due: NextDue,
        properties: Sequence[tuple[str, int]] = (),
        known: Mapping[str, tuple[str, str]] = MappingProxyType({}),
    ) -> None:
        """`throttles` has specification, site, and the address of the time when output there was last due.

        `senders` has the addresses of senders (`abi.SENDER`). `properties` and `known` have their keys by monitor.
        """
        self.machine = machine
        self._memory = machine.memory
        self._base = cells.base
        self._contexts, self._values = interpreter.contexts, interpreter.variables
        self._running = running
        self._throttles = throttles
        self._senders, self._turn = senders, interpreter.turn
        self._named: tuple[bytes, bytes] | None = None
        """The names that the module has of the sender."""
        variables = dict(sorted(cells.variables.items(), key=lambda item: item[1][0]))
        self._names = [*variables]
        self._addresses = {name: address for name, (address, _kind) in variables.items()}
        self._cells = struct.Struct(
            "<" + "q" * len(running) + "".join(cell_code(kind) for _, kind in variables.values())
        )
        self._strings = [
            (place, cells.texts[address], kind)
            for place, (address, kind) in enumerate(variables.values())
            if is_kept(kind)
        ]
        codes = "".join(cell_code(kind) for _, kind in variables.values())
        self.names = CellNames([*properties], [*map(known.get, variables)], codes, [*cells.clocks])
        self._end = cells.base + self._cells.size
        self._clocked = [*cells.clocks.values()]
        self.size = 0 if self._strings else self._cells.size + _CLOCK.size * len(self._clocked)
        self.left = False
        self._generation = cells.generation
        self._source, self._until = cells.source, cells.until
        self._clocks = [(running[number], address) for number, address in cells.clocks.items()]
        self._due = due
        self._inside = False
        self.prepared: BatchOptions | None = None
        """The options that the module was prepared with last; None while the state is in Python."""
        self._unprepare()

    def prepare(self, prepared: BatchOptions) -> None:
        if not self._inside:
            self._enter()
        self.prepared = prepared
        self.machine.refuel(FUEL)
        self._memory[self._source : self._source + _PREPARED.size] = pack_options(prepared)
        if not self._senders or (names := self._turn.names(prepared.source)) == self._named:
            return
        self._named = names
        for address in self._senders:
            room = address + _SPANS.size
            words = [
                put_value(self._memory, name, room + place * MAX_KEPT, value_types.STRING)
                for place, name in enumerate(names)
            ]
            _SPANS.pack_into(self._memory, address, *words)

    def _unprepare(self) -> None:
        """Note that the memory differs from what `pack_options` makes of all options."""
        self.prepared = None
        _PREPARED.pack_into(self._memory, self._source, *[-1] * 4)

    def _enter(self) -> None:
        states: list[int] = [running.run.state for running in self._running]  # type: ignore[attr-defined]  # of tables
        values = [self._values[name] for name in self._names]
        if self._generation:
            _LENGTH.pack_into(self._memory, self._generation, 0)
        for place, buffer, kind in self._strings:
            values[place] = put_value(self._memory, values[place], buffer, kind)
        self._cells.pack_into(self._memory, self._base, *states, *values)
        for context, site, address in self._throttles:
            _TIME.pack_into(self._memory, address, context.throttled.get(site, _NEVER))
        for running, address in self._clocks:
            run: Any = running.run
            _CLOCK.pack_into(self._memory, address, run.since, run.now)
        due = self._due(anew=False)
        _TIME.pack_into(self._memory, self._until, _NEVER if due is None else min(due - 1, _NEVER))
        self._inside = True

    def cells(self) -> bytes | None:
        if not self._inside and not self.left:
            return b""
        if self.left or not self.size:
            return None
        memory = self._memory
        cells = memory[self._base : self._end].tobytes()
        for address in self._clocked:
            cells += memory[address : address + _CLOCK.size]
        return cells

    @property
    def parts(self) -> list[tuple[int, int]] | None:
        if not self.size:
            return None if self._strings else []
        return [(self._base, self._cells.size), *((address, _CLOCK.size) for address in self._clocked)]

    @property
    def options(self) -> int:
        return self._source

    def hasten(self) -> None:
        self.leave()
        self._due(anew=True)

    def monitor_of(self, context: str) -> str:
        return self._contexts[context].monitor

    def leave(self) -> None:
        if self._inside:
            self.show()
            self._inside, self.left = False, True
            self._unprepare()

    def is_true(self, name: str) -> bool:
        if self._inside and name in self._addresses:
            return self._memory[self._addresses[name]] != 0
        return bool(self._values[name])

    def show(self) -> None:
        if not self._inside:
            return
        values = self._cells.unpack_from(self._memory, self._base)
        for running, state in zip(self._running, values, strict=False):
            running.run.state = state  # type: ignore[attr-defined]  # runs over tables
        for running, address in self._clocks:
            run: Any = running.run
            run.since, run.now = _CLOCK.unpack_from(self._memory, address)
        found = dict(zip(self._names, values[len(self._running) :], strict=True))
        for place, _, kind in self._strings:
            name = self._names[place]
            found[name] = take_value(self._memory, found[name], self._values[name], kind)
        self._values.update(found)


def pack_options(prepared: BatchOptions) -> bytes:
    sender = prepared.source << 32
    return _PREPARED.pack(sender, prepared.told, prepared.enabled, prepared.counted)


def put_value(memory: memoryview, value: Any, buffer: int, kind: Type) -> int:
    if len(value) > most_kept(kind):
        return BEYOND << 32
    if is_texts(kind):
        at, table = buffer + 4 * MAX_TEXTS, []
        if sum(4 + len(text) for text in value) > room_of(kind) - 4 * MAX_TEXTS:
            return BEYOND << 32
        for text in value:
            table.append(at)
            raw = _LENGTH.pack(len(text)) + text
            memory[at : at + len(raw)] = raw
            at += len(raw)
        struct.pack_into(f"<{len(value)}I", memory, buffer, *table)
    elif isinstance(kind, value_types.VectorType):
        struct.pack_into(f"<{len(value)}{struct_code(kind.element)}", memory, buffer, *value)
    else:
        memory[buffer : buffer + len(value)] = value
    return buffer | len(value) << 32


def take_value(memory: memoryview, word: int, before: Value, kind: Type) -> Value:
    at, count = word & _ADDRESS, word >> 32
    if count == BEYOND:
        return before
    if is_texts(kind):
        table = struct.unpack_from(f"<{count}I", memory, at)
        return [bytes(memory[text + 4 : text + 4 + _LENGTH.unpack_from(memory, text)[0]]) for text in table]
    if isinstance(kind, value_types.VectorType):
        return list(struct.unpack_from(f"<{count}{struct_code(kind.element)}", memory, at))
    return bytes(memory[at : at + count])


def cell_code(kind: Type) -> str:
    if is_kept(kind):
        return "Q"
    if isinstance(kind, value_types.BoolType):
        return "?7x"
    if isinstance(kind, value_types.IntegerType) and kind.bits <= 32:
        return "i4x" if kind.signed else "I4x"
    code = struct_code(kind) or ""
    return "q" if len(code) == 2 else "f4x" if code == "f" else code


class WasmLane:
    """Runs the module for one topic, or part of a service."""

    def __init__(
        self,
        home: ModuleState,
        module: CompiledModule,
        topic: str,
        monitors: Sequence[MonitorInstance],
        events: Sequence[str],
    ) -> None:
        self.topic, feed = topic, module.feeds[topic]
        self.brief, self.exhausted = feed.brief, False
        self.events = tuple((name,) for name in events)
        self.monitors = tuple(monitor.name for monitor in monitors)
        self.drops = feed.drops
        self.changes = feed.changes
        self._lines = [(line, home.monitor_of(line.context)) for line in module.lines] if feed.says else []
        self._said = module.said
        self._monitors = tuple(dict.fromkeys(monitors))
        self._sources = [(one, one.sources[topic]) for one in self._monitors if topic in one.sources]
        self._memory = home.machine.memory  # it does not grow
        self._owner = self._memory.obj
        self._feed = feed
        self._frames = module.frames
        self._machine = home.machine
        self._shown = _FIRST
        self._effects = module.effects + _EFFECT.size
        self._home = home
        self.verdicts = tuple(
            _verdict(monitors[event], place, category) for event, place, category in feed.verdicts
        )
        self._counts = struct.Struct(f"<{len(events)}q")
        self._none = (0,) * len(events)
        self._later = struct.Struct(f"<{len(events) + len(feed.verdicts)}q")
        self._before: Sequence[int] = (0,) * (len(events) + len(feed.verdicts))
        self._call = home.machine.function(feed.name)
        self._settle = home.machine.function(feed.settle) if feed.settle else None

    def writers(self, who: int) -> tuple[str, ...]:
        return tuple(name for number, (name,) in enumerate(self.events) if who >> number & 1)

    def take_events(self) -> Sequence[int]:
        counts: Sequence[int] = self._counts.unpack_from(self._memory, self._feed.counters)
        self._counts.pack_into(self._memory, self._feed.counters, *self._none)
        return counts

    def ready(self) -> bool:
        for monitor in self._monitors:
            if monitor.enabled and (not monitor.seen or self.topic in monitor.starting or monitor.blocks):
                if monitor.seen and self.topic not in (*monitor.starting, *monitor.held_channels):
                    continue  # it only observes this topic, and goes on to
                return False
        return not any(
            (source.waits or source.speakers) and monitor.enabled for monitor, source in self._sources
        )

    def prepare(
        self,
        *,
        loud: bool,
        told: Sequence[bool],
        counted: Sequence[bool] = (),
        source: int = 0,
        changed: dict[int, int] | None = None,
    ) -> BatchOptions:
        bits = sum(1 << number for number, silent in enumerate(told) if silent) - (LOUD if loud else 0)
        enabled = sum(1 << number for number, monitor in enumerate(self._monitors) if monitor.enabled)
        only = sum(1 << number for number, silent in enumerate(counted) if silent)
        return BatchOptions(source, bits, enabled, only, {} if changed is None else changed)

    def process_batch(  # noqa: PLR0912, PLR0917  called for every batch: calls and keywords would cost a tenth of it
        self,
        view: memoryview,
        position: int,
        run: int,
        pieces: Pieces,
        time_ns: int,
        prepared: BatchOptions,
        answer: int | Exception | None = None,
    ) -> BatchResult | None:
        if view.obj is not self._owner:
            return self._process_elsewhere(view, position, run, pieces, time_ns, prepared)
        if self._home.prepared is not prepared:
            self._home.prepare(prepared)
        frames = self._frames
        end = frames + len(view)
        begun, said = run, 0
        output: list[tuple[int, LogLine]] = []
        paused = False
        while True:
            try:
                if answer is None:
                    answer = self._call(frames + position, end, time_ns) or 0
                elif isinstance(answer, Exception):
                    raise answer
            except WasmTrap as trap:
                paused = trap.reason == _NO_FUEL
                answer = self._stopped(frames + position, end, time_ns)
            said |= answer
            if self._lines:
                self._put_out(output)
            if answer >= LEFT:
                self._undo()
            effects = (answer >> 32 & 0xFFFFFF) * _EFFECT.size
            if effects:
                for who, what in _EFFECT.iter_unpack(self._memory[self._effects : self._effects + effects]):
                    if who != -1:
                        prepared.changed[who] = prepared.changed.get(who, 0) + what
                        continue
                    first = (what & _ADDRESS) - frames
                    if first > run:
                        pieces.append(view[run:first])
                    run = (what >> 32) - frames
            if answer & _ADDRESS == end and run == begun and said < TOLD and not output:
                return None
            position = (answer & _ADDRESS) - frames
            sooner = bool(answer & SOONER)
            if answer >= LEFT or position == len(view) or sooner:
                if sooner:
                    self._home.hasten()
                dropped, told = self._counted() if run != begun or said & TOLD else ((), ())
                paused = answer >= LEFT and (paused or self._overspent())
                return BatchResult(position, run, dropped, told, sooner, output, paused)
            answer = None

    def native(self) -> NativeCall | None:
        cells = self._home.parts
        if cells is None:
            return None
        invoke, context, function, keeps = self._machine.native(self._feed.name)
        output = self._said if self._lines else 0
        return NativeCall(
            invoke,
            context,
            function,
            self._memory,
            self._frames,
            self._effects,
            output,
            SURE,
            self._home.options,
            cells,
            self._home,
            pack_options,
            failure,
            keeps,
        )

    def process_one(  # noqa: PLR0917  as `process_batch`
        self,
        view: memoryview,
        position: int,
        run: int,
        pieces: Pieces,
        time_ns: int,
        prepared: BatchOptions,
        fuel: int = MESSAGE_FUEL,
    ) -> BatchResult:
        following = position + 4 + _LENGTH.unpack_from(view, position)[0]
        if self._home.prepared is not prepared:
            self._home.prepare(prepared)
        self._machine.refuel(fuel)
        walked = self.process_batch(view[:following], position, run, pieces, time_ns, prepared)
        self._machine.refuel(FUEL)
        return BatchResult(following, run, ()) if walked is None else walked

    def process_message(
        self, message: Buffer, time_ns: int, prepared: BatchOptions, fuel: int = MESSAGE_FUEL
    ) -> Outcome | None:
        end = self._frames + 4 + len(message)
        self.exhausted = False
        if end > self._frames + AREA:
            return None
        frame = self._memory[self._frames : end]
        _LENGTH.pack_into(frame, 0, len(message))
        frame[4:] = message
        prepared.changed.clear()
        walked = self.process_one(frame, 0, 0, [], time_ns, prepared, fuel)
        self.exhausted = walked.paused
        if not walked.position:
            return None
        outcome = Outcome(message, time_ns)
        happened = zip(self.events, self.take_events(), strict=True)
        outcome.events = tuple([name for (name,), count in happened if count])
        for who in prepared.changed:
            outcome.result, outcome.buffer, outcome.changed_by = (
                "changed",
                bytes(frame[4:]),
                self.writers(who),
            )
        outcome.log = [line for _, line in walked.output]
        counts = zip(self.verdicts, walked.told, strict=False)  # `told` may be empty
        outcome.verdicts = tuple(verdict for verdict, count in counts for _ in range(count))
        return outcome

    def judge(
        self, message: Buffer, time_ns: int, judging: Collection[MonitorInstance], source: int, fuel: int
    ) -> Outcome | None:
        enabled = sum(1 << number for number, monitor in enumerate(self._monitors) if monitor in judging)
        prepared = self.prepare(loud=True, told=[True] * len(self.events), source=source)
        earlier = self.take_events()  # of batches, which are counted later
        area = self._memory[self._frames : self._frames + min(4 + len(message), AREA)]
        kept = bytes(area) if self._holds(message) else b""  # other frames of its batch
        try:
            return self.process_message(message, time_ns, prepared._replace(enabled=enabled), fuel)
        finally:
            area[: len(kept)] = kept
            self._counts.pack_into(self._memory, self._feed.counters, *earlier)

    def whole(self, message: Buffer) -> bool:
        return self._holds(message) or 4 + len(message) <= BEGINNING

    def _holds(self, message: Buffer) -> bool:
        return isinstance(message, memoryview) and message.obj is self._owner

    def _process_elsewhere(  # noqa: PLR0917  as `process_batch`
        self,
        view: memoryview,
        position: int,
        run: int,
        pieces: Pieces,
        time_ns: int,
        prepared: BatchOptions,
    ) -> BatchResult:
        dropped: Sequence[int] = ()
        told: Sequence[int] = ()
        output: list[tuple[int, LogLine]] = []
        sooner = paused = False
        while position < len(view) and not sooner:
            following = position + 4 + _LENGTH.unpack_from(view, position)[0]
            frame = view[position:following]
            walked = self._process_beginning(frame, self._shown, time_ns, prepared)
            if (
                walked is not None
                and not (walked.position or walked.paused)
                and self._shown < min(len(frame), BEGINNING)
            ):
                walked = self._process_beginning(frame, BEGINNING, time_ns, prepared)
                if walked is None or walked.position:
                    self._shown = BEGINNING
            if walked is not None:
                if not walked.position:
                    paused = walked.paused
                    break
                sooner = walked.sooner
                told = _sums(told, walked.told)
                output += [(position, each) for _, each in walked.output]
                if walked.run:
                    if position > run:
                        pieces.append(view[run:position])
                    run = following
                    dropped = _sums(dropped, walked.dropped)
            position = following
        return BatchResult(position, run, dropped, told, sooner, output, paused)

    def _process_beginning(
        self, frame: memoryview, shown: int, time_ns: int, prepared: BatchOptions
    ) -> BatchResult | None:
        size, before = min(len(frame), shown), prepared.changed.copy()
        area = self._memory[self._frames : self._frames + size]
        area[4:] = frame[4:size]
        _LENGTH.pack_into(area, 0, size - 4)
        _TIME.pack_into(self._memory, REST, len(frame) - size)
        try:
            walked = self.process_batch(area, 0, 0, [], time_ns, prepared)
        finally:
            _TIME.pack_into(self._memory, REST, 0)
        if prepared.changed != before:
            frame[4:size] = area[4:]
        return walked

    def _put_out(self, output: list[tuple[int, LogLine]]) -> None:
        at, end = self._said, _LENGTH.unpack_from(self._memory, SURE)[0]
        while at < end:
            number, frame = HEAD.unpack_from(self._memory, at)
            line, monitor = self._lines[number]
            output.append((frame - self._frames, line.put_out(self._memory, at, monitor)))
            at += line.size

    def _stopped(self, *call: int) -> int:
        """Return the result of a stopped call: the current message is left.

        If no message had begun, earlier calls have used up the fuel, so the module is called again.
        """
        self._home.machine.refuel(FUEL)
        at, effect = _POSITION.unpack_from(self._memory, POSITION)
        if at:
            _POSITION.pack_into(self._memory, POSITION, 0, effect)
            effects = (effect + _EFFECT.size - self._effects) // _EFFECT.size
            return int(at | effects << 32 | LEFT | TOLD | SOONER)  # there may be an earlier deadline
        try:
            return self._call(*call) or 0
        except WasmTrap:
            return self._stopped(*call)

    def _overspent(self) -> bool:
        return any(_TIME.unpack_from(self._memory, address)[0] < 0 for address in self._feed.budgets)

    def _undo(self) -> None:
        memory = self._memory
        for address, kept in self._feed.undo:
            memory[address : address + 8] = memory[kept : kept + 8]
        end = _LENGTH.unpack_from(memory, UNDO)[0]
        for at, size, old in [*_LOG.iter_unpack(memory[self._feed.log : end])][::-1]:
            memory[at : at + size] = old[:size]
        if self._settle is not None:
            self._home.machine.refuel(FUEL)
            self._settle()

    def _counted(self) -> tuple[Sequence[int], Sequence[int]]:
        counts = self._later.unpack_from(self._memory, self._feed.counters + self._counts.size)
        before, self._before = self._before, counts
        more = [now - then for now, then in zip(counts, before, strict=True)]
        return more[: len(self.events)], more[len(self.events) :]


def _sums(one: Sequence[int], other: Sequence[int]) -> Sequence[int]:
    return [sum(counts) for counts in zip_longest(one, other, fillvalue=0)]


def _verdict(monitor: MonitorInstance, place: int, handler: int) -> Verdict:
    code = monitor.properties[place].code
    source = code.property.source
    return Verdict(monitor.name, monitor.properties[place].index, source.logic, code.order[handler], source)


class WasmFastPath:
    """Runs the module of a set."""

    def __init__(self, module: CompiledModule) -> None:
        self._module = module

    def lanes(
        self, compiled: Compiled, interpreter: Interpreter, monitors: Sequence[MonitorInstance], due: NextDue
    ) -> Lanes:
        module = self._module
        if not module.feeds:
            return Lanes()
        found = list(groups(compiled.specifications))
        machine = WasmInstance(module.code, module.memory)
        walks: dict[str, WasmLane] = {}
        for group, cells in zip(found, module.cells, strict=True):
            running = [monitors[number].properties[index] for number, index in group.properties]
            for number, address in cells.exits.items():
                kept = running[number].history
                assert isinstance(kept, Exits | ClockedSteps)  # noqa: S101  it has tables
                kept.move(machine, machine.memory[address:])
            contexts = {compiled.specifications[number].context for number in group.specifications}
            throttles = [
                (interpreter.contexts[context], site, address)
                for (context, site), address in module.throttles.items()
                if context in contexts
            ]
            specifications = [compiled.specifications[number] for number in group.specifications]
            home = ModuleState(
                machine,
                cells,
                interpreter,
                running,
                throttles,
                senders=[address for context, address in module.senders.items() if context in contexts],
                due=due,
                properties=[(monitors[number].name, index) for number, index in group.properties],
                known={
                    code: (one.name, name) for one in specifications for name, code in one.variables.items()
                },
            )
            for number in group.specifications:
                monitors[number].home = home
            for (topic, _), events in zip(group.component.topics, group.events, strict=True):
                if topic in module.feeds:
                    own = [monitors[number] for number, _ in events]
                    names = [
                        f"{monitors[number].name}.{monitors[number].code.events[index].name}"
                        for number, index in events
                    ]
                    walks[topic] = WasmLane(home, module, topic, own, names)
        return Lanes(walks, machine.memory[module.frames : module.frames + AREA])
