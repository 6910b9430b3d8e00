"""The door between the engine and compiled code: the engine knows the types of this file only.

The caller that makes a `MonitorSet` makes the implementation (`rosmop/fast/wasm_runner.py`) and hands it in.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol

from rosmop.form.compiled import Compiled
from rosmop.run.interpreter import Interpreter
from rosmop.run.monitor import Monitor
from rosmop.run.outcomes import Outcome, Verdict
from rosmop.runtime.action_context import FUEL_PER_SECOND, LogLine
from rosmop.runtime.wire import Buffer

MESSAGE_FUEL = FUEL_PER_SECOND // 100
"""Instructions of one message at most, unless a caller of `walk_one` has others."""


class Walked(NamedTuple):
    """The result of one walk.

    `position` is the offset of the first message that was not processed. `run` is the offset behind the last dropped
    message. `dropped` counts dropped messages for each event of the lane, `told` verdicts for each verdict of the
    lane; both are empty if there were none. `sooner`: a deadline is earlier than before. `output` has the lines that
    were printed, in order, each with the offset of its message.
    `paused`: the walk used up its fuel; the next walk may begin with the message at `position`.
    """

    position: int
    run: int
    dropped: Sequence[int]
    told: Sequence[int] = ()
    sooner: bool = False
    output: Sequence[tuple[int, LogLine]] = ()
    paused: bool = False


class Prepared(NamedTuple):
    """The arguments of all walks of a topic until the state of the engine changes.

    `source` is the sender of the messages. `told`, `enabled` and `counted` are bits as the module takes them; `told`
    includes whether messages may be changed. Walks count in `changed` how many messages each set of events (see
    `FastLane.writers`) has changed.
    """

    source: int
    told: int
    enabled: int
    counted: int
    changed: dict[int, int]


class Due(Protocol):
    """Returns the time of the next tick or deadline (ns; None if there is none)."""

    def __call__(self, *, anew: bool) -> int | None:
        """`anew`: compute the time again, because there may be an earlier deadline."""


class FastLane(Protocol):
    """Processes the messages of one topic, or part of a service, many at a time."""

    events: tuple[tuple[str], ...]
    """For each event: what outcomes have as `events` where only it happens."""

    monitors: tuple[str, ...]
    """For each event: the name of its monitor."""

    drops: bool
    """Whether messages may be dropped."""

    changes: bool
    """Whether messages may be changed."""

    verdicts: tuple[Verdict, ...]
    """The verdicts that it may come to, not explained."""

    def writers(self, who: int) -> tuple[str, ...]:
        """Return what outcomes have as `changed_by`, from a set of events: bit N stands for event N."""

    def happened(self) -> Sequence[int]:
        """Return how often each event has happened since this was last asked."""

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
    ) -> Prepared:
        """See `Prepared`: while `loud` no message may be changed; `told` says for each event whether it may drop none,
        `counted` for each verdict whether there may be more. Good until the engine is asked for anything.
        """

    def walk(  # noqa: PLR0917  called for every batch: calls and keywords would cost a tenth of it
        self, view: memoryview, position: int, run: int, pieces: list[Any], time_ns: int, prepared: Prepared
    ) -> Walked | None:
        """Take messages from `position` on, as many as need nothing special. None: all, and all go on in their buffer.

        Only while the lane is `ready` and nothing of the set is due. `view` has whole frames and can be written: the
        beginning of `Lanes.area`, or others. What goes on before a dropped message is appended to `pieces`.
        """

    def walk_one(  # noqa: PLR0917  as `walk`
        self,
        view: memoryview,
        position: int,
        run: int,
        pieces: list[Any],
        time_ns: int,
        prepared: Prepared,
        fuel: int = MESSAGE_FUEL,
    ) -> Walked:
        """Take only the message at `position`, with so much fuel; `paused`: it was not enough."""

    def take(
        self, message: Buffer, time_ns: int, prepared: Prepared, fuel: int = MESSAGE_FUEL
    ) -> Outcome | None:
        """Return what is to be done with one message; None if it is left. Verdicts are not explained, and it is not
        said where it was changed.

        Only as `walk`, with what is prepared for this alone, and where nobody asks what has `happened`.
        """


class Lanes(NamedTuple):
    """The lanes of a set by topic (see `EventCode.way`), and the memory to receive frames into, if there is one."""

    of_topic: Mapping[str, FastLane] = MappingProxyType({})
    area: memoryview | None = None


class FastPath(Protocol):
    """Compiled code for the specifications of one set."""

    def lanes(
        self, compiled: Compiled, interpreter: Interpreter, monitors: Sequence[Monitor], due: Due
    ) -> Lanes:
        """Return the lanes that process messages of these monitors; set `home` of the monitors whose state they take.

        A topic without a lane is processed by the engine.
        """
