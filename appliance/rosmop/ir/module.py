"""A part of the form as WebAssembly: numbers, conditions, loops, what stands in the message, numbers put there, drops.

Strings of the message, its vectors and what messages are in it are looked at where they stand, if everything in them
has a fixed size: in a local variable is the address, and how many elements there are. Of an array of strings it is the
address of a table that says where each begins.

`Writer` writes the functions of events and what they call; `feed.py` puts them behind the walk over a read.

- An event, and the handler of a verdict, takes where the message is in the memory and its size (i32, i32), and returns
  bits (i32): `HAPPENED`, `DROPPED`, `CHANGED` (bytes are others), `ELSEWHERE`, `RESET`.
- What is beyond this part and every fault is `ELSEWHERE`: this message is for Python's functions, and what was done to
  it is taken back. Within a helper function it is a trap. Beyond are strings and vectors that are made, changed or
  kept, whole messages, what is published, recursion, `sin` and its like. An event of which no message can
  come past such a place has no module: `NotScalarError` names what is beyond.
- A line of output is noted behind those before, where `SAID` points, and the message at hand stands at `POSITION`
  (`output.py`).
- A variable of the set stands at its address, in 8 bytes. Before a field is written, what stood there is noted in the
  log (address, size, bytes; 16 bytes each) that `UNDO` points behind.
- What the form charges is taken from the budget of its specification, as everywhere.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from math import inf
from types import MappingProxyType
from typing import Any

from appliance.rosmop.ir import form
from appliance.rosmop.ir.output import BYTES, HEAD, Line, is_text
from appliance.rosmop.ir.values import Values, struct_code, struct_size
from appliance.rosmop.ir.wasm import (
    ABS,
    CALCULATE,
    COMPARE,
    DROP,
    ELSE,
    END,
    F32,
    F64,
    I32,
    I64,
    IF,
    LOAD,
    NEG,
    NOTHING,
    RETURN,
    SELECT,
    STORE,
    UNREACHABLE,
    constant,
    row,
    unsigned,
)
from appliance.rosmop.runtime import times
from appliance.rosmop.runtime.context import BYTES_PER_INSTRUCTION, UNMEASURED
from appliance.rosmop.runtime.times import BILLION
from appliance.rosmop.runtime.wire import FEW, MAX_EMPTY
from appliance.rosmop.types import kinds
from appliance.rosmop.types.kinds import Type

HAPPENED, DROPPED, CHANGED, ELSEWHERE, RESET = 1, 2, 4, 8, 16

POSITION, UNDO, SAID, NOW, SURE, FIRST = 0, 8, 12, 16, 24, 32
"""Where it stands which frame is looked at, where the log and the lines end, the time, and where the lines end of the
messages before; and what is given out begins.
"""

LINES = 64 << 10
"""Bytes for lines of output; a message whose line has no room is left."""

EARLY = 16
"""Bytes of a message: what is written into a header begins in them."""

MOST_TEXTS = 256
"""Strings of an array that is read; one of more is left."""


class NotScalarError(Exception):
    """A function has something that this part of the form does not have."""


def machine_type(kind: Type) -> int:
    """The type of the machine for one of the language. Raises `NotScalarError`."""
    if isinstance(kind, kinds.Bool) or (isinstance(kind, kinds.Integer) and kind.bits <= 32):
        return I32
    if isinstance(kind, kinds.Integer | kinds.Time | kinds.Duration | kinds.Index):
        return I64
    if isinstance(kind, kinds.Floating):
        return F32 if kind.bits == 32 else F64
    raise NotScalarError(str(kind))


def _is_signed(kind: Type) -> bool:
    return not isinstance(kind, kinds.Integer) or kind.signed


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
    noted: frozenset[str] = frozenset()
    exits: dict[int, int] = field(default_factory=dict)
    """Where it is kept how the states of a property were left (`why.Exits`, `why.ClockedSteps`), by its number."""
    clocks: dict[int, int] = field(default_factory=dict)
    """Where it stands when the clock of a property began, and its time (`ClockedRun`), by its number."""
    until: int = 0
    """Where it stands (i64) when the next is due that Python knows of: an earlier deadline is told."""
    variables: dict[str, tuple[int, Type]] = field(default_factory=dict)
    """Where each stands, and its type; in the order of the places."""

    def address(self, name: str, kind: Type) -> int:
        """Where a variable stands."""
        machine_type(kind)
        place = self.base + 8 * (self.properties + len(self.variables))
        return self.variables.setdefault(name, (place, kind))[0]


@dataclass(frozen=True)
class Written:
    """A function that is written: its types and code; what it assigns, how many fields it writes, and whether it drops.

    `brief`: without loops. `passes`: some message comes to its end. `says`: it may put out lines. `early`: it may write
    into the first bytes of the message, where a header is.
    """

    number: int
    parameters: tuple[int, ...]
    result: int
    code: bytes
    assigned: frozenset[str]
    writes: int
    drops: bool
    brief: bool
    passes: bool
    says: bool
    early: bool


class Writer:
    """The functions that are needed, in the order of their numbers, and what stands where in the memory."""

    def __init__(
        self, functions: Mapping[str, form.Function], shared: Mapping[str, Cells], values: Values
    ) -> None:
        self._values = values
        self.functions = functions
        self.shared = shared
        self.written: list[Written] = []
        self._numbers: dict[tuple[object, ...], Written] = {}
        self.budgets: dict[str, int] = {}
        self.throttles: dict[tuple[str, int], int] = {}
        """Where it stands when output at a site of a specification was last due."""
        self.lines: list[Line] = []
        self._used = FIRST
        self.said = self.take(LINES)
        """Where lines stand."""

    def size(self, kind: Type) -> int:
        """The bytes of every value of a type in a message. Raises `NotScalarError` where they differ."""
        code = struct_code(kind)
        if code is not None:
            return struct_size(code)
        if isinstance(kind, kinds.Record):
            return sum(map(self.size, self._values.fields(kind)))
        if isinstance(kind, kinds.Vector) and kind.length is not None:
            return kind.length * self.size(kind.element)
        raise NotScalarError(str(kind))

    def offset(self, kind: Type, number: int) -> int:
        """Where a field of a message begins in it. Raises `NotScalarError` where that differs."""
        if not isinstance(kind, kinds.Record):
            raise NotScalarError(str(kind))
        return sum(map(self.size, self._values.fields(kind)[:number]))

    def element(self, kind: Type) -> tuple[Type, int]:
        """The type of the elements of a string or vector, and the bytes from one to the next (strings: in the table).

        Raises `NotScalarError`.
        """
        if isinstance(kind, kinds.String):
            return kinds.UINT8, 1
        if not isinstance(kind, kinds.Vector):
            raise NotScalarError(str(kind))
        return kind.element, 4 if isinstance(kind.element, kinds.String) else self.size(kind.element)

    def copied(self, kind: Type) -> Type:
        """A message whose copy costs nothing. Raises `NotScalarError` of another."""
        if isinstance(kind, kinds.Record):
            for field in self._values.fields(kind):
                self.copied(field)
        elif struct_code(kind) is None:
            raise NotScalarError(str(kind))
        return kind

    def take(self, size: int) -> int:
        """The address of so many bytes of memory."""
        at = self._used
        self._used += -(-size // 8) * 8
        return at

    def budget(self, context: str) -> int:
        """Where the budget of a specification stands."""
        if context not in self.budgets:
            self.budgets[context] = self.take(8)
        return self.budgets[context]

    def throttle(self, context: str, site: int) -> int:
        """Where it stands when output at a site was last due."""
        if (context, site) not in self.throttles:
            self.throttles[context, site] = self.take(8)
        return self.throttles[context, site]

    def event(self, name: str) -> Written:
        """The function of an event, or of a handler. Raises `NotScalarError`."""
        function = self.functions[name]
        return self.function(function, {"at": I32, "size": I32}, I32, function.context)

    def function(
        self,
        function: form.Function | form.Skipper,
        parameters: Mapping[str, int],
        result: int,
        context: str,
    ) -> Written:
        """A function, written when it is first asked for; `context` is whose budget it takes from."""
        key = (function.name, tuple(parameters), result, context)
        if key not in self._numbers:
            written = _Body(self, function, parameters, result, context).written()
            self._numbers[key] = written
            self.written.append(written)
        return self._numbers[key]


class _Body:
    """Writes one function."""

    def __init__(
        self,
        writer: Writer,
        function: form.Function | form.Skipper,
        parameters: Mapping[str, int],
        result: int,
        context: str,
    ) -> None:
        self._writer = writer
        self._function = function
        self._result = result
        self._answers = isinstance(function, form.Function) and function.parameters == ("m",)
        self._is_handler = self._answers and function.happens is None  # type: ignore[union-attr]  # has looked
        self._context = context
        self._types = tuple(parameters.values())
        self._locals = {name: (index, kind) for index, (name, kind) in enumerate(parameters.items())}
        self._depth = 0  # blocks that are open
        self._loops: list[int] = []  # at which depth the block of each loop is
        self._depends = False  # whether messages may have left before
        self._assigned: set[str] = set()
        self._writes = 0
        self._drops = False
        self._brief = True
        self._says = False
        self._early = False
        self._bits: tuple[tuple[str, int], ...] = ()
        """What is answered besides whether it happened: the local variables, and how far each is shifted."""
        if self._answers:
            self._bits = (("dropped", 1), ("changed", 2), *([("reset", 4)] if self._is_handler else ()))
        for name, _ in self._bits:
            self._local(name, I32)

    def written(self) -> Written:
        """The function. Raises `NotScalarError`."""
        body = self._block(self._function.body)
        if isinstance(self._function, form.Skipper):
            body += self._position(self._function.end) + RETURN
        if self._is_handler:
            body += self._leave(form.Leave(-1, None))
        made = sorted(self._locals.values())[len(self._types) :]
        whole = row([b"\x01" + bytes((machine,)) for _, machine in made]) + body + UNREACHABLE + END
        return Written(
            len(self._writer.written),
            self._types,
            self._result,
            unsigned(len(whole)) + whole,
            frozenset(self._assigned),
            self._writes,
            self._drops,
            self._brief,
            self._depends,
            self._says,
            self._early,
        )

    # Parts

    def _local(self, name: str, machine: int) -> bytes:
        number, known = self._locals.setdefault(name, (len(self._locals), machine))
        if known != machine:
            raise NotScalarError(name)
        return unsigned(number)

    def _get(self, name: str, machine: int = I32) -> bytes:
        return b"\x20" + self._local(name, machine)

    def _set(self, name: str, machine: int = I32) -> bytes:
        return b"\x21" + self._local(name, machine)

    def _when(self, test: bytes, yes: Callable[[], bytes], no: Callable[[], bytes] | None = None) -> bytes:
        self._depth += 1
        inner = yes() + (ELSE + no() if no is not None else b"")
        self._depth -= 1
        return test + IF + NOTHING + inner + END

    def _elsewhere(self) -> bytes:
        return constant(I32, ELSEWHERE) + RETURN if self._answers else UNREACHABLE

    def _cell(self, opcode: int, address: int, value: bytes = b"") -> bytes:
        """Load or store at an address."""
        return constant(I32, 0) + value + bytes((opcode, 0)) + unsigned(address)

    # Statements

    def _block(self, statements: Sequence[form.Statement]) -> bytes:
        return b"".join(self._statement(statement) for statement in statements)

    def _statement(self, node: form.Statement) -> bytes:
        depth, loops = self._depth, len(self._loops)
        try:
            method = _STATEMENTS.get(type(node))
            if method is None:
                raise NotScalarError(type(node).__name__)
            return method(self, node)
        except NotScalarError:
            if not depth and not self._depends:
                raise
            self._depth = depth
            del self._loops[loops:]
            return self._elsewhere()

    def _evaluate(self, node: form.Evaluate) -> bytes:
        value = node.value.value if isinstance(node.value, form.Discard) else node.value
        if isinstance(value, form.Assign):
            return self._assigned_to(value)
        if isinstance(value, form.Literal) and value.value is None:
            return b""
        if isinstance(value, form.Conditional) and value.type == kinds.VOID:
            yes, no = ((form.Evaluate(node.site, branch),) for branch in (value.yes, value.no))
            return self._if(form.If(node.site, value.test, yes, no))
        return self._value(value) + DROP

    def _if(self, node: form.If) -> bytes:
        test = self._value(node.test)
        self._depends = True
        no = (lambda: self._block(node.no)) if node.no else None
        return self._when(test, lambda: self._block(node.yes), no)

    def _loop(self, node: form.Loop) -> bytes:
        self._brief = False
        return self._repeated(b"", node.body)

    def _times(self, left: str, each: bytes, body: Sequence[form.Statement] = ()) -> bytes:
        """A loop that is run as often as a local variable says, which counts down."""
        over = self._get(left, I64) + b"\x50\x0d\x01"
        less = self._get(left, I64) + constant(I64, 1) + b"\x7d" + self._set(left, I64)
        return self._repeated(over + less + each, body)

    def _repeated(self, before: bytes, body: Sequence[form.Statement]) -> bytes:
        """A loop without end; `before` may leave the outer of the two blocks."""
        self._depth += 2
        self._loops.append(self._depth)
        code = before + self._block(body)
        self._loops.pop()
        self._depth -= 2
        return b"\x02\x40\x03\x40" + code + b"\x0c\x00" + END + END

    def _for_each(self, node: form.ForEach) -> bytes:
        kind, size = self._writer.element(node.values.type)
        first, place, count = self._elements(node.values)
        self._brief = False
        at, left = (f"{what} {len(self._locals)}" for what in ("element", "left"))
        if isinstance(kind, kinds.String):
            each, begin, length = self._text_at(self._get(at))
            each += begin + self._set(f"place of {node.name}") + length
            each += self._set(f"count of {node.name}", I64)
        elif isinstance(kind, kinds.Record):
            each = self._get(at) + self._set(f"place of {node.name}")
        else:
            each = self._loaded(self._get(at), 0, kind) + self._set(node.name, machine_type(kind))
        following = self._get(at) + constant(I32, size) + b"\x6a" + self._set(at)
        code = first + place + self._set(at) + count + self._set(left, I64)
        return code + self._times(left, each + following, node.body)

    def _break(self, _node: form.Break) -> bytes:
        return b"\x0c" + unsigned(self._depth - self._loops[-1] + 1)

    def _continue(self, _node: form.Continue) -> bytes:
        return b"\x0c" + unsigned(self._depth - self._loops[-1])

    def _select(self, node: form.Select) -> bytes:
        machine = machine_type(node.value.type)
        value = f"{node.name} value"
        code = self._value(node.value) + self._set(value, machine) + constant(I32, node.default)
        code += self._set(node.name)
        for wanted, index in node.table:
            test = self._get(value, machine) + constant(machine, wanted) + bytes((COMPARE[machine]["=="],))
            chosen = constant(I32, index) + self._set(node.name)
            code += self._when(test, lambda chosen=chosen: chosen)  # type: ignore[misc]  # the row of this turn
        return code

    def _return(self, node: form.Return) -> bytes:
        if node.references:
            raise NotScalarError("references")
        if node.value.type == kinds.VOID:
            return constant(I32, 0) + RETURN
        return self._value(node.value) + RETURN

    def _leave(self, node: form.Leave) -> bytes:
        code = constant(I32, bool(node.happened))
        for name, shift in self._bits:
            code += self._get(name) + constant(I32, shift) + b"\x74\x72"
        return code + RETURN

    def _charge(self, node: form.Charge) -> bytes:
        return self._spend(constant(I64, node.instructions))

    def _spend(self, instructions: bytes) -> bytes:
        budget = self._writer.budget(self._context)
        left = self._cell(0x37, budget, self._cell(0x29, budget) + instructions + b"\x7d")
        return left + self._when(self._cell(0x29, budget) + constant(I64, 0) + b"\x53", self._elsewhere)

    def _allocate(self, node: form.Allocate) -> bytes:
        """Nothing is made here, but it costs the same."""
        if node.size is not None:
            return self._allocated(constant(I64, node.size))
        many = self._get("size") + constant(I32, form.CHARGED) + b"\x4b"
        return self._when(many, lambda: self._allocated(self._get("size") + b"\xad"))

    def _allocated(self, size: bytes) -> bytes:
        """Charge for so many bytes (i64) that would be made; elsewhere if what the specification holds is measured."""
        many = size + constant(I64, UNMEASURED) + b"\x56"
        spent = size + constant(I64, BYTES_PER_INSTRUCTION) + b"\x80"
        return self._when(many, self._elsewhere) + self._spend(spent)

    def _pending(self, _node: form.Pending) -> bytes:
        """Only `Whole` asks for it."""
        return b""

    def _drop(self, _node: form.Drop) -> bytes:
        self._drops = True
        return constant(I32, 1) + self._set("dropped")

    def _reset(self, _node: form.Reset) -> bytes:
        return constant(I32, 1) + self._set("reset")

    def _read_value(self, node: form.ReadValue) -> bytes:
        place, count, start = f"place of {node.name}", f"count of {node.name}", node.at
        if isinstance(node.type, kinds.Record):
            size = self._writer.size(node.type)
            code = self._within(start, size) + self._get("at") + self._position(start) + b"\xa7\x6a"
            return code + self._set(place) + self._position(start.plus(size)) + self._set(node.end, I64)
        element, size = self._writer.element(node.type)
        if isinstance(element, kinds.String):
            return self._read_texts(node)
        if isinstance(node.type, kinds.Vector) and node.type.length is not None:
            code = self._within(start, node.type.length * size)
            code += constant(I64, node.type.length) + self._set(count, I64)
        else:
            code, start = self._count(form.Count(node.site, count, start, size)), start.plus(4)
        code += self._get("at") + self._position(start) + b"\xa7\x6a" + self._set(place)
        return code + self._after_elements(form.AfterElements(node.site, node.end, start, count, size))

    def _read_texts(self, node: form.ReadValue) -> bytes:
        """Note where each string of an array begins."""
        if isinstance(node.type, kinds.Vector) and node.type.length is not None:
            raise NotScalarError(str(node.type))
        count, left, entry = (
            f"count of {node.name}",
            f"left {len(self._locals)}",
            f"entry {len(self._locals)}",
        )
        table = constant(I32, self._writer.take(4 * MOST_TEXTS))
        code = self._count(form.Count(node.site, count, node.at, 4))
        many = self._get(count, I64) + constant(I64, MOST_TEXTS) + b"\x56"
        code += self._when(many, self._elsewhere) + self._get(count, I64) + self._set(left, I64)
        code += self._position(node.at.plus(4)) + self._set(node.end, I64) + table + self._set(entry)
        each = self._get(entry) + self._get("at") + self._get(node.end, I64) + b"\xa7\x6a\x36\x00\x00"
        each += self._after_text(form.AfterText(node.site, node.end, form.Spot(node.end, 0)))
        beyond = self._get(node.end, I64) + self._get("size") + b"\xad\x56"
        each += self._when(beyond, self._elsewhere)
        each += self._get(entry) + constant(I32, 4) + b"\x6a" + self._set(entry)
        return code + self._times(left, each) + table + self._set(f"place of {node.name}")

    def _text_at(self, entry: bytes) -> tuple[bytes, bytes, bytes]:
        """The string that begins where an entry of a table says, as `_elements`."""
        name = f"text {len(self._locals)}"
        first = entry + b"\x28\x00\x00" + self._set(name)
        return first, self._get(name) + constant(I32, 4) + b"\x6a", self._get(name) + b"\x28\x00\x00\xad"

    def _elements(self, node: form.Expression) -> tuple[bytes, bytes, bytes]:
        """What comes first; the address of the first element of a string or vector, and how many there are (i64)."""
        if isinstance(node, form.Copy):
            first, place, count = self._elements(node.value)
            element, size = self._writer.element(node.type)
            machine_type(element)
            return first + self._allocated(count + constant(I64, size) + b"\x7e"), place, count
        if (
            isinstance(node.type, kinds.String)
            and isinstance(node, form.Call)
            and node.function == "l_element"
        ):
            return self._text_at(self._address_of(node))
        if (
            isinstance(node, form.Item)
            and isinstance(node.type, kinds.Vector)
            and node.type.length is not None
        ):
            first, place = self._place(node)
            return first, place, constant(I64, node.type.length)
        if not isinstance(node, form.Read) or f"place of {node.name}" not in self._locals:
            raise NotScalarError(str(node.type))
        return b"", self._get(f"place of {node.name}"), self._get(f"count of {node.name}", I64)

    def _place(self, node: form.Expression) -> tuple[bytes, bytes]:
        """What comes first; the address of a message within this one, or of an array of fixed length."""
        if isinstance(node, form.Copy):
            self._writer.copied(node.type)
            return self._place(node.value)
        if isinstance(node, form.Item):
            first, place = self._place(node.base)
            return first, place + constant(I32, self._writer.offset(node.base.type, node.number)) + b"\x6a"
        if isinstance(node, form.Call) and node.function == "l_element":
            name, code = f"element {len(self._locals)}", self._address_of(node)
            return code + self._set(name), self._get(name)
        if not isinstance(node, form.Read) or f"place of {node.name}" not in self._locals:
            raise NotScalarError(str(node.type))
        return b"", self._get(f"place of {node.name}")

    def _require(self, node: form.Require) -> bytes:
        test, leave = self._value(node.test) + b"\x45", form.Leave(node.site, False)
        self._depends = True
        return self._when(test, lambda: self._leave(leave))

    def _not_past(self, node: form.NotPast) -> bytes:
        past = self._get(node.count, I64) + constant(I64, node.index) + b"\x57"
        self._depends = True
        return self._when(past, self._elsewhere)

    def _skip(self, node: form.Skip) -> bytes:
        count = constant(I64, node.count) if isinstance(node.count, int) else self._get(node.count, I64)
        left, place = (f"{what} {len(self._locals)}" for what in ("left", "place"))
        code = count + self._set(left, I64) + self._position(node.at) + self._set(place, I64)
        if node.inner:
            code += self._spend(self._get(left, I64) + constant(I64, 1) + b"\x7c")
        else:
            many = self._get(left, I64) + constant(I64, FEW) + b"\x56"
            code += self._when(many, lambda: self._spend(self._get(left, I64)))
        if node.skipper is None:
            end = self._after_text(form.AfterText(node.site, place, form.Spot(place, 0)))
        else:
            given = {"at": I32, "size": I32, "p": I64}
            skipper = self._writer.function(node.skipper, given, I64, self._context)
            end = self._get("at") + self._get("size") + self._get(place, I64)
            end += b"\x10" + unsigned(skipper.number) + self._set(place, I64)
        code += self._times(left, end)
        return code + self._get(place, I64) + self._set(node.name, I64)

    def _read_numbers(self, node: form.ReadNumbers) -> bytes:
        end = max(offset + struct_size(struct_code(kind) or "") for _, kind, offset in node.fields)
        code = self._within(node.at, end)
        for name, kind, offset in node.fields:
            place = self._get("at")
            place += b"" if node.at.base is None else self._get(node.at.base, I64) + b"\xa7\x6a"
            code += self._loaded(place, node.at.offset + offset, kind) + self._set(name, machine_type(kind))
        return code

    def _position(self, at: form.Spot) -> bytes:
        """A position, in 64 bits: the lengths in a message are not to be trusted."""
        offset = constant(I64, at.offset)
        return offset if at.base is None else self._get(at.base, I64) + offset + b"\x7c"

    def _within(self, at: form.Spot, size: int) -> bytes:
        """A fault unless so many bytes of the message stand there."""
        short = self._get("size") + b"\xad" + self._position(at.plus(size)) + b"\x54"
        return self._when(short, self._elsewhere)

    def _at(self, at: form.Spot, opcode: int) -> tuple[bytes, bytes]:
        """What stands before and in an access of the message at a position that is within it."""
        base = self._get("at") + (b"" if at.base is None else self._get(at.base, I64) + b"\xa7\x6a")
        return base, bytes((opcode, 0)) + unsigned(at.offset)

    def _loaded(self, place: bytes, offset: int, kind: Type) -> bytes:
        """A number or time so many bytes behind a place."""
        codes = struct_code(kind) or ""
        if len(codes) == 2:
            extend = b"\xad" if codes[0] == "I" else b"\xac"
            seconds, rest = (place + b"\x28\x00" + unsigned(offset + more) + extend for more in (0, 4))
            return seconds + constant(I64, BILLION) + b"\x7e" + rest + b"\x7c"
        code = place + bytes((LOAD[codes], 0)) + unsigned(offset)
        return code + (b"\x45\x45" if codes == "?" else b"")

    def _after_text(self, node: form.AfterText) -> bytes:
        length = b"".join(self._at(node.at, 0x28)) + b"\xad"
        end = self._position(node.at.plus(4)) + length + b"\x7c"
        return self._within(node.at, 4) + end + self._set(node.name, I64)

    def _count(self, node: form.Count) -> bytes:
        """The number of elements, in 64 bits; a fault if so many are not there."""
        code = self._within(node.at, 4) + b"".join(self._at(node.at, 0x28)) + b"\xad"
        number = self._get(node.name, I64)
        room = self._get("size") + b"\xad" + self._position(node.at.plus(4)) + b"\x7d"
        least = number + constant(I64, node.least) + b"\x7e"
        if not node.least:
            least, room = number, constant(I64, MAX_EMPTY)
        return code + self._set(node.name, I64) + self._when(least + room + b"\x56", self._elsewhere)

    def _after_elements(self, node: form.AfterElements) -> bytes:
        count = constant(I64, node.count) if isinstance(node.count, int) else self._get(node.count, I64)
        end = self._position(node.at) + count + constant(I64, node.size) + b"\x7e\x7c"
        return end + self._set(node.name, I64)

    def _write_back(self, node: form.WriteBack) -> bytes:
        code = self._when(self._get("dropped"), lambda: self._leave(form.Leave(node.site, True)))
        for write in node.writes:
            if write.end is not None:
                code += self._when(self._get(write.flag), self._elsewhere)
                continue
            self._writes += 1
            self._early = self._early or (write.at.base is None and write.at.offset < EARLY)
            code += self._when(self._get(write.flag), partial(self._put_field, write))
        return code

    def _put_field(self, write: form.Write) -> bytes:
        """Put a number where it differs, bit by bit; Python decides which bits a NaN has."""
        codes = struct_code(write.value.type) or ""
        machine, size = machine_type(write.value.type), struct_size(codes)
        whole = I64 if size == 8 else I32
        new, value = f"new {whole}", self._value(write.value)
        code = b""
        if machine in (F32, F64):
            kept = f"kept {machine}"
            none = self._get(kept, machine) + self._get(kept, machine) + bytes((COMPARE[machine]["!="],))
            code = value + self._set(kept, machine) + self._when(none, self._elsewhere)
            value = self._get(kept, machine) + (b"\xbc" if machine == F32 else b"\xbd")
        elif len(codes) == 2:
            code, value = self._parts_of(write.value.type, value)
        code += value + self._set(new, whole)
        load = {1: 0x2D, 2: 0x2F, 4: 0x28, 8: 0x29}[size]
        mask = constant(I32, (1 << 8 * size) - 1) + b"\x71" if size < 4 else b""
        old = b"".join(self._at(write.at, load))
        differs = old + self._get(new, whole) + mask + bytes((COMPARE[whole]["!="],))

        def put() -> bytes:
            entry, end = self._get("entry"), self._cell(0x28, UNDO) + self._set("entry")
            base = b"" if write.at.base is None else self._get(write.at.base, I64) + b"\xa7\x6a"
            address = self._get("at") + base + constant(I32, write.at.offset) + b"\x6a"
            note = entry + address + b"\x36\x00\x00" + entry + constant(I32, size) + b"\x36\x00\x04"
            note += entry + old + (b"" if whole == I64 else b"\xad") + b"\x37\x00\x08"
            note += self._cell(0x36, UNDO, entry + constant(I32, 16) + b"\x6a")
            place, store = self._at(write.at, STORE[size])
            return (
                end + note + place + self._get(new, whole) + store + constant(I32, 1) + self._set("changed")
            )

        return code + self._when(differs, put)

    def _parts_of(self, kind: Type, moment: bytes) -> tuple[bytes, bytes]:
        """What divides nanoseconds into seconds and the rest; the two as they stand."""
        code = self._limited(kind, moment) + self._seconds() + self._set("whole", I64)
        low = self._get("whole", I64) + constant(I64, 0xFFFFFFFF) + b"\x83"
        return code, low + self._get("rest", I64) + constant(I64, 32) + b"\x86\x84"

    # Expressions

    def _value(self, node: form.Expression) -> bytes:
        method = _EXPRESSIONS.get(type(node))
        if method is None:
            raise NotScalarError(type(node).__name__)
        return method(self, node)

    def _literal(self, node: form.Literal) -> bytes:
        if not isinstance(node.value, int | float):
            raise NotScalarError(repr(node.value))
        return constant(machine_type(node.type), node.value)

    def _zero(self, node: form.Zero) -> bytes:
        return constant(machine_type(node.type), 0)

    def _read(self, node: form.Read) -> bytes:
        machine = machine_type(node.type)
        cells = self._writer.shared.get(node.name)
        if cells is None:
            return self._get(node.name, machine)
        load = {I32: 0x28, I64: 0x29, F32: 0x2A, F64: 0x2B}[machine]
        return self._cell(load, cells.address(node.name, node.type))

    def _assigned_to(self, node: form.Assign) -> bytes:
        if isinstance(node.type, kinds.String | kinds.Vector) and node.name not in self._writer.shared:
            code, place, count = self._elements(node.value)
            code += place + self._set(f"place of {node.name}")
            return code + count + self._set(f"count of {node.name}", I64)
        if isinstance(node.type, kinds.Record) and node.name not in self._writer.shared:
            return b"".join(self._place(node.value)) + self._set(f"place of {node.name}")
        machine, value = machine_type(node.type), self._value(node.value)
        cells = self._writer.shared.get(node.name)
        if cells is None:
            return value + self._set(node.name, machine)
        self._assigned.add(node.name)
        store = {I32: 0x36, I64: 0x37, F32: 0x38, F64: 0x39}[machine]
        return self._cell(store, cells.address(node.name, node.type), value)

    def _assign(self, node: form.Assign) -> bytes:
        return self._assigned_to(node) + self._read(form.Read(node.type, node.name))

    def _convert(self, node: form.Convert) -> bytes:
        code, source, target = self._value(node.value), node.value.type, node.type
        one, other = machine_type(source), machine_type(target)
        if isinstance(target, kinds.Bool):
            return code + constant(one, 0) + bytes((COMPARE[one]["!="],))
        if isinstance(target, kinds.Floating):
            return code + _to_floating(one, other, signed=_is_signed(source))
        assert isinstance(target, kinds.Integer)  # noqa: S101  numbers are one of the three
        if isinstance(source, kinds.Floating):
            return self._truncated(code + (b"\xbb" if one == F32 else b""), target)
        if one == other:
            return code + _narrowed(target)
        if other == I64:
            return code + (b"\xac" if _is_signed(source) else b"\xad")
        return code + b"\xa7" + _narrowed(target)

    def _truncated(self, code: bytes, target: kinds.Integer) -> bytes:
        """A double toward zero, at most the limits."""
        if target.bits >= 32:
            wide = 4 if target.bits == 64 else 0
            return code + b"\xfc" + bytes((2 + wide + (not target.signed),))
        code += b"\xfc\x02" + self._set("cut")
        for limit, operator in ((target.least, "<"), (target.most, ">")):
            limited, value = constant(I32, limit), self._get("cut")
            test = value + limited + bytes((COMPARE[I32][operator],))
            code += limited + value + test + SELECT + self._set("cut")
        return code + self._get("cut")

    def _arithmetic(self, node: form.Arithmetic) -> bytes:
        machine, operator = machine_type(node.type), node.operator
        left, right = self._value(node.left), self._value(node.right)
        opcode = CALCULATE[machine][operator]
        if machine in (F32, F64) or operator in "+-*&|^":
            return left + right + bytes((opcode,))
        unsigned = not _is_signed(node.type)
        if operator in ("<<", ">>"):
            if machine_type(node.right.type) != machine:
                right += b"\xa7" if machine == I32 else b"\xad"
            return left + right + bytes((opcode + (unsigned and operator == ">>"),))
        return self._divided(node, left, right, bytes((opcode + unsigned,)))

    def _divided(self, node: form.Arithmetic, left: bytes, right: bytes, opcode: bytes) -> bytes:
        machine = machine_type(node.type)
        one, other = (f"{side} {machine} {len(self._locals)}" for side in ("dividend", "divisor"))
        code = left + self._set(one, machine) + right + self._set(other, machine)
        zero = self._get(other, machine) + (b"\x45" if machine == I32 else b"\x50")
        code += self._when(zero, self._elsewhere)
        quotient = self._get(one, machine) + self._get(other, machine) + opcode
        if node.operator == "%" or not _is_signed(node.type):
            return code + quotient
        minus = self._get(other, machine) + constant(machine, -1) + bytes((COMPARE[machine]["=="],))
        negated = constant(machine, 0) + self._get(one, machine) + bytes((CALCULATE[machine]["-"],))
        return code + minus + IF + bytes((machine,)) + negated + ELSE + quotient + END

    def _unary(self, node: form.Unary) -> bytes:
        machine, value = machine_type(node.type), self._value(node.value)
        if machine in (F32, F64):
            return value + bytes(((ABS if node.operator == "abs" else NEG)[machine],))
        if node.operator == "~":
            return value + constant(machine, -1) + bytes((CALCULATE[machine]["^"],))
        kept = f"kept {machine}"
        code = value + self._set(kept, machine)
        negated = constant(machine, 0) + self._get(kept, machine) + bytes((CALCULATE[machine]["-"],))
        if node.operator == "-":
            return code + negated
        if not _is_signed(node.type):
            return code + self._get(kept, machine)
        negative = self._get(kept, machine) + constant(machine, 0) + bytes((COMPARE[machine]["<"],))
        return code + negated + self._get(kept, machine) + negative + SELECT

    def _compare(self, node: form.Compare) -> bytes:
        machine = machine_type(node.left.type)
        opcode = COMPARE[machine][node.operator]
        if node.operator not in ("==", "!=") and not _is_signed(node.left.type):
            opcode += 1
        return self._value(node.left) + self._value(node.right) + bytes((opcode,))

    def _compare_texts(self, node: form.CompareTexts) -> bytes:
        """A string of the message and a short constant: as long, and the same bytes."""
        given, known = (
            (node.right, node.left) if isinstance(node.left, form.Literal) else (node.left, node.right)
        )
        if node.operator not in ("==", "!=") or not isinstance(known, form.Literal) or not node.short:
            raise NotScalarError("std::string")
        assert isinstance(known.value, bytes)  # noqa: S101  a constant of strings
        first, place, count = self._elements(given)
        if len(known.value) > form.SHORT:
            raise NotScalarError("std::string")
        same, at = constant(I32, 1), 0
        while at < len(known.value):
            size = max(size for size in (1, 2, 4, 8) if size <= len(known.value) - at)
            number = int.from_bytes(known.value[at : at + size], "little")
            machine, load = {1: (I32, 0x2D), 2: (I32, 0x2F), 4: (I32, 0x28), 8: (I64, 0x29)}[size]
            same += place + bytes((load, 0)) + unsigned(at) + constant(machine, number)
            same += bytes((COMPARE[machine]["=="],)) + b"\x71"
            at += size
        as_long = count + constant(I64, len(known.value)) + b"\x51"
        code = first + as_long + IF + bytes((I32,)) + same + ELSE + constant(I32, 0) + END
        return code + (b"\x45" if node.operator == "!=" else b"")

    def _logical(self, node: form.Logical) -> bytes:
        yes, no = self._nested(node.right), constant(I32, node.operator == "or")
        branches = (yes, no) if node.operator == "and" else (no, yes)
        return self._value(node.left) + IF + bytes((I32,)) + branches[0] + ELSE + branches[1] + END

    def _nested(self, node: form.Expression) -> bytes:
        self._depth += 1
        code = self._value(node)
        self._depth -= 1
        return code

    def _not(self, node: form.Not) -> bytes:
        return self._value(node.value) + b"\x45"

    def _conditional(self, node: form.Conditional) -> bytes:
        kind = bytes((machine_type(node.type),))
        yes, no = self._nested(node.yes), self._nested(node.no)
        return self._value(node.test) + IF + kind + yes + ELSE + no + END

    def _sequence(self, node: form.Sequence) -> bytes:
        chosen = node.chosen % len(node.items)
        values = [
            self._value(item) + (b"" if index == chosen else DROP) for index, item in enumerate(node.items)
        ]
        return b"".join(values)

    def _now(self, _node: form.Now) -> bytes:
        return self._cell(0x29, NOW)

    def _log(self, node: form.Log) -> bytes:
        """Note the values of a line, and what line it is."""
        line, number = Line(node, self._context), len(self._locals)
        code, cost, stores = b"", constant(I64, line.cost), b""
        for place, value in enumerate(line.values):
            first, slot, size = self._slot(value, f"value {place} {number}", HEAD.size + 8 * place)
            code, stores, cost = code + first, stores + slot, cost + size
        code += self._cell(0x28, SAID) + self._set("line")
        end = self._get("line") + constant(I32, line.size) + b"\x6a"
        full = end + constant(I32, self._writer.said + LINES) + b"\x4b"
        code += self._when(full, self._elsewhere) + self._spend(cost) + self._cell(0x36, SAID, end)
        for offset, head in ((0, constant(I32, len(self._writer.lines))), (4, self._cell(0x28, POSITION))):
            code += self._get("line") + head + b"\x36\x00" + unsigned(offset)
        self._writer.lines.append(line)
        self._says = True
        return code + stores + constant(I32, 0)

    def _slot(self, node: form.Expression, name: str, at: int) -> tuple[bytes, bytes, bytes]:
        """What comes first; what puts a value into the line (of a string: its place and length); its cost."""
        line, to = self._get("line"), unsigned(at)
        if is_text(node):
            first, place, count = self._elements(node)
            first += place + self._set(name) + count + self._set(f"count of {name}", I64)
            length = self._get(f"count of {name}", I64)
            put = (
                line + self._get(name) + b"\x36\x00" + to + line + length + b"\xa7\x36\x00" + unsigned(at + 4)
            )
            return first, put, length + constant(I64, BYTES) + b"\x80\x7c"
        machine = machine_type(node.type)
        first, value = self._value(node) + self._set(name, machine), self._get(name, machine)
        if machine in (F32, F64):
            return first, line + value + (b"\xbb" if machine == F32 else b"") + b"\x39\x00" + to, b""
        wide = (b"\xac" if _is_signed(node.type) else b"\xad") if machine == I32 else b""
        return first, line + value + wide + b"\x37\x00" + to, b""

    def _throttle(self, node: form.Throttle) -> bytes:
        """Output that is not due yet; Python puts out what is, and notes when."""
        seconds = self._value(node.seconds) + _to_floating(
            machine_type(node.seconds.type), F64, signed=_is_signed(node.seconds.type)
        )
        last, now = self._cell(0x29, self._writer.throttle(self._context, node.site)), self._cell(0x29, NOW)
        until = last + b"\xb9" + seconds + constant(F64, 1e9) + b"\xa2\xa0\x9b\xfc\x06"
        waits = last + now + b"\x57" + now + until + b"\x53\x71"
        return self._when(waits + b"\x45", self._elsewhere) + constant(I32, 0)

    def _accumulate(self, node: form.Accumulate) -> bytes:
        kind, size = self._writer.element(node.vector.type)
        code, place, count = self._elements(node.vector)
        number = len(self._locals)
        total, each = (f"{what} {number}" for what in ("sum", "summand"))
        at, left, last = (f"{what} {number}" for what in ("element", "left", "last"))
        code += self._value(node.start) + self._set(total, machine_type(node.type))
        code += self._value(node.first) + self._set(left, I64) + self._value(node.last) + self._set(last, I64)
        outside = self._get(left, I64) + self._get(last, I64) + b"\x56" + self._get(last, I64) + count
        code += self._when(outside + b"\x56\x72", self._elsewhere)
        code += place + self._get(left, I64) + b"\xa7" + constant(I32, size) + b"\x6c\x6a" + self._set(at)
        code += self._get(last, I64) + self._get(left, I64) + b"\x7d" + self._set(left, I64)
        code += self._spend(self._get(left, I64))
        one, other = (
            form.Convert(node.wide, form.Read(*part)) for part in ((node.type, total), (kind, each))
        )
        added = form.Convert(node.type, form.Arithmetic(node.wide, "+", one, other, node.site))
        span = form.Assign(node.type, total, added)
        summed = self._loaded(self._get(at), 0, kind) + self._set(each, machine_type(kind))
        summed += self._evaluate(form.Evaluate(node.site, span))
        summed += self._get(at) + constant(I32, size) + b"\x6a" + self._set(at)
        self._brief = False
        code += self._times(left, summed)
        return code + self._get(total, machine_type(node.type))

    def _moment(self, node: form.Moment) -> bytes:
        both = self._value(node.left) + self._value(node.right)
        return self._limited(node.type, both + bytes((CALCULATE[I64][node.operator],)))

    def _moment_of(self, node: form.MomentOf) -> bytes:
        return self._limited(
            node.type, self._of_parts(self._value(node.seconds), self._value(node.nanoseconds))
        )

    def _of_parts(self, seconds: bytes, nanoseconds: bytes) -> bytes:
        """Nanoseconds of two numbers in 64 bits; elsewhere if they are so large that this would not be exact."""
        code, names = b"", [f"{part} {len(self._locals)}" for part in ("seconds", "nanoseconds")]
        for name, value, most in zip(names, (seconds, nanoseconds), (1 << 32, 1 << 61), strict=True):
            code += value + self._set(name, I64)
            wide = self._get(name, I64) + constant(I64, most) + b"\x7c" + constant(I64, 2 * most) + b"\x56"
            code += self._when(wide, self._elsewhere)
        return (
            code
            + self._get(names[0], I64)
            + constant(I64, BILLION)
            + b"\x7e"
            + self._get(names[1], I64)
            + b"\x7c"
        )

    def _limited(self, kind: Type, code: bytes) -> bytes:
        """A time or duration, elsewhere if it is none."""
        least, most = (0, times.MAX_TIME) if kind == kinds.TIME else (times.MIN_DURATION, times.MAX_DURATION)
        name = f"moment {len(self._locals)}"
        code += self._set(name, I64)
        for limit, opcode in ((least, b"\x53"), (most, b"\x55")):
            code += self._when(self._get(name, I64) + constant(I64, limit) + opcode, self._elsewhere)
        return code + self._get(name, I64)

    def _call(self, node: form.Call) -> bytes:
        special = _SPECIAL.get(node.function)
        if special is not None:
            return special(self, node)
        argument = node.arguments[0]
        if node.function in _OF_COUNTS:
            first, _, count = self._elements(argument)
            return first + count + _OF_COUNTS[node.function]
        if node.function in _QUESTIONS:
            return self._question(argument, _QUESTIONS[node.function])
        opcode = _OPCODES.get((node.function, machine_type(argument.type)))
        if opcode is not None:
            return b"".join(map(self._value, node.arguments)) + opcode
        if node.function not in _OF_MOMENTS:
            raise NotScalarError(node.function)
        code = self._value(argument) + _OF_MOMENTS[node.function](self)
        return code + b"\xa7" if machine_type(node.type) == I32 else code

    def _element_at(self, node: form.Call) -> bytes:
        code = self._address_of(node) + self._set("element")
        return code + self._loaded(self._get("element"), 0, node.type)

    def _item(self, node: form.Item) -> bytes:
        machine_type(node.type)
        first, place = self._place(node.base)
        return first + self._loaded(place, self._writer.offset(node.base.type, node.number), node.type)

    def _address_of(self, node: form.Call) -> bytes:
        """The address of an element."""
        values, index = node.arguments
        _, size = self._writer.element(values.type)
        first, place, count = self._elements(values)
        code = first + self._value(index) + self._set("index", I64)
        past = self._get("index", I64) + count + b"\x5a"
        code += self._when(past, self._elsewhere)
        return code + place + self._get("index", I64) + b"\xa7" + constant(I32, size) + b"\x6c\x6a"

    def _question(self, argument: form.Expression, operator: str) -> bytes:
        """Compare the size of a number with infinity."""
        machine = machine_type(argument.type)
        if machine not in (F32, F64):
            raise NotScalarError(str(argument.type))
        size = self._value(argument) + bytes((ABS[machine],))
        compared = size + constant(machine, inf) + bytes((COMPARE[machine][operator.strip("!")],))
        return compared + (b"\x45" if operator.startswith("!") else b"")

    def _with_part(self, node: form.Call) -> bytes:
        """A time with other seconds, or other nanoseconds."""
        moment, part, new = node.arguments
        assert isinstance(part, form.Literal)  # noqa: S101  the name of a part
        value = self._value(new)
        if machine_type(new.type) == I32:
            value += b"\xac" if _is_signed(new.type) else b"\xad"
        old = self._value(moment)
        if part.value == "sec":
            return self._limited(node.type, self._of_parts(value, old + self._nanoseconds()))
        return self._limited(node.type, self._of_parts(old + self._seconds(), value))

    def _nanoseconds(self) -> bytes:
        """The part of a moment: not less than nothing."""
        code, value = self._set("moment", I64), self._get("moment", I64)
        whole = self._get("whole", I64)
        code += value + constant(I64, BILLION) + b"\x81" + self._set("whole", I64)
        more = whole + constant(I64, BILLION) + b"\x7c" + self._set("whole", I64)
        return code + self._when(whole + constant(I64, 0) + b"\x53", lambda: more) + whole

    def _seconds(self) -> bytes:
        rest = self._nanoseconds() + self._set("rest", I64)
        return (
            rest
            + self._get("moment", I64)
            + self._get("rest", I64)
            + b"\x7d"
            + constant(I64, BILLION)
            + b"\x7f"
        )

    def _in_seconds(self) -> bytes:
        """A moment as a double, rounded once: what has more than 53 bits is divided by 5^9 with 40 bits behind the
        point, the last of which says whether something is left, and then by 2^9.
        """
        code, value = self._set("moment", I64), self._get("moment", I64)
        size = self._get("whole", I64)
        negative = value + constant(I64, 0) + b"\x53"
        code += constant(I64, 0) + value + b"\x7d" + value + negative + SELECT + self._set("whole", I64)
        short = size + b"\xb9" + constant(F64, 1e9) + b"\xa3"
        over = constant(I64, 5**9)
        rest = size + over + b"\x82" + constant(I64, 40) + b"\x86" + self._set("rest", I64)
        left = self._get("rest", I64) + over + b"\x82\x50\x45\xad"
        behind = (
            self._get("rest", I64) + over + b"\x80" + left + b"\x84\xb9" + constant(F64, 2.0**-40) + b"\xa2"
        )
        long = rest + size + over + b"\x80\xb9" + behind + b"\xa0" + constant(F64, 2.0**-9) + b"\xa2"
        code += size + constant(I64, 1 << 53) + b"\x54" + IF + bytes((F64,)) + short + ELSE + long + END
        code += self._set("in seconds", F64)
        result = self._get("in seconds", F64)
        return code + result + bytes((NEG[F64],)) + result + negative + SELECT

    def _least(self, node: form.Call) -> bytes:
        """`std::min` and `std::max`: the second if it is less, or greater; `fmin` and `fmax`: or the first is NaN."""
        machine = machine_type(node.type)
        one, other = (f"{side} {machine} {len(self._locals)}" for side in ("first", "second"))
        code = b"".join(
            self._value(argument) + self._set(name, machine)
            for name, argument in zip((one, other), node.arguments, strict=True)
        )
        opcode = COMPARE[machine]["<" if "min" in node.function else ">"] + (not _is_signed(node.type))
        test = self._get(other, machine) + self._get(one, machine) + bytes((opcode,))
        if node.function not in ("h_min", "h_max"):
            none = self._get(one, machine) + self._get(one, machine) + bytes((COMPARE[machine]["!="],))
            test += none + b"\x72"
        return code + self._get(other, machine) + self._get(one, machine) + test + SELECT

    def _invoke(self, node: form.Invoke) -> bytes:
        if node.depth is not None:
            raise NotScalarError("recursion")
        result = I32 if node.type == kinds.VOID else machine_type(node.type)
        function = self._writer.functions[node.function]
        parameters: dict[str, int] = {}
        code = b""
        for name, argument in zip(function.parameters, node.arguments, strict=True):
            if isinstance(argument.type, kinds.String | kinds.Vector):
                parameters |= {f"place of {name}": I32, f"count of {name}": I64}
                code += b"".join(self._elements(argument))
            elif isinstance(argument.type, kinds.Record):
                parameters[f"place of {name}"] = I32
                code += b"".join(self._place(argument))
            else:
                parameters[name] = machine_type(argument.type)
                code += self._value(argument)
        called = self._writer.function(function, parameters, result, function.context)
        self._assigned |= called.assigned
        self._brief = self._brief and called.brief
        self._says = self._says or called.says
        return code + b"\x10" + unsigned(called.number)


def _to_floating(source: int, target: int, *, signed: bool) -> bytes:
    if source in (F32, F64):
        return b"" if source == target else b"\xb6" if target == F32 else b"\xbb"
    first = 0xB2 if target == F32 else 0xB7
    return bytes((first + 2 * (source == I64) + (not signed),))


def _narrowed(target: kinds.Integer) -> bytes:
    """Wrap what stands in 32 bits into fewer."""
    if target.bits >= 32:
        return b""
    if target.signed:
        return b"\xc0" if target.bits == 8 else b"\xc1"
    return constant(I32, target.most) + b"\x71"


_EXACT = {"fabs": 0x99, "ceil": 0x9B, "floor": 0x9C, "trunc": 0x9D, "rint": 0x9E, "nearbyint": 0x9E, "sqrt": 0x9F,
          "copysign": 0xA6}  # fmt: skip
_OPCODES = {
    **{(f"h_{name}", F64): bytes((code,)) for name, code in _EXACT.items()},
    **{(f"h_{name}f", F32): bytes((code - 14,)) for name, code in _EXACT.items()},
    ("m_is_zero", I64): b"\x50",
    ("m_whole", I64): b"",
    ("k_after", I64): b"\x7c",
    ("k_before", I64): b"\x7d",
}
_SPECIAL: Mapping[str, Callable[[_Body, form.Call], bytes]] = MappingProxyType(
    {
        **dict.fromkeys(("h_min", "h_max", "h_fmin", "h_fmax", "h_fminf", "h_fmaxf"), _Body._least),
        "a_part": _Body._with_part,
        "l_element": _Body._element_at,
    }
)
_OF_COUNTS = {"l_len": b"", "l_empty": b"\x50", "l_last": constant(I64, 1) + b"\x7d"}
_QUESTIONS = {"h_isinf": "==", "h_isfinite": "<", "h_isnan": "!<="}
_OF_MOMENTS: Mapping[str, Callable[[_Body], bytes]] = MappingProxyType(
    {"m_nsec": _Body._nanoseconds, "m_sec": _Body._seconds, "m_seconds": _Body._in_seconds}
)

_STATEMENTS: Mapping[type[Any], Callable[[_Body, Any], bytes]] = form.methods_of(_Body, form.Statement)
_EXPRESSIONS: Mapping[type[Any], Callable[[_Body, Any], bytes]] = form.methods_of(_Body, form.Expression)
