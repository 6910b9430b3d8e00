"""Bound a specification's actions, and collect their output.

1. Between two calls of `begin` a specification spends at most its budget of instructions. Loops, calls, long copies
and reads of many elements are charged before they run. With `ActionState.limit`, processor time is read every `STEP`
instructions and every `PART` elements, but only after `INSTRUCTIONS_PER_SECOND`: the same instructions take several
times longer on a busy machine, and an honest message must not become a fault there.
2. The values of a specification never exceed `MAX_BYTES` plus `UNMEASURED` bytes, after which `allocate` measures the
live values.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from typing import NamedTuple, TypeVar

from rosmop.types.value_types import Value

BUDGET = 1_000_000

STEP = 250

PART = 250

INSTRUCTIONS_PER_SECOND = 5_000_000
"""The instructions that a second of the time limit always permits."""

_AT_ONCE = 10e-9  # seconds: the least that an instruction takes, where many are charged in advance

MAX_BYTES = 16 << 20

UNMEASURED = 1 << 20

MAX_CALLS = 100

BYTES_PER_INSTRUCTION = 64
OUTPUT_COST = 100  # instructions for a line of output or a published message
# An event that does not happen because an index is past the end is reported at most once in this time.
FOLDED_NS = 60 * 10**9

Measure = Callable[[object], int]


class FaultError(Exception):
    """A runtime error, which stops an action. Its `site` is a position in the specification, or -1."""

    def __init__(self, site: int, text: str) -> None:
        super().__init__(text)
        self.site = site
        self.text = text


class OverBudgetError(FaultError):
    """A message, tick or deadline needs more instructions, or more processor time, than it has."""


class MalformedError(Exception):
    """A message whose bytes do not fit its type."""


@dataclass(frozen=True, slots=True)
class LogLine:
    """A line of output; `level` is DEBUG, INFO, WARN, ERROR or FATAL."""

    level: str
    text: str
    monitor: str


def line_of(level: str, text: bytes, monitor: str) -> LogLine:
    return LogLine(level, text.decode("utf-8", "replace").rstrip("\n"), monitor)


class Published(NamedTuple):
    """A message that a monitor publishes, or a service that it calls."""

    monitor: str
    topic: str
    type: str
    data: bytes
    site: int
    is_call: bool = False


_T = TypeVar("_T")


@dataclass(slots=True)
class ActionState:
    """The state that all actions of one message or tick share."""

    now: int = 0
    source: int = 0
    names: Callable[[int], tuple[bytes, bytes]] = lambda _: (b"", b"")
    """Returns host and caller of a source (`MessageSender.source`)."""
    log: list[LogLine] = field(default_factory=list)
    published: list[Published] = field(default_factory=list)
    looked: dict[int, tuple[Value, ...]] = field(default_factory=dict)
    reset: bool = False  # set by `__RESET;` for the property whose handlers run
    clock: Callable[[], float] | None = None  # returns seconds of processor time; None: unlimited
    seconds: float = inf
    part: float = 1.0  # the usable fraction of `seconds`
    until: float = inf
    permitted: int = 0
    least: float = inf
    """The instructions and elements after which the time counts, and those of this message so far (`spent`)."""
    spent: int = 0

    def limit(
        self, clock: Callable[[], float], seconds: float, permitted: int = INSTRUCTIONS_PER_SECOND
    ) -> None:
        """Limit the processor time (seconds) of each message, tick or deadline, starting with the next.

        Each second permits that many instructions, even if they take longer.
        """
        self.clock, self.seconds, self.permitted = clock, seconds, permitted

    def begin(self) -> None:
        if self.clock is not None:
            self.until = self.clock() + self.seconds * self.part
            self.least, self.spent = self.permitted * self.seconds * self.part, 0

    def late(self, more: int = 0) -> bool:
        """Whether the time is over, or will be after `more` instructions."""
        if self.clock is None or self.spent + more < self.least:
            return False
        return self.clock() + more * _AT_ONCE > self.until

    def check(self, elements: int = 0, ahead: int = 0) -> None:
        """Raise an error if the time is over, or will be after the instructions `ahead`.

        `elements` follow that no instruction is charged for.
        """
        if self.late(ahead):
            raise OverBudgetError(-1, self.too_late)
        self.spent += elements

    @property
    def too_late(self) -> str:
        return (
            f"more than {self.seconds * self.part * 1000:g} ms of processor time for one message: it has too many"
            f" elements or characters for its monitors (relay.budget is {self.seconds * 1000:g} ms; for some seconds"
            " after such a message, others of at least half its size have a tenth)"
        )

    def exclude(self, make: Callable[[], _T]) -> _T:
        if self.clock is None:
            return make()
        began = self.clock()
        made = make()
        self.until += self.clock() - began
        return made


class Context:
    """The budgets and the output of one specification."""

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
        turn: ActionState,
        measures: Mapping[str, Measure],
        live: Callable[[], Sequence[Mapping[str, object]]],
    ) -> None:
        self.monitor = monitor
        self.turn = turn
        self.most = BUDGET
        self.budget = BUDGET  # instructions until the processor time is read again
        self._left = 0  # the rest of the budget after that
        self.throttled: dict[int, int] = {}
        self._allocated = 0
        self._measures = measures
        self._live = live
        self._pending = 0

    def begin(self, most: int | None = None) -> None:
        whole = self.most if most is None else min(most, self.most)
        self.budget = whole if self.turn.clock is None else min(STEP, whole)
        self._left = whole - self.budget

    def put_off(self) -> Callable[[], None]:
        budget, left, until, spent = self.budget, self._left, self.turn.until, self.turn.spent

        def go_on() -> None:
            self.budget, self._left, self.turn.until, self.turn.spent = budget, left, until, spent

        return go_on

    def spend(self, instructions: int, site: int) -> None:
        self.budget -= instructions
        if self.budget < 0:
            self._go_on(site, "; is there an endless loop?")

    def walk(self, elements: int) -> None:
        self.budget -= elements
        if self.budget < 0:
            self._go_on(-1, ": too many elements precede a field")

    def _go_on(self, site: int, otherwise: str) -> None:
        missing = -self.budget
        if missing > self._left:
            self._left = 0
            raise OverBudgetError(site, f"more than {self.most} instructions for one message{otherwise}")
        if self.turn.late(missing):
            self._left = 0
            raise OverBudgetError(site, self.turn.too_late)
        given = min(self._left, missing + STEP)
        self.turn.spent += given
        self._left -= given
        self.budget += given

    def allocate(self, size: int, site: int, replaced: int = 0) -> None:
        if size > MAX_BYTES:
            raise FaultError(site, f"{_TOO_LARGE}: a value of {size} bytes")
        self.spend(size // BYTES_PER_INSTRUCTION, site)
        self._allocated += size
        if self._allocated > UNMEASURED:
            self._measure(size - replaced, site)

    def log(self, level: str, text: bytes, site: int) -> None:
        self.spend(OUTPUT_COST + len(text) // BYTES_PER_INSTRUCTION, site)
        self.turn.log.append(line_of(level, text, self.monitor))

    def throttle(self, period: float, site: int) -> bool:
        now = self.turn.now
        last = self.throttled.get(site)
        if last is not None and last <= now < last + period * 1e9:
            return False
        self.throttled[site] = now
        return True

    def publish(self, topic: str, kind: str, data: bytes, site: int, *, is_call: bool = False) -> None:
        self.spend(OUTPUT_COST, site)
        self.allocate(len(data), site)
        self._pending += len(data)
        self.turn.published.append(Published(self.monitor, topic, kind, data, site, is_call))

    def _measure(self, size: int, site: int) -> None:
        """Measure the live values. It costs nothing, as it depends on earlier messages: `allocate` has paid for it."""
        held = size + sum(len(message.data) for message in self.turn.published)
        held += sum(map(self._bytes_held, self._live()))
        self._allocated = 0
        if held > MAX_BYTES:
            raise FaultError(site, f"{_TOO_LARGE}: {held} bytes")

    def _bytes_held(self, variables: Mapping[str, object]) -> int:
        measures = self._measures
        return sum(measures[name](value) for name, value in variables.items() if name in measures)


_TOO_LARGE = f"the values of a specification may hold {MAX_BYTES >> 20} MiB in total"
