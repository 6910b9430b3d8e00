"""What a module and what runs it have agreed on: where things stand in its memory, what its calls answer, and the data
that tell of it.

A variable of the set is 8 bytes at its address: a number, or the address and length of a string
(`strings_codegen.py`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from rosmop.fast.deferred_output import Line
from rosmop.form.compiled import Compiled
from rosmop.types import value_types
from rosmop.types.value_types import Type

POSITION, UNDO, SAID, NOW, SURE, REST, FIRST = 0, 8, 12, 16, 24, 32, 40
"""Where it stands which frame is looked at, where the log and the lines end, the time, where the lines end of the
messages before, and how many bytes the message has behind those that are shown (i64); and what is given out begins.
"""

MOST_KEPT = 1024
"""Bytes of a string that a variable keeps."""

BEYOND = 0xFFFFFFFF
"""In the place of the length of a longer one."""

AREA = 512 << 10
"""Bytes of frames that are fed together: as many as one read takes."""

LEFT = 1 << 62
SOONER = 1 << 61
TOLD = 1 << 60
LOUD = 1 << 63


@dataclass
class Cells:
    """Where the state of specifications that share topics or variables stands: 8 bytes for each property's state, then
    for each variable that is used. Those that are `noted` only are not undone.
    """

    base: int
    properties: int
    source: int = 0
    """Where the sender of what is looked at stands (`Sender.source` from bit 32 on), what is told, and which are
    enabled: three i64 (see `feed.py`).
    """
    noted: Sequence[str] = ()
    exits: dict[int, int] = field(default_factory=dict)
    """Where it is kept how the states of a property were left (`why.Exits`, `why.ClockedSteps`), by its number."""
    clocks: dict[int, int] = field(default_factory=dict)
    """Where it stands when the clock of a property began, and its time (`ClockedRun`), by its number."""
    until: int = 0
    """Where it stands (i64) when the next is due that Python knows of: an earlier deadline is told."""
    variables: dict[str, tuple[int, Type]] = field(default_factory=dict)
    """Where each stands, and its type; in the order of the places."""
    texts: dict[int, int] = field(default_factory=dict)
    """Where strings may be put when there is 0 (i32) at `generation`, by where that is noted."""
    generation: int = 0
    settle: int = 0
    """The number of the function that puts them there."""

    @property
    def kept(self) -> Sequence[int]:
        """Where the addresses and lengths of strings are noted."""
        return [at for at, kind in self.variables.values() if isinstance(kind, value_types.String)]


@dataclass(frozen=True)
class Feed:
    """The walk for one topic: the name of its export, whether it may drop or change messages, where events are counted.

    `verdicts` have the place of an event, of its step of a property, and of the handler. `log` is where the log of
    patches begins, `undo` the addresses of variables and of what they held before the message that is left. `brief`:
    it has no loops. `functions` are the numbers of those of the events in the module. `says`: it may put out
    lines; all before the address at `SURE` are.
    """

    name: str
    drops: bool
    changes: bool
    verdicts: Sequence[tuple[int, int, int]]
    counters: int
    log: int
    undo: tuple[tuple[int, int], ...]
    brief: bool
    functions: Sequence[int]
    says: bool
    settle: str
    """The export that is called when what was done to the message that is left is taken back; none if it is empty."""


@dataclass(frozen=True)
class FeedModule:
    """A module: its machine code (`machine.translated`), how much memory it has, where frames are put and effects
    stand, the topics that it takes, and where each component keeps its state.

    `throttles`: where it must stand (i64, ns) when output at a site was last due, by the context and the site.
    """

    code: bytes
    memory: int
    frames: int
    effects: int
    feeds: Mapping[str, Feed]
    cells: Sequence[Cells]
    throttles: Mapping[tuple[str, int], int]
    lines: Sequence[Line]
    said: int
    """Where lines of output are noted, by their places among the `lines`."""


@dataclass(frozen=True, eq=False)
class Part:
    """The specifications of a set that one process runs, and the module of those that are not in shadow mode."""

    compiled: Compiled
    module: FeedModule
