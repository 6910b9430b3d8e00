"""The bounds of one specification's actions, and what they hand out: log lines, published messages, faults.

Invariants:

1. Between two calls of `begin` a specification spends at most its budget of instructions; loops, calls, copies of
   anything long and walks over many elements of a message are charged before they are done. Where processor time is
   bounded (`Turn.limit`), it is read every `STEP` instructions, and every `PART` elements of a walk or a copy.
2. The values of a specification never hold more than `MAX_BYTES` plus `UNMEASURED` bytes. Whatever makes
   something long says so to `allocate`; when enough has been said, the live values are measured.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from typing import Any, NamedTuple

BUDGET = 1_000_000
"""Instructions that a specification may spend on one message."""

TRIAL_BUDGET = 100_000
"""Instructions that a specification on trial may spend on one message: what waits meanwhile waits some tens of
milliseconds.
"""

FUEL_PER_SECOND = 1_500_000_000
"""Instructions of a module that take about a second."""

STEP = 250
"""Instructions between two readings of the processor time."""

PART = 250
"""Elements that are walked or made between two readings of the processor time."""

_AT_ONCE = 10e-9  # seconds that an instruction takes at least, of many that are charged before they are done

MAX_BYTES = 16 << 20
"""Bytes that the values of a specification may hold together."""

UNMEASURED = 1 << 20
"""Bytes that may be made between two measurements."""

MAX_CALLS = 100
"""Calls of recursive helper functions inside each other."""

BYTES_PER_INSTRUCTION = 64
OUTPUT_COST = 100  # instructions for a line of output or a published message
FOLDED_NS = 60 * 10**9  # an event that does not happen for an index past the end is told once in this time

Measure = Callable[[object], int]


class FaultError(Exception):
    """An action cannot go on: at which site, and why."""

    def __init__(self, site: int, text: str) -> None:
        super().__init__(text)
        self.site = site
        self.text = text


class MalformedError(Exception):
    """The bytes of a message are not of its type."""


@dataclass(frozen=True, slots=True)
class LogLine:
    """A line of output: `level` is DEBUG, INFO, WARN, ERROR or FATAL."""

    level: str
    text: str
    monitor: str


def line_of(level: str, text: bytes, monitor: str) -> LogLine:
    """A line with this text. Bytes that are not UTF-8 are shown as U+FFFD."""
    return LogLine(level, text.decode("utf-8", "replace").rstrip("\n"), monitor)


class Published(NamedTuple):
    """A message to be published by a monitor; `site` is that of the statement."""

    monitor: str
    topic: str
    type: str
    data: bytes
    site: int


@dataclass(slots=True)
class Turn:
    """What the actions run for one message (or one tick) share: its time, what comes out, and what conditions that were
    met have compared, by their sites.
    """

    now: int = 0
    log: list[LogLine] = field(default_factory=list)
    published: list[Published] = field(default_factory=list)
    looked: dict[int, tuple[Any, ...]] = field(default_factory=dict)
    reset: bool = False  # `__RESET;` was met, for the property whose handlers run
    clock: Callable[[], float] | None = None  # seconds of processor time; None: they are not bounded
    seconds: float = inf
    part: float = 1.0  # of them
    until: float = inf

    def limit(self, clock: Callable[[], float], seconds: float) -> None:
        """Bound the processor time of each message, tick or deadline from the next one on."""
        self.clock, self.seconds = clock, seconds

    def begin(self) -> None:
        """Start the time of a message, a tick or a deadline."""
        if self.clock is not None:
            self.until = self.clock() + self.seconds * self.part

    def late(self, more: float = 0.0) -> bool:
        """Whether the time is over, or will be after so many seconds."""
        return self.clock is not None and self.clock() + more > self.until

    def check(self) -> None:
        """Raise a fault if the time is over."""
        if self.late():
            raise FaultError(-1, self.too_late)

    @property
    def too_late(self) -> str:
        """The text of the fault."""
        return (
            f"more than {self.seconds * self.part * 1000:g} ms of processor time for one message: it has too many"
            f" elements or characters for its monitors (relay.budget is {self.seconds * 1000:g} ms; for a second after"
            " a message that took longer, the next ones have a tenth)"
        )

    def exclude(self, make: Callable[[], Any]) -> Any:
        """Return what `make` returns; its time does not count."""
        if self.clock is None:
            return make()
        began = self.clock()
        made = make()
        self.until += self.clock() - began
        return made


class Context:
    """One specification: its name, what it has left of its budget, and where its output goes."""

    __slots__ = (
        "_allocated",
        "_left",
        "_live",
        "_measures",
        "_pending",
        "budget",
        "monitor",
        "most",
        "throttled",
        "turn",
    )

    def __init__(
        self,
        monitor: str,
        turn: Turn,
        measures: Mapping[str, Measure],
        live: Callable[[], Sequence[Mapping[str, object]]],
    ) -> None:
        """`live` says which variables have values, once for those that specifications share and once for each call;
        `measures` how much one holds, by their names.
        """
        self.monitor = monitor
        self.turn = turn
        self.most = BUDGET
        self.budget = BUDGET  # until the time is read again
        self._left = 0  # beyond that
        self.throttled: dict[int, int] = {}
        self._allocated = 0
        self._measures = measures
        self._live = live
        self._pending = 0

    def begin(self, most: int | None = None) -> None:
        """A new message: the whole budget, or at most so much of it."""
        whole = self.most if most is None else min(most, self.most)
        self.budget = whole if self.turn.clock is None else min(STEP, whole)
        self._left = whole - self.budget

    def put_off(self) -> Callable[[], None]:
        """Return what gives back the budget that is left now, and the time."""
        budget, left, until = self.budget, self._left, self.turn.until

        def go_on() -> None:
            self.budget, self._left, self.turn.until = budget, left, until

        return go_on

    def spend(self, instructions: int, site: int) -> None:
        """Take from the budget; a fault if nothing is left."""
        self.budget -= instructions
        if self.budget < 0:
            self._go_on(site, "; is there a loop without end?")

    def walk(self, elements: int) -> None:
        """Charge for a walk over so many elements of arrays, one by one, to a field behind them."""
        self.budget -= elements
        if self.budget < 0:
            self._go_on(-1, ": too many elements stand before a field")

    def _go_on(self, site: int, otherwise: str) -> None:
        """Take the next step from what is left; a fault if nothing is, or the time is over."""
        missing = -self.budget
        if missing > self._left:
            self._left = 0
            raise FaultError(site, f"more than {self.most} instructions for one message{otherwise}")
        if self.turn.late(missing * _AT_ONCE):
            self._left = 0
            raise FaultError(site, self.turn.too_late)
        given = min(self._left, missing + STEP)
        self._left -= given
        self.budget += given

    def allocate(self, size: int, site: int, replaced: int = 0) -> None:
        """`size` bytes are about to be made, or copied, in the place of `replaced` bytes of a variable."""
        if size > MAX_BYTES:
            raise FaultError(site, f"{_TOO_LARGE}: a value of {size} bytes")
        self.spend(size // BYTES_PER_INSTRUCTION, site)
        self._allocated += size
        if self._allocated > UNMEASURED:
            self._measure(size - replaced, site)

    def log(self, level: str, text: bytes, site: int) -> None:
        """A line of output."""
        self.spend(OUTPUT_COST + len(text) // BYTES_PER_INSTRUCTION, site)
        self.turn.log.append(line_of(level, text, self.monitor))

    def throttle(self, period: float, site: int) -> bool:
        """Whether output at this site is due: the last was at least `period` seconds ago."""
        now = self.turn.now
        last = self.throttled.get(site)
        if last is not None and last <= now < last + period * 1e9:
            return False
        self.throttled[site] = now
        return True

    def publish(self, topic: str, kind: str, data: bytes, site: int) -> None:
        """A message to be published."""
        self.spend(OUTPUT_COST, site)
        self.allocate(len(data), site)
        self._pending += len(data)
        self.turn.published.append(Published(self.monitor, topic, kind, data, site))

    def _measure(self, size: int, site: int) -> None:
        held = size + sum(len(message.data) for message in self.turn.published)
        held += sum(map(self._held, self._live()))
        self._allocated = 0
        self.spend(held // (BYTES_PER_INSTRUCTION * 16), site)
        if held > MAX_BYTES:
            raise FaultError(site, f"{_TOO_LARGE}: {held} bytes")

    def _held(self, variables: Mapping[str, object]) -> int:
        measures = self._measures
        return sum(measures[name](value) for name, value in variables.items() if name in measures)


_TOO_LARGE = f"the values of a specification may hold {MAX_BYTES >> 20} MiB together"
