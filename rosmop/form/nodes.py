"""The form: typed expressions, statements and functions, without names to look up or types to infer.

Everything is an immutable value. Types are those of `types/value_types.py`; every expression has one, and its operands
have the types that the operation takes (conversions are written out). Values are as in C++ on a 64-bit machine:
integers of their width that wrap, floats of 32 or 64 bits, strings of bytes. Times and durations are nanoseconds.
Vectors and messages are references: assigning one shares it, so copies are written out, too (`Copy`).

Names are of the set of specifications: `g…` variables that specifications share, all others belong to one call of one
function. A *site* is the number of a place in the text, to tell faults by; -1 is that of the statement.

A message is its bytes, from 0. A `Spot` is a position in it: a distance from the start, or from a position that a
statement before has found and named. What is read beyond the end is a fault.

What an action does to the world is a list of effects, in order: drop this message (`Drop`, or a `Return` that drops),
write fields (`WriteBack`), a line of output (`Log`), a message to be published (`Publish`), `Reset` of the property.
Bounds: `Charge` and `Allocate` take from the budget of instructions and bytes, as do functions that make or look at
something long; what exceeds them is a fault.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from types import UnionType
from typing import Any, get_args

import msgspec

from rosmop.types import value_types
from rosmop.types.value_types import Type

CHARGED = 1024
"""A message longer than this is charged when an array or all of it is decoded."""

SHORT = 64
"""To compare with a string of so many bytes takes no longer than any other instruction."""


class Node(msgspec.Struct, frozen=True, tag=True, tag_field="node", array_like=True):
    """A part of the form, which can be sent as it is."""


# Expressions


class Literal(Node, frozen=True):
    """A constant. What is no value of the language (None, and names of parts of a time) has the type void."""

    type: Type
    value: bool | int | float | bytes | None


class Read(Node, frozen=True):
    """The value of a variable."""

    type: Type
    name: str


class Assign(Node, frozen=True):
    """Give a variable a value; the value."""

    type: Type
    name: str
    value: "Expression"


class Convert(Node, frozen=True):
    """A number as one of another type: integers wrap, floating-point numbers are truncated toward zero within the
    limits (NaN is 0) or rounded, and what is not zero is true.
    """

    type: Type
    value: "Expression"


class Arithmetic(Node, frozen=True):
    """`+ - * / % & | ^ << >>` of numbers of this type; of a shift the right operand may have another.

    Integers wrap, shifts count modulo the width, integer division truncates and is a fault by zero.
    """

    type: Type
    operator: str
    left: "Expression"
    right: "Expression"
    site: int


class Unary(Node, frozen=True):
    """`-`, `~` or `abs` of a number; integers wrap."""

    type: Type
    operator: str
    value: "Expression"


class Moment(Node, frozen=True):
    """A sum or difference of times and durations, exact; a fault beyond what this type holds."""

    type: Type
    operator: str
    left: "Expression"
    right: "Expression"
    site: int


class MomentOf(Node, frozen=True):
    """A time or duration of seconds and nanoseconds (`long`), exact; a fault beyond what this type holds."""

    type: Type
    seconds: "Expression"
    nanoseconds: "Expression"
    site: int


class Compare(Node, frozen=True):
    """`== != < > <= >=` of two values of the same type; vectors and messages are charged by what they hold."""

    operator: str
    left: "Expression"
    right: "Expression"
    site: int
    type: Type = value_types.BOOL


class CompareTexts(Node, frozen=True):
    """The same of strings. The left one is charged by its length, unless one of them is known to be `short`, or the
    right one is a variable that holds few bytes.
    """

    operator: str
    left: "Expression"
    right: "Expression"
    short: bool
    site: int
    type: Type = value_types.BOOL


class Logical(Node, frozen=True):
    """`and`, `or`: the right operand is looked at only if the left one does not decide."""

    operator: str
    left: "Expression"
    right: "Expression"
    type: Type = value_types.BOOL


class Not(Node, frozen=True):
    """The opposite."""

    value: "Expression"
    type: Type = value_types.BOOL


class Conditional(Node, frozen=True):
    """`test ? yes : no`."""

    type: Type
    test: "Expression"
    yes: "Expression"
    no: "Expression"


class Sequence(Node, frozen=True):
    """All items in order; the value is that of the chosen one."""

    type: Type
    items: "tuple[Expression, ...]"
    chosen: int


class Discard(Node, frozen=True):
    """An expression for its effect alone."""

    value: "Expression"
    type: Type = value_types.VOID


class Item(Node, frozen=True):
    """A field of a message, or a part of what a function hands back, by its number."""

    type: Type
    base: "Expression"
    number: int


class Vector(Node, frozen=True):
    """A vector of these elements, and so many zeros behind them."""

    type: value_types.Vector
    items: "tuple[Expression, ...]"
    zeros: int = 0


class Zero(Node, frozen=True):
    """A zero value, newly made."""

    type: Type


class Copy(Node, frozen=True):
    """A copy of a vector or message with all that is in it."""

    type: Type
    value: "Expression"
    site: int


class Recast(Node, frozen=True):
    """A vector of bytes (or of vectors of them) as one of bytes of another kind."""

    type: value_types.Vector
    value: "Expression"
    site: int


class OfType(Node, frozen=True):
    """What a function is handed to deal with values of a type: how to make a `zero`,
    `copy` one, `measure` its bytes.
    """

    what: str
    of: Type
    site: int = -1
    type: Type = value_types.VOID


class Call(Node, frozen=True):
    """A call of a function of `functions.py`."""

    type: Type
    function: str
    arguments: "tuple[Expression, ...]"
    site: int = -1


class Accumulate(Node, frozen=True):
    """The sum of a vector's elements from `first` to before `last`, and of `start`: calculated in `wide`, each step
    converted to the type.
    """

    type: Type
    vector: "Expression"
    first: "Expression"
    last: "Expression"
    start: "Expression"
    wide: Type
    site: int


class Invoke(Node, frozen=True):
    """A call of a helper function; with references what comes back is the value and the references' new values.

    `depth`: of a recursive one, whether it is called from a recursive one (a level deeper) or begins.
    """

    type: Type
    function: str
    arguments: "tuple[Expression, ...]"
    depth: bool | None


class Format(Node, frozen=True):
    """Text by a template with conversions, as Python's `%` of bytes has them. `size` is how long it can be without its
    strings if that is to be charged, else None.
    """

    template: bytes
    arguments: "tuple[Expression, ...]"
    size: int | None
    site: int
    type: Type = value_types.STRING


class Join(Node, frozen=True):
    """Strings one after the other."""

    pieces: "tuple[Expression, ...]"
    site: int
    type: Type = value_types.STRING


class Log(Node, frozen=True):
    """A line of output."""

    level: str
    text: "Expression"
    site: int
    type: Type = value_types.VOID


class Throttle(Node, frozen=True):
    """Whether output at this site is due: the last was at least so many seconds ago."""

    seconds: "Expression"
    site: int
    type: Type = value_types.BOOL


class Now(Node, frozen=True):
    """The time at which the message was received."""

    type: Type = value_types.TIME


class Whole(Node, frozen=True):
    """`MESSAGE`: all of it, with the fields that this action has assigned so far, which `Pending` has named."""

    type: value_types.Record
    pending: str
    site: int


Expression = (
    Literal | Read | Assign | Convert | Arithmetic | Unary | Moment | MomentOf | Compare | CompareTexts | Logical | Not
    | Conditional | Sequence | Discard | Item | Vector | Zero | Copy | Recast | OfType | Call | Accumulate | Invoke
    | Format | Join | Log | Throttle | Now | Whole
)  # fmt: skip


# Statements


class Evaluate(Node, frozen=True):
    """An expression for its effect."""

    site: int
    value: Expression


class If(Node, frozen=True):
    """`if (test) yes else no`."""

    site: int
    test: Expression
    yes: "tuple[Statement, ...]"
    no: "tuple[Statement, ...]"


class Loop(Node, frozen=True):
    """A loop that only `Break` ends."""

    site: int
    body: "tuple[Statement, ...]"


class ForEach(Node, frozen=True):
    """Once for each element of a vector (also one that the body appends) or character of a string (as a byte)."""

    site: int
    name: str
    values: Expression
    body: "tuple[Statement, ...]"


class Break(Node, frozen=True):
    """Leave the innermost loop."""

    site: int


class Continue(Node, frozen=True):
    """The innermost loop's next turn."""

    site: int


class Select(Node, frozen=True):
    """Give a variable the number that the table has for a value, or the default."""

    site: int
    name: str
    value: Expression
    table: tuple[tuple[int, int], ...]
    default: int


class Return(Node, frozen=True):
    """The end of a helper function, with its value and those of its references."""

    site: int
    value: Expression
    references: tuple[str, ...] = ()


class Leave(Node, frozen=True):
    """The end of anything else. Of an event: whether it happened."""

    site: int
    happened: bool | None


class Charge(Node, frozen=True):
    """Take so many instructions from the budget."""

    site: int
    instructions: int


class Allocate(Node, frozen=True):
    """Charge for so many bytes that will be made; None: as many as the message has, if they are many."""

    site: int
    size: int | None


class LimitDepth(Node, frozen=True):
    """A fault if this recursive function has been called too often within itself."""

    site: int
    name: str


class Drop(Node, frozen=True):
    """The message is not relayed. `anyway`: there is one; else only if there is (a deadline brings none)."""

    site: int
    anyway: bool


class Reset(Node, frozen=True):
    """The property begins anew when its handlers have run."""

    site: int


class Publish(Node, frozen=True):
    """Publish a message; `name` is a variable for its bytes."""

    site: int
    topic: str
    kind: value_types.Record
    value: Expression
    name: str


# Fields of the message


class Spot(Node, frozen=True):
    """A position: so many bytes behind a named one, or behind the start."""

    base: str | None
    offset: int

    def plus(self, more: int) -> "Spot":
        """The position so many bytes further."""
        return Spot(self.base, self.offset + more)


class AfterText(Node, frozen=True):
    """Name the position behind the string at `at`."""

    site: int
    name: str
    at: Spot


class Count(Node, frozen=True):
    """Name the number of elements of the array at `at`; a fault if so many, of `least` bytes each, are not there."""

    site: int
    name: str
    at: Spot
    least: int


class AfterElements(Node, frozen=True):
    """Name the position behind so many elements (a number, or a named one) of `size` bytes each."""

    site: int
    name: str
    at: Spot
    count: str | int
    size: int


class Skip(Node, frozen=True):
    """Name the position behind so many elements of variable size, each of which `skipper` measures (None: strings).

    They are charged; `inner` (within an element that is skipped) even if they are few.
    """

    site: int
    name: str
    at: Spot
    count: str | int
    skipper: "Skipper | None"
    inner: bool


class NotPast(Node, frozen=True):
    """The event does not happen, and that is told, unless there are more elements than `index`."""

    site: int
    count: str
    index: int


class ReadNumbers(Node, frozen=True):
    """Give variables the numbers or times at so many bytes behind `at`, in the order in which they stand there."""

    site: int
    at: Spot
    fields: tuple[tuple[str, Type, int], ...]


class ReadValue(Node, frozen=True):
    """Give a variable the string, vector or message at `at`, and name the position behind it."""

    site: int
    name: str
    end: str
    at: Spot
    type: Type


class Require(Node, frozen=True):
    """The event does not happen unless this is true."""

    site: int
    test: Expression


class Write(Node, frozen=True):
    """A field that gets a value (of the field's type) if `flag` is set; `end` names where one of variable size ends.

    `path` leads to it from the whole message: numbers of fields and elements, `sec` or `nsec` at the end.
    """

    flag: str
    value: Expression
    at: Spot
    end: str | None
    path: tuple[int | str, ...]


class Pending(Node, frozen=True):
    """Name the fields that this action may assign, for `Whole`."""

    site: int
    name: str
    writes: tuple[Write, ...]


class WriteBack(Node, frozen=True):
    """Put the fields that were assigned into the message, all of them or, with a fault, none; `name` is a variable for
    what is spliced. Of a dropped message none is written, and the event has happened.
    """

    site: int
    writes: tuple[Write, ...]
    name: str


Statement = (
    Evaluate | If | Loop | ForEach | Break | Continue | Select | Return | Leave | Charge | Allocate | LimitDepth | Drop
    | Reset | Publish | AfterText | Count | AfterElements | Skip | NotPast | ReadNumbers | ReadValue | Require
    | Pending | WriteBack
)  # fmt: skip


# Functions


class Skipper(Node, frozen=True):
    """Where an element that begins at the position `p` ends."""

    name: str
    body: tuple[Statement, ...]
    end: Spot


class Function(Node, frozen=True):
    """A function: of an event (`message` is looked at; it happens from the statement `happens` on), a handler, a timer,
    a helper function, or a stage of the beginning.

    `context` is whose budget it takes from. `shared` are the variables of the set that it assigns.
    """

    name: str
    context: str
    parameters: tuple[str, ...]
    body: tuple[Statement, ...]
    shared: tuple[str, ...] = ()
    happens: int | None = None


# Programs


class Clock(Node, frozen=True):
    """Of a property with a clock: the table where more than `within` ns have passed since it began, and for each state
    how long after that its deadline is (-1: it has none).
    """

    late: tuple[int, ...]
    within: int
    waits: tuple[int, ...]


class Handled(Node, frozen=True):
    """The states of a property in which the handler of a category runs when they are entered, also from themselves."""

    category: str
    function: str
    states: frozenset[int]


class Advance(Node, frozen=True):
    """What an event does to a property: the next state for each of its states, -1 where the property has no table of
    states. `property` is its number among those with tables; None without one. `event` is the event's number in its
    specification. `handlers` run in their order, and may have it begin anew in its state `initial`. With a `clock`
    there is twice the next state, and one more where it begins anew; -1 where a handler runs. One that `suppresses`
    takes the step back when the message is dropped.
    """

    property: int | None
    table: tuple[int, ...]
    event: int = 0
    clock: Clock | None = None
    handlers: tuple[Handled, ...] = ()
    initial: int = 0
    suppresses: bool = False


class Event(Node, frozen=True):
    """An event on a topic: its function, and the steps of its specification's properties when it has happened.

    `specification` counts from 0 among those of the topic.
    """

    function: str
    specification: int
    advances: tuple[Advance, ...]


class Component(Node, frozen=True):
    """Specifications that share topics or variables, and nothing with others: the variables of each of them, how many
    properties with tables they have, and their topics (of services the request or response, by a name that no topic
    has) with the events on each, in order.

    `noted` are variables more, in which is noted what nothing depends on and the same message notes again.
    """

    variables: tuple[str, ...]
    properties: int
    topics: tuple[tuple[str, tuple[Event, ...]], ...]
    noted: tuple[str, ...] = ()


def walk(root: object) -> Iterator[object]:
    """Everything that a part of the form is made of, and it."""
    waiting = [root]
    while waiting:
        node = waiting.pop()
        if isinstance(node, tuple):
            waiting += node
        elif isinstance(node, msgspec.Struct):
            yield node
            waiting += [getattr(node, name) for name in node.__struct_fields__]


def moved(root: Any, sites: Mapping[int, int]) -> Any:
    """A part of the form with other numbers for its sites."""
    if isinstance(root, tuple):
        return tuple(moved(part, sites) for part in root)
    if not isinstance(root, Node):
        return root
    parts = ((name, getattr(root, name)) for name in root.__struct_fields__)
    return type(root)(*(sites[part] if name == "site" else moved(part, sites) for name, part in parts))


def acts(root: Expression) -> bool:
    """Whether to evaluate it changes anything, or is seen from outside."""
    return any(
        isinstance(node, Assign | Invoke | Log | Throttle)
        or (
            isinstance(node, Call) and (node.type == value_types.VOID or node.function in ("a_put", "a_slot"))
        )
        for node in walk(root)
    )


def methods_of(walker: type, nodes: UnionType) -> Mapping[type[Any], Callable[..., Any]]:
    """Which method of a class is for which kind of expression or statement (`nodes`): `_after_text` for `AfterText`."""
    named = {kind: "_" + re.sub(r"(?<!^)(?=[A-Z])", "_", kind.__name__).lower() for kind in get_args(nodes)}
    return {kind: getattr(walker, name) for kind, name in named.items() if hasattr(walker, name)}
