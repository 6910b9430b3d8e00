"""The form: typed expressions, statements and functions, without names to look up or types to infer.

Conversions are explicit, and so are copies (`Copy`), because vectors and messages are references. Values are
as in C++ on a 64-bit machine: integers wrap, floats have 32 or 64 bits, strings are bytes; times and
durations are nanoseconds. Reading beyond the end of the message is a fault, and so is exceeding a budget.

Names belong to the set of specifications (`g…`) or to one call of one function. A *site* is the number of a
position in the text, for reports of faults; -1 means the statement's own site. Each back end has a table with
a row for each kind of node: an implementation, or `Left`.
"""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import msgspec

from rosmop.types import value_types
from rosmop.types.value_types import Type

CHARGED = 1024

SHORT = 64


class FormNode(msgspec.Struct, frozen=True, tag=True, tag_field="node", array_like=True):
    """A node that can be serialised."""


# Expressions


class Literal(FormNode, frozen=True):
    """A constant. The value of an array of numbers is its bytes as in a message.

    The type is void for None and for the name of a part of a time.
    """

    type: Type
    value: bool | int | float | bytes | None


class Read(FormNode, frozen=True):
    """The value of a variable."""

    type: Type
    name: str


class Assign(FormNode, frozen=True):
    """An assignment; the result is the assigned value."""

    type: Type
    name: str
    value: "Expression"


class Convert(FormNode, frozen=True):
    """A number converted to another type. Integers wrap, and every number except zero converts to true.

    Floats are rounded to the width of the type, or truncated to an integer within its limits (NaN is 0).
    """

    type: Type
    value: "Expression"


class Arithmetic(FormNode, frozen=True):
    """`+ - * / % & | ^ << >>` of numbers of this type; the right operand of a shift may have another type.

    Integers wrap; shifts count modulo the width; integer division truncates, and faults if the divisor is zero.
    """

    type: Type
    operator: str
    left: "Expression"
    right: "Expression"
    site: int


class Unary(FormNode, frozen=True):
    """`-`, `~` or `abs` of a number; integers wrap."""

    type: Type
    operator: str
    value: "Expression"


class Moment(FormNode, frozen=True):
    """An exact sum or difference of times and durations, which faults if the type cannot hold the result."""

    type: Type
    operator: str
    left: "Expression"
    right: "Expression"
    site: int


class MomentOf(FormNode, frozen=True):
    """A time or duration from seconds and nanoseconds (both `long`), which faults if the type cannot hold it."""

    type: Type
    seconds: "Expression"
    nanoseconds: "Expression"
    site: int


class Compare(FormNode, frozen=True):
    """`== != < > <= >=` of two values of the same type; vectors and messages are charged by their size."""

    operator: str
    left: "Expression"
    right: "Expression"
    site: int
    type: Type = value_types.BOOL


class CompareTexts(FormNode, frozen=True):
    """A comparison of strings, which charges the length of the left string.

    It does not charge if either string is `short`, or if the right string is a variable with few bytes.
    """

    operator: str
    left: "Expression"
    right: "Expression"
    short: bool
    site: int
    type: Type = value_types.BOOL


class Logical(FormNode, frozen=True):
    """`and` or `or`; the right operand is evaluated only if the left one does not decide the result."""

    operator: str
    left: "Expression"
    right: "Expression"
    type: Type = value_types.BOOL


class Not(FormNode, frozen=True):
    """Logical negation."""

    value: "Expression"
    type: Type = value_types.BOOL


class Conditional(FormNode, frozen=True):
    """`test ? yes : no`."""

    type: Type
    test: "Expression"
    yes: "Expression"
    no: "Expression"


class Sequence(FormNode, frozen=True):
    """Evaluates all items in order; the result is the value of the chosen one."""

    type: Type
    items: "tuple[Expression, ...]"
    chosen: int


class Discard(FormNode, frozen=True):
    """Evaluates an expression for its effect only."""

    value: "Expression"
    type: Type = value_types.VOID


class Item(FormNode, frozen=True):
    """A field of a message, or a part of a function's result, by number."""

    type: Type
    base: "Expression"
    number: int


class Vector(FormNode, frozen=True):
    """A vector of these elements, followed by `zeros` zero values."""

    type: value_types.VectorType
    items: "tuple[Expression, ...]"
    zeros: int = 0


class Zero(FormNode, frozen=True):
    """A new zero value."""

    type: Type


class Copy(FormNode, frozen=True):
    """A deep copy of a vector or message."""

    type: Type
    value: "Expression"
    site: int


class Recast(FormNode, frozen=True):
    """A vector of bytes, or of vectors of bytes, converted to another type of bytes."""

    type: value_types.VectorType
    value: "Expression"
    site: int


class OfType(FormNode, frozen=True):
    """A function for a type, passed as an argument: make a `zero`, `copy` a value, or `measure` its bytes."""

    what: str
    of: Type
    site: int = -1
    type: Type = value_types.VOID


class Call(FormNode, frozen=True):
    """A call of a function of `runtime/builtin_functions.py`."""

    type: Type
    function: str
    arguments: "tuple[Expression, ...]"
    site: int = -1


class Accumulate(FormNode, frozen=True):
    """The sum of `start` and a vector's elements from `first` to before `last`, calculated in the type `wide`."""

    type: Type
    vector: "Expression"
    first: "Expression"
    last: "Expression"
    start: "Expression"
    wide: Type
    site: int


class Invoke(FormNode, frozen=True):
    """A call of a helper function; with references, the result is its value and the new values of the references.

    `depth` is None if the function is not recursive. Otherwise it says whether the caller is also recursive, so that
    the call is one level deeper.
    """

    type: Type
    function: str
    arguments: "tuple[Expression, ...]"
    depth: bool | None


class Format(FormNode, frozen=True):
    """Text formatted by a template, as with Python's `%` of bytes.

    `size` is the maximum length without its strings, or None if the text is not charged.
    """

    template: bytes
    arguments: "tuple[Expression, ...]"
    size: int | None
    site: int
    type: Type = value_types.STRING


class Join(FormNode, frozen=True):
    """Concatenated strings."""

    pieces: "tuple[Expression, ...]"
    site: int
    type: Type = value_types.STRING


class Log(FormNode, frozen=True):
    """A line of output."""

    level: str
    text: "Expression"
    site: int
    type: Type = value_types.VOID


class Throttle(FormNode, frozen=True):
    """Whether output at this site is due: the last output was at least `seconds` ago."""

    seconds: "Expression"
    site: int
    type: Type = value_types.BOOL


class Now(FormNode, frozen=True):
    """The time when the message was received."""

    type: Type = value_types.TIME


class SenderName(FormNode, frozen=True):
    """The `host` or the `caller` of the message: the address of its sender's host, or the name of its node."""

    part: str
    type: Type = value_types.STRING


class Altered(FormNode, frozen=True):
    """Whether an earlier event changed or replaced the message, or a monitor published it."""

    type: Type = value_types.BOOL


class Whole(FormNode, frozen=True):
    """`MESSAGE`: the whole message with the fields assigned so far, which `Pending` lists."""

    type: value_types.RecordType
    pending: str
    site: int


Expression = (
    Literal | Read | Assign | Convert | Arithmetic | Unary | Moment | MomentOf | Compare | CompareTexts | Logical | Not
    | Conditional | Sequence | Discard | Item | Vector | Zero | Copy | Recast | OfType | Call | Accumulate | Invoke
    | Format | Join | Log | Throttle | Now | SenderName | Altered | Whole
)  # fmt: skip


# Statements


class Evaluate(FormNode, frozen=True):
    """An expression that is evaluated for its effect."""

    site: int
    value: Expression


class If(FormNode, frozen=True):
    """`if (test) yes else no`."""

    site: int
    test: Expression
    yes: "tuple[Statement, ...]"
    no: "tuple[Statement, ...]"


class Loop(FormNode, frozen=True):
    """A loop that only `Break` ends."""

    site: int
    body: "tuple[Statement, ...]"


class ForEach(FormNode, frozen=True):
    """A loop over the elements of a vector (including those that the body appends) or the bytes of a string."""

    site: int
    name: str
    values: Expression
    body: "tuple[Statement, ...]"


class Break(FormNode, frozen=True):
    """Leave the innermost loop."""

    site: int


class Continue(FormNode, frozen=True):
    """Continue with the next iteration of the innermost loop."""

    site: int


class Select(FormNode, frozen=True):
    """A lookup in a table, which assigns the number found there, or the default."""

    site: int
    name: str
    value: Expression
    table: tuple[tuple[int, int], ...]
    default: int


class Return(FormNode, frozen=True):
    """Return from a helper function, with its value and the values of its references."""

    site: int
    value: Expression
    references: tuple[str, ...] = ()


class Leave(FormNode, frozen=True):
    """Return from any other function. An event returns whether it happened."""

    site: int
    happened: bool | None


class Charge(FormNode, frozen=True):
    """Charge instructions to the budget."""

    site: int
    instructions: int


class Allocate(FormNode, frozen=True):
    """Charge for the bytes of a new value. None means the bytes of the message, if they are many."""

    site: int
    size: int | None


class LimitDepth(FormNode, frozen=True):
    """Fault if the recursion is too deep."""

    site: int
    name: str


class Drop(FormNode, frozen=True):
    """Drop the message. A deadline has no message to drop."""

    site: int


class SafeMessage(FormNode, frozen=True):
    """The only message that a monitor sends or passes on a topic while it cannot judge. Its declaration is at `site`.

    If it is `stamped`, the `seq` and `stamp` of its header are not compared, and are set when it is sent; nor is the
    frame, if the rest is zero.
    """

    topic: str
    type: str
    data: bytes
    stamped: bool
    period_ns: int
    site: int


class StopMessage(FormNode, frozen=True):
    """Replace the message with the safe message of its topic, or publish all of `safes` if it has none."""

    site: int
    safes: tuple[SafeMessage, ...]


class Reset(FormNode, frozen=True):
    """Restart the property when its handlers have run."""

    site: int


class Publish(FormNode, frozen=True):
    """Publish a message; its bytes are in the variable `name`. With a `service` type, call the service instead."""

    site: int
    topic: str
    kind: value_types.RecordType
    value: Expression
    name: str
    service: str = ""


# Fields of the message


class Spot(FormNode, frozen=True):
    """A position: an offset from a named position, or from the start."""

    base: str | None
    offset: int

    def plus(self, more: int) -> "Spot":
        return Spot(self.base, self.offset + more)


class AfterText(FormNode, frozen=True):
    """Name the position after the string at `at`."""

    site: int
    name: str
    at: Spot


class Count(FormNode, frozen=True):
    """Name the number of elements of the array at `at`. Faults if they, at `least` bytes each, exceed the message."""

    site: int
    name: str
    at: Spot
    least: int


class AfterElements(FormNode, frozen=True):
    """Name the position after `count` elements (a number, or a named count) of `size` bytes each."""

    site: int
    name: str
    at: Spot
    count: str | int
    size: int


class Skip(FormNode, frozen=True):
    """Name the position after `count` elements of variable size: strings, unless a `skipper` measures each.

    The elements are charged if there are many, or if they are `inner` (within a skipped element).
    """

    site: int
    name: str
    at: Spot
    count: str | int
    skipper: "Skipper | None"
    inner: bool


class NotPast(FormNode, frozen=True):
    """Let the event happen only if there are more elements than `index`. Otherwise it is reported."""

    site: int
    count: str
    index: int


class Ends(FormNode, frozen=True):
    """Fault unless the message ends at this position."""

    site: int
    at: Spot


class ReadNumbers(FormNode, frozen=True):
    """Assign numbers and times to variables; fields have offsets from `at`, in ascending order."""

    site: int
    at: Spot
    fields: tuple[tuple[str, Type, int], ...]


class ReadValue(FormNode, frozen=True):
    """Assign the string, vector or message at `at` to a variable, and name the position after it."""

    site: int
    name: str
    end: str
    at: Spot
    type: Type


class Require(FormNode, frozen=True):
    """Let the event happen only if this is true."""

    site: int
    test: Expression


class Write(FormNode, frozen=True):
    """Assign a value (of the field's type) to a field if the variable `flag` is set.

    `end` names the end of a field of variable size. `path` has the numbers of fields and elements, and
    perhaps `sec` or `nsec` at the end.
    """

    flag: str
    value: Expression
    at: Spot
    end: str | None
    path: tuple[int | str, ...]


class Pending(FormNode, frozen=True):
    """List the fields that this action may assign, for `Whole`."""

    site: int
    name: str
    writes: tuple[Write, ...]


class WriteBack(FormNode, frozen=True):
    """Write all assigned fields to the message or, if that faults, none. The variable `name` is for spliced bytes.

    A message that was dropped or replaced stays unchanged, although the event has happened.
    """

    site: int
    writes: tuple[Write, ...]
    name: str


Statement = (
    Evaluate | If | Loop | ForEach | Break | Continue | Select | Return | Leave | Charge | Allocate | LimitDepth | Drop
    | StopMessage | Reset | Publish | AfterText | Count | AfterElements | Skip | NotPast | Ends | ReadNumbers
    | ReadValue | Require | Pending | WriteBack
)  # fmt: skip


# Functions


class Skipper(FormNode, frozen=True):
    """A function that finds the end of an element that begins at the position `p`."""

    name: str
    body: tuple[Statement, ...]
    end: Spot


class Function(FormNode, frozen=True):
    """A function of any kind. An event has happened from the statement with the number `happens` on.

    `context` names the specification that pays, and `shared` the shared variables that the function assigns.
    `same_as` is an equivalent function of `runtime/builtin_functions.py`, which is faster in Python.
    """

    name: str
    context: str
    parameters: tuple[str, ...]
    body: tuple[Statement, ...]
    shared: tuple[str, ...] = ()
    happens: int | None = None
    same_as: str = ""


# Programs


class PropertyClock(FormNode, frozen=True):
    """The clock of a property, and the deadline of each state, counted from the clock's start (-1: none).

    For events more than `within` ns after the start, `late` replaces the table.
    """

    late: tuple[int, ...]
    within: int
    waits: tuple[int, ...]


class HandledCategory(FormNode, frozen=True):
    """The handler of a category. It runs whenever one of `states` is entered, even from itself."""

    category: str
    function: str
    states: frozenset[int]


class Advance(FormNode, frozen=True):
    """The step of a property at an event: the next state for each state (-1: no table).

    `property` counts the properties with tables, and `event` the events of the specification. `handlers` run
    in their order, and may restart the property in its state `initial`. With a `clock`, an entry is twice the
    next state, plus one where the clock restarts, or -1 where a handler runs. A property that `suppresses`
    undoes the step when the message is dropped.
    """

    property: int | None
    table: tuple[int, ...]
    event: int = 0
    clock: PropertyClock | None = None
    handlers: tuple[HandledCategory, ...] = ()
    initial: int = 0
    suppresses: bool = False


class Event(FormNode, frozen=True):
    """An event on a topic, and the steps of properties after it.

    `specification` is an index among the specifications of the topic.
    """

    function: str
    specification: int
    advances: tuple[Advance, ...]


class Component(FormNode, frozen=True):
    """Specifications that share topics or variables only with each other, with the events on each topic in order.

    `noted` are variables that serve only explanations; processing a message again does not change them.
    """

    variables: tuple[str, ...]
    properties: int
    topics: tuple[tuple[str, tuple[Event, ...]], ...]
    noted: tuple[str, ...] = ()


def walk(root: object) -> Iterator[msgspec.Struct]:
    waiting = [root]
    while waiting:
        node = waiting.pop()
        if isinstance(node, tuple):
            waiting += node
        elif isinstance(node, msgspec.Struct):
            yield node
            waiting += msgspec.structs.astuple(node)


_SITE = "site"


def sites_of(root: object) -> set[int]:
    found = (msgspec.structs.asdict(node).get(_SITE, -1) for node in walk(root))
    return {site for site in found if site != -1}


def with_sites(root: Any, sites: Mapping[int, int]) -> Any:
    if isinstance(root, tuple):
        return tuple(with_sites(part, sites) for part in root)
    if not isinstance(root, FormNode):
        return root
    parts = msgspec.structs.asdict(root).items()
    return type(root)(*(sites[part] if name == _SITE else with_sites(part, sites) for name, part in parts))


PURE = "lib"


def acts(root: Expression) -> bool:
    return any(
        isinstance(node, Assign | Log | Throttle)
        or (isinstance(node, Invoke) and not node.function.startswith(PURE))
        or (
            isinstance(node, Call) and (node.type == value_types.VOID or node.function in ("a_put", "a_slot"))
        )
        for node in walk(root)
    )


class Left(NamedTuple):
    """Marks a kind of node that a back end leaves to the interpreter."""

    reason: str
