"""The interface between the engine and compiled code: the engine uses only the types of this file.

The caller that makes a `MonitorSet` makes the implementation (`rosmop/fast/wasm_runner.py`) and hands it in.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol

from rosmop.form.compiled import Compiled
from rosmop.run.interpreter import Interpreter
from rosmop.run.monitor import MonitorInstance
from rosmop.run.outcomes import Outcome, Verdict
from rosmop.runtime.action_context import FUEL_PER_SECOND, LogLine
from rosmop.runtime.wire import Buffer

MESSAGE_FUEL = FUEL_PER_SECOND // 100
"""Most instructions for one message, unless `process_one` gets another number."""


class BatchResult(NamedTuple):
    """The result of one batch.

    `position` is the offset of the first message that was not processed, `run` the offset after the last dropped
    message. `dropped` counts dropped messages for each event of the lane, `told` verdicts for each verdict of the lane;
    both are empty if there were none. `sooner`: a deadline is earlier than before. `output` has the printed lines, in
    order, each with the offset of its message. `paused`: the batch used up its fuel; the next one may begin with the
    message at `position`.
    """

    position: int
    run: int
    dropped: Sequence[int]
    told: Sequence[int] = ()
    sooner: bool = False
    output: Sequence[tuple[int, LogLine]] = ()
    paused: bool = False


class BatchOptions(NamedTuple):
    """The options of all batches of a topic until the state of the engine changes.

    `source` is the sender of the messages. `told`, `enabled` and `counted` are bits for the module; `told` includes
    whether messages may be changed. Batches count in `changed` the messages that each set of events (see
    `FastLane.writers`) has changed.
    """

    source: int
    told: int
    enabled: int
    counted: int
    changed: dict[int, int]


class NextDue(Protocol):
    """Returns the time of the next tick or deadline (ns; None if there is none)."""

    def __call__(self, *, anew: bool) -> int | None:
        """With `anew`, compute the time again, because there may be an earlier deadline."""


class FastLane(Protocol):
    """Processes the messages of one topic, or part of a service, many at a time."""

    events: tuple[tuple[str], ...]
    """For each event: `Outcome.events` if only this one happens."""

    monitors: tuple[str, ...]
    """For each event: the name of its monitor."""

    drops: bool
    """Whether messages may be dropped."""

    changes: bool
    """Whether messages may be changed."""

    verdicts: tuple[Verdict, ...]
    """The possible verdicts, without explanation."""

    def writers(self, who: int) -> tuple[str, ...]:
        """Return `Outcome.changed_by` for a set of events: bit N stands for event N."""

    def happened(self) -> Sequence[int]:
        """Return how often each event has happened since the last call."""

    def ready(self) -> bool:
        """Return whether no monitor waits for its first message, or holds its topics."""

    def prepare(
        self,
        *,
        loud: bool,
        told: Sequence[bool],
        counted: Sequence[bool] = (),
        source: int = 0,
        changed: dict[int, int] | None = None,
    ) -> BatchOptions:
        """Return the options, valid until the engine does anything. If `loud`, no message may be changed; `told` has
        the events that may drop none, `counted` the verdicts that are only counted.
        """

    def process_batch(  # noqa: PLR0917  called for every batch: calls and keywords would cost a tenth of it
        self,
        view: memoryview,
        position: int,
        run: int,
        pieces: list[Any],
        time_ns: int,
        prepared: BatchOptions,
    ) -> BatchResult | None:
        """Process messages from `position` on, up to the first that needs the engine. Return None if it processed all
        and all stay in their buffer.

        Call it only while the lane is `ready` and nothing of the set is due. `view` has whole frames and is writable:
        the beginning of `Lanes.area`, or other memory. Bytes before a dropped message are appended to `pieces`.
        """

    def process_one(  # noqa: PLR0917  as `process_batch`
        self,
        view: memoryview,
        position: int,
        run: int,
        pieces: list[Any],
        time_ns: int,
        prepared: BatchOptions,
        fuel: int = MESSAGE_FUEL,
    ) -> BatchResult:
        """Process only the message at `position`, with this fuel; `paused` in the result: the fuel was not enough."""

    def process_message(
        self, message: Buffer, time_ns: int, prepared: BatchOptions, fuel: int = MESSAGE_FUEL
    ) -> Outcome | None:
        """Process one message; return None if it is left. Verdicts are not explained, positions of changes not
        reported.

        The conditions are those of `process_batch`, with options for this use only; do not call `happened`.
        """


class Lanes(NamedTuple):
    """The lanes of a set by topic (see `EventCode.channel`), and the memory to receive frames into, if there is one."""

    of_topic: Mapping[str, FastLane] = MappingProxyType({})
    area: memoryview | None = None


class FastPath(Protocol):
    """Compiled code for the specifications of one set."""

    def lanes(
        self, compiled: Compiled, interpreter: Interpreter, monitors: Sequence[MonitorInstance], due: NextDue
    ) -> Lanes:
        """Return the lanes that process messages of these monitors; set `home` of the monitors whose state they take.

        A topic without a lane is processed by the engine.
        """
