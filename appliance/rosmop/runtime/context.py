"""The bounds of one specification's actions, and what they hand out: log lines, published messages, faults.

Invariants:

1. Between two calls of `begin` a specification spends at most its budget of instructions; loops, calls, copies of
   anything long and walks over many elements of a message are charged before they are done.
2. The values of a specification never hold more than `MAX_BYTES` plus `UNMEASURED` bytes. Whatever makes
   something long says so to `allocate`; when enough has been said, the live values are measured.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

BUDGET = 1_000_000
"""Instructions that a specification may spend on one message."""

TRIAL_BUDGET = 100_000
"""Instructions that a specification on trial may spend on one message: what waits meanwhile waits some tens of
milliseconds.
"""

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


class Context:
    """One specification: its name, what it has left of its budget, and where its output goes."""

    __slots__ = (
        "_allocated",
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
        self.budget = BUDGET
        self.throttled: dict[int, int] = {}
        self._allocated = 0
        self._measures = measures
        self._live = live
        self._pending = 0

    def begin(self) -> None:
        """A new message: the whole budget."""
        self.budget = self.most

    def spend(self, instructions: int, site: int) -> None:
        """Take from the budget; a fault if nothing is left."""
        self.budget -= instructions
        if self.budget < 0:
            raise FaultError(
                site, f"more than {self.most} instructions for one message; is there a loop without end?"
            )

    def walk(self, elements: int) -> None:
        """Charge for a walk over so many elements of arrays, one by one, to a field behind them."""
        self.budget -= elements
        if self.budget < 0:
            raise FaultError(
                -1,
                f"more than {self.most} instructions for one message: too many elements stand before a field",
            )

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
