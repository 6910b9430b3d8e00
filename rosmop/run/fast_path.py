"""The interface between the engine and compiled code (`rosmop/fast/wasm_runner.py`)."""

from collections.abc import Callable, Collection, Mapping, Sequence
from types import MappingProxyType
from typing import Literal, NamedTuple, Protocol

from rosmop.form.compiled import Compiled
from rosmop.run.interpreter import Interpreter
from rosmop.run.monitor import MonitorInstance
from rosmop.run.outcomes import FUEL_PER_SECOND, Outcome, Verdict
from rosmop.runtime.action_context import LogLine
from rosmop.runtime.wire import Buffer

MESSAGE_FUEL = FUEL_PER_SECOND // 100

Tried = Literal["", "left", "over"]
"""Whether a lane has left a message to the engine, or had not enough fuel for it."""


class BatchResult(NamedTuple):
    position: int
    """The offset of the first message that was not processed."""
    run: int
    """The offset after the last dropped message."""
    dropped: Sequence[int]
    """The dropped messages for each event of the lane; empty if all counts are zero."""
    told: Sequence[int] = ()
    """The verdicts; empty if all counts are zero."""
    sooner: bool = False
    """Whether a deadline is earlier than before."""
    output: Sequence[tuple[int, LogLine]] = ()
    """The printed lines in order, each with the offset of its message."""
    paused: bool = False
    """Whether the fuel, or a budget of instructions, is used up. The next batch may begin with the message at
    `position`.
    """


class BatchOptions(NamedTuple):
    """The options of all batches of a topic until the state of the engine changes.

    `told`, `enabled` and `counted` are bits for the module; `told` also has a bit for whether messages may be
    changed. Batches count in `changed` how many messages each set of events has changed (see `FastLane.writers`).
    """

    source: int
    told: int
    enabled: int
    counted: int
    changed: dict[int, int]


class PreparedState(Protocol):
    """The state of specifications, as the caller of `NativeCall` uses it."""

    def prepare(self, prepared: BatchOptions) -> None:
        """Move the state into the module, and set the options of the next batch."""


class NativeCall(NamedTuple):
    """The addresses with which compiled code passes frames through a lane without Python.

    `invoke` is wasmtime's `wasmtime_func_call_unchecked`, to be called with `context`, `function` and three
    slots of 16 bytes: the address of the first frame in the module, the address after the last one, and the
    time (ns). Its result is the module's answer (`rosmop.fast.abi`). If it returns an error, or a trap,
    `failure(error, trap)` frees them and returns the exception for the lane. If the bytes at `options` are
    not `packed(options)` of the batch, call `home.prepare` first.

    The other fields are offsets in `memory`, which does not grow: of the frames, of the first effect, of the
    lines of output (0: the lane prints nothing) and of the word with their end, and offset and size of each
    part of the state.
    """

    invoke: int
    context: int
    function: int
    memory: memoryview
    frames: int
    effects: int
    output: int
    sure: int
    options: int
    cells: Sequence[tuple[int, int]]
    home: PreparedState
    packed: Callable[[BatchOptions], bytes]
    failure: Callable[[int, int], Exception]
    keeps: object


class NextDue(Protocol):
    """Returns the time of the next tick or deadline (ns), or None."""

    def __call__(self, *, anew: bool) -> int | None:
        """If `anew`, compute the time again, since a deadline may now be earlier."""


class Pieces(Protocol):
    """A list of parts of messages, which also takes parts of a buffer."""

    def append(self, piece: memoryview, /) -> None: ...


class FastLane(Protocol):
    """Processes the messages of one topic, or part of a service, many at a time."""

    topic: str

    brief: bool
    """Whether the code has no loops, so that a message in the engine takes little time as well."""

    events: tuple[tuple[str], ...]
    """The value of `Outcome.events` for each event, if it happens alone."""

    monitors: tuple[str, ...]

    drops: bool

    changes: bool

    verdicts: tuple[Verdict, ...]

    def writers(self, who: int) -> tuple[str, ...]:
        """Return `Outcome.changed_by` for a set of events: bit N is event N."""

    def take_events(self) -> Sequence[int]:
        """Return the events since the last call."""

    def ready(self) -> bool:
        """Whether no monitor waits for its first message, or holds its topics."""

    def prepare(
        self,
        *,
        loud: bool,
        told: Sequence[bool],
        counted: Sequence[bool] = (),
        source: int = 0,
        changed: dict[int, int] | None = None,
    ) -> BatchOptions:
        """Return options that are valid until the next action of the engine.

        If `loud`, no message may be changed. `told` lists the events that may not drop a message, `counted` the
        verdicts that are only counted.
        """

    def process_batch(  # noqa: PLR0917  called for every batch: calls and keywords would cost a tenth of it
        self,
        view: memoryview,
        position: int,
        run: int,
        pieces: Pieces,
        time_ns: int,
        prepared: BatchOptions,
        answer: int | Exception | None = None,
    ) -> BatchResult | None:
        """Process messages until one needs the engine. Return None if all are processed and stay in their buffer.

        `answer` is the module's answer, or the exception, if it was already called for these messages
        (`native`). Call this only while the lane is `ready` and nothing in the set is due. `view` has whole
        frames and is writable. It is in other memory, or begins like `Lanes.area`. Bytes before a dropped
        message are appended to `pieces`.
        """

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
        """`paused` means that the fuel was not enough."""

    def native(self) -> NativeCall | None:
        """Return how to call the module for batches in `Lanes.area`, or None if its state is more than numbers."""

    def process_message(
        self, message: Buffer, time_ns: int, prepared: BatchOptions, fuel: int = MESSAGE_FUEL
    ) -> Outcome | None:
        """Return None for a message left to the engine. Verdicts are not explained, and changes have no positions.

        The conditions are those of `process_batch`. Use separate options for this method, and do not call
        `take_events`.
        """

    exhausted: bool
    """Whether the fuel was not enough for the last message of `process_message` or `judge`."""

    def judge(
        self, message: Buffer, time_ns: int, judging: Collection[MonitorInstance], source: int, fuel: int
    ) -> Outcome | None:
        """Process a message for some of the monitors. Return None for a message left to the engine.

        The lane need not be `ready`, but nothing may be due. A message that a monitor would drop or change, or that
        gives a verdict, is left.
        """

    def whole(self, message: Buffer) -> bool:
        """Whether `process_batch` sees all of a message in this buffer."""


class Lanes(NamedTuple):
    """The lanes of a set by `EventCode.channel`, and the memory to receive frames in."""

    of_topic: Mapping[str, FastLane] = MappingProxyType({})
    area: memoryview | None = None


class FastPath(Protocol):
    """Compiled code for the specifications of one set."""

    def lanes(
        self, compiled: Compiled, interpreter: Interpreter, monitors: Sequence[MonitorInstance], due: NextDue
    ) -> Lanes:
        """Return the lanes, and set `home` of each monitor whose state a lane takes over."""
