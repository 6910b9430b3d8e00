"""The interface between a module and its runner: addresses in its memory, results of its calls, and data about it.

A variable of the set is 8 bytes at its address: a number, or the address and length of a string or an array of
numbers or strings (`strings_codegen.py`). An array of strings is a table (i32) of the addresses of strings, each with
its length (i32) before its bytes, as in a message.
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

POSITION, UNDO, SAID, NOW, SURE, REST, ALTERED, USED, MARK, FIRST = 0, 8, 12, 16, 24, 32, 40, 44, 48, 56
"""Addresses of: the current frame; the ends of the log and of the lines; the time; the end of the lines of earlier
messages; the number (i64) of bytes of the message that are not shown to the module; whether an earlier event changed
the message (i32); the bytes of `ARENA` that this call uses, and those that it used when the current message began;
allocated memory.
"""

ARENA = 256 << 10
"""The bytes for tables of strings and messages, and for changed arrays. A message that finds it full is left."""

MAX_KEPT = 1024

MAX_KEPT_ARRAY = 16 << 10

MAX_TEXTS = 256

BEYOND = 0xFFFFFFFF
"""Stands for the length of a string or array that is longer than `most_kept`."""


def kept_size(kind: Type) -> int:
    """Return the size of each element of a string, or of an array of numbers, or 0 for other types."""
    if isinstance(kind, value_types.StringType):
        return 1
    code = struct_code(kind.element) if isinstance(kind, value_types.VectorType) else None
    return struct_size(code) if code is not None and len(code) == 1 else 0


def is_texts(kind: Type) -> bool:
    return isinstance(kind, value_types.VectorType) and isinstance(kind.element, value_types.StringType)


def is_kept(kind: Type) -> bool:
    return is_texts(kind) or kept_size(kind) > 0


def room_of(kind: Type) -> int:
    """Return the bytes of the longest string or array that is kept. An array of strings has its table first."""
    return MAX_KEPT_ARRAY if is_texts(kind) else most_kept(kind) * kept_size(kind)


def most_kept(kind: Type) -> int:
    if is_texts(kind):
        return MAX_TEXTS
    return MAX_KEPT if isinstance(kind, value_types.StringType) else MAX_KEPT_ARRAY // kept_size(kind)


SENDER = 16 + 2 * MAX_KEPT
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
        return [at for at, kind in self.variables.values() if is_kept(kind)]


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
