"""Runs the loops that take whole batches (`compile/batch.py`): when they may, and what they have done.

Invariants:
- A walk ends before the first message that needs the engine; of that message nothing has happened yet.
- What a walk has done to the messages before is what `MonitorSet.process` does to them, one after the other, at the
  time of the walk: bytes, variables, states of properties, which events happened.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

from appliance.rosmop.compile.batch import BatchCode, batches
from appliance.rosmop.compile.shapes import Layout, Shape
from appliance.rosmop.compile.specification import Compiled
from appliance.rosmop.logics.interface import Run
from appliance.rosmop.monitor import Monitor, RunningProperty
from appliance.rosmop.runtime.context import Turn

FILENAME = "<batches>"
MAX_LAYOUTS = 64
"""Lengths of messages for which the way to read them is kept."""


class Walked(NamedTuple):
    """What a walk has done.

    `position` is where the first message begins that is left; `run` where what goes on unchanged begins (behind the
    last dropped message). `happened` and `dropped` are counts for each of the walker's events; `changed` has a set of
    events (see `Walker.writers`) and how many messages they changed together, for each run of such messages.
    """

    position: int
    run: int
    happened: Sequence[int]
    dropped: Sequence[int]
    changed: Sequence[tuple[int, int]]


_Loop = Callable[..., tuple[int, int, Sequence[int], Sequence[int], Sequence[tuple[int, int]]]]


class Prepared(NamedTuple):
    """What holds for all walks of a topic until the engine, or somebody else, has done something.

    `loud`: no message may be changed. `told`: for each event whether it may drop none. `enabled` and `runs` are the
    monitors' and the properties' at the moment.
    """

    loud: bool
    told: Sequence[bool]
    enabled: Sequence[bool]
    runs: Sequence[Run]


class Walker:
    """The loops of one topic, with what they are handed."""

    def __init__(self, code: BatchCode, compiled: Compiled, monitors: Sequence[Monitor]) -> None:
        self.topic = code.topic
        self.events = tuple((event.name,) for event in code.events)
        """For each event: what outcomes have as `events` where only it happens."""
        self.monitors = tuple(monitors[event.specification].name for event in code.events)
        """For each event: the name of its monitor."""
        self.drops = bool(code.droppers)
        """Whether messages may be dropped."""
        self.changes = bool(code.writers)
        """Whether messages may be changed."""
        self._monitors = tuple(monitors[number] for number in code.specifications)
        self._running: tuple[RunningProperty, ...] = tuple(
            monitors[number].properties[index] for number, index in code.properties
        )
        self._turn: Turn = compiled.turn
        self._alone: _Loop = compiled.namespace[code.alone]
        self._alike: _Loop | None = compiled.namespace[code.alike] if code.alike is not None else None
        self._shape: Shape | None = code.shape
        self._layouts: dict[tuple[int, tuple[int, ...]], Layout | None] = {}

    def writers(self, who: int) -> tuple[str, ...]:
        """What outcomes have as `changed_by`, from a set of events: bit N stands for event N."""
        return tuple(name for number, (name,) in enumerate(self.events) if who >> number & 1)

    def ready(self) -> bool:
        """Whether no monitor waits for its first message, or holds its topics."""
        for monitor in self._monitors:  # noqa: SIM110  for each batch: half the price of a generator
            if monitor.enabled and (monitor.held or not monitor.seen):
                return False
        return True

    def prepare(self, *, loud: bool, told: Sequence[bool]) -> Prepared:
        """See `Prepared`; good until the engine is asked for anything."""
        return Prepared(
            loud,
            told,
            [monitor.enabled for monitor in self._monitors],
            [running.run for running in self._running],
        )

    def walk(  # noqa: PLR0917  called for every batch: keywords would cost a tenth of it
        self,
        view: memoryview,
        position: int,
        run: int,
        pieces: list[Any],
        stride: int,
        time_ns: int,
        prepared: Prepared,
    ) -> Walked:
        """Take messages from `position` on, as many as need nothing special.

        Only while the walker is `ready` and nothing of the set is due. `view` has whole frames and can be written;
        `stride` is the size of each, if they are all of one size, else 0. What goes on before a dropped message is
        appended to `pieces`.
        """
        self._turn.now = time_ns
        end = len(view)
        layout = self._layout(view, position, stride) if stride else None
        if layout is None or self._alike is None:
            return Walked._make(self._alone(view, position, end, run, pieces, *prepared))
        frames = (layout.frames.iter_unpack(view[position:]), stride, layout.lengths, layout.written)
        first = Walked._make(self._alike(view, position, end, run, pieces, *prepared, *frames))
        if first.position == end:
            return first
        second = Walked._make(self._alone(view, first.position, end, first.run, pieces, *prepared))
        return second if first.position == position else _together(first, second)

    def _layout(self, view: memoryview, position: int, stride: int) -> Layout | None:
        shape = self._shape
        if shape is None:
            return None
        lengths = shape.lengths_of(view[position + 4 : position + stride]) if shape.lengths else ()
        if lengths is None:
            return None
        key = (stride, lengths)
        if key not in self._layouts:
            if len(self._layouts) >= MAX_LAYOUTS:
                self._layouts.clear()
            self._layouts[key] = shape.layout(stride, lengths)
        return self._layouts[key]


def walkers(compiled: Compiled, monitors: Sequence[Monitor]) -> dict[str, Walker]:
    """The walkers of all topics that can have one."""
    namespace = compiled.namespace
    namespace |= {"w_put": _put, "x_exception": Exception, "x_repeated": _repeated}
    found = {}
    for code, source in batches(compiled.module, compiled.specifications):
        try:
            program = compile(source, FILENAME, "exec", dont_inherit=True, optimize=0)
        except (SyntaxError, RecursionError, MemoryError, OverflowError):
            continue  # more than Python takes: the engine needs no loop
        exec(program, namespace)  # noqa: S102  our own code: see the head of `compile`
        found[code.topic] = Walker(code, compiled, monitors)
    return found


def _together(one: Walked, other: Walked) -> Walked:
    """Two walks, one after the other."""
    return Walked(
        other.position,
        other.run,
        [a + b for a, b in zip(one.happened, other.happened, strict=True)],
        [a + b for a, b in zip(one.dropped, other.dropped, strict=True)],
        (*one.changed, *other.changed),
    )


def _put(buffer: memoryview, at: int, old: bytes) -> None:
    """Put bytes back; called as a `pack_into` is."""
    buffer[at : at + len(old)] = old


def _repeated(undo: Sequence[tuple[object, memoryview, int, object, int]]) -> bool:
    """Whether a byte was written more than once, so that the message may be as it was."""
    areas = sorted((at, at + size) for _, _, at, _, size in undo)
    return any(end > start for (_, end), (start, _) in pairwise(areas))
