"""What a module and what runs it have agreed on: where things stand in its memory, what its calls answer, and the data
that tell of it.

A variable of the set stands at its address, in 8 bytes: a number, or of a string (`texts.py`) or vector (`vectors.py`)
where it is and how long; a message stands as it is sent (`records.py`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from rosmop.fast.deferred_output import Line, Publication
from rosmop.types import kinds
from rosmop.types.kinds import Type

POSITION, UNDO, SAID, NOW, SURE, REST, FIRST = 0, 8, 12, 16, 24, 32, 40
"""Where it stands which frame is looked at, where the log and the lines end, the time, where the lines end of the
messages before, and how many bytes the message has behind those that are shown (i64); and what is given out begins.
"""

ROOM = 8 << 10
"""Bytes of a vector that a variable keeps, or that is made."""

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
    """Where strings may be put when there is 0 (i32) at `generation`, by where that is noted (`texts.py`)."""
    records: dict[str, tuple[int, kinds.Record]] = field(default_factory=dict)
    """Where each variable that is a message stands, and its type."""
    sizes: dict[str, int] = field(default_factory=dict)
    """The bytes of each of these, a multiple of 8."""
    inner: dict[str, Sequence[int]] = field(default_factory=dict)
    """Where it is noted in each of these where its strings are."""
    known: dict[str, int] = field(default_factory=dict)
    """Where it stands (i64) whether each of these is here: Python may have a time that no message can have."""
    generation: int = 0
    settle: int = 0
    """The number of the function that puts them there."""
    vectors: dict[str, int] = field(default_factory=dict)
    """Where the elements of a vector may be, by the variable that holds it: the first of two places of `ROOM` bytes.
    Behind them stands what the variable was before the message at hand.
    """

    @property
    def kept(self) -> Sequence[int]:
        """Where it is noted where strings are."""
        return [at for name in (*self.variables, *self.records) for at in self.texts_of(name)]

    def texts_of(self, name: str) -> Sequence[int]:
        """The same of one variable."""
        if name in self.records:
            return self.inner[name]
        address, kind = self.variables[name]
        return (address,) if isinstance(kind, kinds.String) else ()

    def words(self, name: str) -> Sequence[int]:
        """Where the 8 bytes of a variable stand, or each 8 of a message."""
        if name not in self.records:
            return (self.variables[name][0],)
        begin = self.records[name][0]
        return range(begin, begin + self.sizes[name], 8)


@dataclass(frozen=True)
class Feed:
    """The walk for one topic: the name of its export, whether it may drop or change messages, where events are counted.

    `verdicts` have the place of an event, of its step of a property, and of the handler. `log` is where the log of
    patches begins, `undo` the addresses of variables and of what they held before the message that is left. `brief`:
    it has no loops. `functions` are the numbers of those of the events in the module. `says`: it may put out
    lines or publish; all before the address at `SURE` are. `publishes`: the contexts and topics of what it may publish.
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
    publishes: Sequence[tuple[str, str]]


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
    lines: Sequence[Line | Publication]
    said: int
    """Where lines of output and publications are noted, by their places among the `lines`."""
    publications: Mapping[tuple[str, str], int]
    """Where it must stand (i64) whether what a context publishes on a topic is only counted."""
