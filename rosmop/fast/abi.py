"""The interface between a module and its runner: addresses in its memory, results of its calls, and data about it.

A variable of the set is 8 bytes at its address: a number, or the address and length of a string or an array of
numbers (`strings_codegen.py`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from rosmop.fast.deferred_output import OutputLine
from rosmop.form.compiled import Compiled
from rosmop.runtime.values import struct_code, struct_size
from rosmop.types import value_types
from rosmop.types.messages import MessageTypes
from rosmop.types.value_types import Type
from roswire.definitions import Definitions

POSITION, UNDO, SAID, NOW, SURE, REST, ALTERED, FIRST = 0, 8, 12, 16, 24, 32, 40, 48
"""Addresses of: the current frame; the ends of the log and of the lines; the time; the end of the lines of earlier
messages; the number (i64) of bytes of the message that are not shown to the module; whether an earlier event changed
the message (i32); allocated memory.
"""

MOST_KEPT = 1024

MOST_KEPT_ARRAY = 16 << 10

BEYOND = 0xFFFFFFFF
"""Stands for the length of a string or array that is longer than `most_kept`."""


def kept_size(kind: Type) -> int:
    """Return the size of each element of a string, or of an array of numbers, or 0 for other types."""
    if isinstance(kind, value_types.StringType):
        return 1
    code = struct_code(kind.element) if isinstance(kind, value_types.VectorType) else None
    return struct_size(code) if code is not None and len(code) == 1 else 0


def most_kept(kind: Type) -> int:
    return MOST_KEPT if isinstance(kind, value_types.StringType) else MOST_KEPT_ARRAY // kept_size(kind)


SENDER = 16 + 2 * MOST_KEPT
"""The bytes of a sender: address and length of its host and caller, and then their bytes."""

AREA = 512 << 10
"""The bytes of frames in one batch; one read takes the same number."""

LEFT = 1 << 62
SOONER = 1 << 61
TOLD = 1 << 60
LOUD = 1 << 63


@dataclass
class Cells:
    """Addresses of the state of specifications that share topics or variables, 8 bytes for each property and variable.

    Variables that are only `noted` are not undone.
    """

    base: int
    properties: int
    source: int = 0
    """Address of four i64 (see `batch_codegen.py`): the sender (`MessageSender.source` from bit 32 on), the events
    whose effects are left to Python, the enabled specifications, and the verdicts that are only counted.
    """
    noted: Sequence[str] = ()
    exits: dict[int, int] = field(default_factory=dict)
    clocks: dict[int, int] = field(default_factory=dict)
    until: int = 0
    """Address of the time (i64) when Python's next timer is due. The module reports earlier deadlines."""
    variables: dict[str, tuple[int, Type]] = field(default_factory=dict)
    texts: dict[int, int] = field(default_factory=dict)
    """By the address of a variable: where its elements are stored while the number (i32) at `generation` is 0."""
    generation: int = 0
    settle: int = 0

    @property
    def kept(self) -> Sequence[int]:
        return [at for at, kind in self.variables.values() if kept_size(kind)]


@dataclass(frozen=True)
class TopicCode:
    """The code for a topic: its export, whether it may drop or change messages, and the address of its counters."""

    name: str
    drops: bool
    changes: bool
    verdicts: Sequence[tuple[int, int, int]]
    """For each verdict, the indices of an event, of its step of a property, and of the handler."""
    counters: int
    log: int
    """The address of the log of patches."""
    undo: tuple[tuple[int, int], ...]
    """The addresses of variables, and of their values before the current message."""
    brief: bool
    """Whether the code has no loops."""
    functions: Sequence[int]
    says: bool
    """Whether the code may print lines; those before the address stored at `SURE` are final."""
    settle: str
    budgets: Sequence[int]
    """The addresses of the instructions (i64) that the specifications have left; less than zero: too few."""


@dataclass(frozen=True)
class CompiledModule:
    """A module and data about it.

    `throttles` has, by context and site, the address of the time (i64, ns) when output is due.
    """

    code: bytes
    memory: int
    frames: int
    effects: int
    feeds: Mapping[str, TopicCode]
    cells: Sequence[Cells]
    throttles: Mapping[tuple[str, int], int]
    lines: Sequence[OutputLine]
    said: int
    senders: Mapping[str, int]


@dataclass(frozen=True, eq=False)
class SetPart:
    """The part of a set that one process runs. Its module has the specifications that are not in shadow mode."""

    compiled: Compiled
    module: CompiledModule

    @classmethod
    def empty(cls) -> "SetPart":
        nothing = Compiled((), (), {}, (), {}, MessageTypes(Definitions({})), ())
        return cls(nothing, CompiledModule(b"", 0, 0, 0, {}, (), {}, (), 0, {}))
