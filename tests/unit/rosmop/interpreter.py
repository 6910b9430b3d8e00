"""What the form means: runs it node by node, plainly and slowly. Every faster way is held against it.

One method for each kind of expression and statement, in the order of `form.py`. Strings are bytes, vectors and messages
lists, times and durations integers; everything else is the Python value that is closest. What the functions of the
form do is in `runtime/`, how values stand in a message in `values.py`.

Invariants:

1. A fault stops the function that faults and all that have called it; where it was is in `fault` then.
2. A name is that of a variable of the set, or of one call: nothing outlives a call but those and what is in them.
"""

import struct
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import Any

from appliance.rosmop.ir import form
from appliance.rosmop.ir.functions import CHARGING, FAULTING, FUNCTIONS
from appliance.rosmop.ir.values import Values, struct_code, struct_size
from appliance.rosmop.runtime import numbers, output, texts, times, vectors, wire
from appliance.rosmop.runtime.context import MAX_CALLS, Context, FaultError
from appliance.rosmop.types import kinds
from appliance.rosmop.types.kinds import Type
from appliance.rosmop.types.messages import Messages

_FRAMES = 40_000  # of Python's: those of `MAX_CALLS` calls, each deep in expressions

_COMPARED: Mapping[str, Callable[[Any, Any], bool]] = MappingProxyType(
    {
        "==": lambda left, right: left == right,
        "!=": lambda left, right: left != right,
        "<": lambda left, right: left < right,
        ">": lambda left, right: left > right,
        "<=": lambda left, right: left <= right,
        ">=": lambda left, right: left >= right,
    }
)
_CALCULATED: Mapping[str, Callable[[Any, Any], Any]] = MappingProxyType(
    {
        "+": lambda left, right: left + right,
        "-": lambda left, right: left - right,
        "*": lambda left, right: left * right,
        "&": lambda left, right: left & right,
        "|": lambda left, right: left | right,
        "^": lambda left, right: left ^ right,
    }
)


@dataclass
class Fault:
    """Where the last error came: at which site (-1: nowhere in particular), with which values of variables.

    `happened`: the event had happened by then.
    """

    error: Exception | None = None
    site: int = -1
    variables: Mapping[str, Any] = field(default_factory=dict)
    happened: bool = False


class Frame:
    """One call of a function: its variables, the budget it takes from, the message, and how deep a recursion is."""

    def __init__(
        self, context: Context, shared: Sequence[str] = (), message: wire.Message | None = None
    ) -> None:
        self.context = context
        self.shared = frozenset(shared)
        self.message = message
        self.buffer: wire.Buffer = b"" if message is None else message.buffer
        self.variables: dict[str, Any] = {}
        self.depth = 0
        self.result: Any = None

    def position(self, spot: form.Spot) -> int:
        """A position in the message."""
        return spot.offset + (self.variables[spot.base] if spot.base is not None else 0)


_BREAK, _CONTINUE, _LEAVE = "break", "continue", "leave"  # how a block can end before its end


class Interpreter:
    """Runs the functions of one set of specifications.

    `shared` are the values of the variables of the set by name, `contexts` the budgets by name.
    """

    def __init__(
        self,
        functions: Mapping[str, form.Function],
        shared: dict[str, Any],
        contexts: Mapping[str, Context],
        messages: Messages,
    ) -> None:
        self._functions = functions
        self._shared = shared
        self._contexts = contexts
        self._values = Values(messages)
        self._frames: list[Frame] = []
        self.fault = Fault()
        for context in contexts.values():
            context.live = self._live

    def _live(self) -> list[Mapping[str, Any]]:
        """All variables that have values now."""
        return [self._shared, *(frame.variables for frame in self._frames)]

    # Functions

    def event(self, name: str, message: wire.Message | None) -> bool:
        """Give a message (a timer: None) to an event; whether it happened."""
        return bool(self._run(self._functions[name], message))

    def key(self, name: str, message: wire.Message | None) -> Any:
        """What the message binds of the parameters of a specification: False, True, or a list of True and values."""
        return self._run(self._functions[name], message)

    def action(self, name: str, message: wire.Message | None = None) -> None:
        """Run a handler, or a stage of the beginning."""
        self._run(self._functions[name], message)

    def _run(self, function: form.Function, message: wire.Message | None) -> Any:
        limit = sys.getrecursionlimit()
        sys.setrecursionlimit(max(limit, _FRAMES))
        try:
            return self._run_in(function, Frame(self._contexts[function.context], function.shared, message))
        finally:
            sys.setrecursionlimit(limit)

    def _run_in(self, function: form.Function, frame: Frame) -> Any:
        self._frames.append(frame)
        done = 0
        try:
            for statement in function.body:
                if self._statement(statement, frame) is not None:
                    break
                done += 1
        except Exception as error:
            if error is not self.fault.error:
                site = error.site if isinstance(error, FaultError) and error.site >= 0 else self._site
                self.fault = Fault(error, site, frame.variables | self._shared)
            self.fault.happened = function.happens is not None and done >= function.happens
            raise
        finally:
            self._frames.pop()
        return frame.result

    _site = -1
    """The site of the statement that runs."""

    # Statements: each returns how it ends the block around it, None if it does not

    def _statement(self, node: form.Statement, frame: Frame) -> str | None:
        self._site = node.site
        return _STATEMENTS[type(node)](self, node, frame)

    def _block(self, statements: Sequence[form.Statement], frame: Frame) -> str | None:
        for statement in statements:
            end = self._statement(statement, frame)
            if end is not None:
                return end
        return None

    def _evaluate(self, node: form.Evaluate, frame: Frame) -> None:
        self.value(node.value, frame)

    def _if(self, node: form.If, frame: Frame) -> str | None:
        return self._block(node.yes if self.value(node.test, frame) else node.no, frame)

    def _loop(self, node: form.Loop, frame: Frame) -> str | None:
        while True:
            end = self._block(node.body, frame)
            if end in (_BREAK, _LEAVE):
                return end if end == _LEAVE else None

    def _for_each(self, node: form.ForEach, frame: Frame) -> str | None:
        for each in self.value(node.values, frame):
            frame.variables[node.name] = each
            end = self._block(node.body, frame)
            if end in (_BREAK, _LEAVE):
                return end if end == _LEAVE else None
        return None

    def _break(self, node: form.Break, frame: Frame) -> str:
        del node, frame
        return _BREAK

    def _continue(self, node: form.Continue, frame: Frame) -> str:
        del node, frame
        return _CONTINUE

    def _select(self, node: form.Select, frame: Frame) -> None:
        frame.variables[node.name] = dict(node.table).get(self.value(node.value, frame), node.default)

    def _return(self, node: form.Return, frame: Frame) -> str:
        value = self.value(node.value, frame)
        references = [frame.variables[name] for name in node.references]
        frame.result = [value, *references] if references else value
        return _LEAVE

    def _leave(self, node: form.Leave, frame: Frame) -> str:
        frame.result = node.happened
        return _LEAVE

    def _charge(self, node: form.Charge, frame: Frame) -> None:
        frame.context.spend(node.instructions, node.site)

    def _allocate(self, node: form.Allocate, frame: Frame) -> None:
        if node.size is not None:
            frame.context.allocate(node.size, node.site)
        elif len(frame.buffer) > form.CHARGED:
            frame.context.allocate(len(frame.buffer), node.site)

    def _limit_depth(self, node: form.LimitDepth, frame: Frame) -> None:
        if frame.depth > MAX_CALLS:
            raise FaultError(node.site, f"`{node.name}` calls itself without end")

    def _drop(self, node: form.Drop, frame: Frame) -> None:
        if frame.message is not None or node.anyway:
            self._message(frame).dropped = True

    def _reset(self, node: form.Reset, frame: Frame) -> None:
        del node
        frame.context.turn.reset = True

    def _publish(self, node: form.Publish, frame: Frame) -> None:
        out = bytearray()
        self._values.encoder(node.kind)(self.value(node.value, frame), out)
        frame.context.publish(node.topic, node.kind.name, bytes(out), node.site)

    # Fields of the message

    def _message(self, frame: Frame) -> wire.Message:
        assert frame.message is not None
        return frame.message

    def _after_text(self, node: form.AfterText, frame: Frame) -> None:
        frame.variables[node.name] = wire.text_end(frame.buffer, frame.position(node.at))

    def _count(self, node: form.Count, frame: Frame) -> None:
        frame.variables[node.name] = wire.count(frame.buffer, frame.position(node.at), node.least)

    def _after_elements(self, node: form.AfterElements, frame: Frame) -> None:
        frame.variables[node.name] = frame.position(node.at) + self._number(node.count, frame) * node.size

    def _number(self, count: str | int, frame: Frame) -> int:
        return count if isinstance(count, int) else int(frame.variables[count])

    def _skip(self, node: form.Skip, frame: Frame) -> None:
        skip = wire.skip_inner if node.inner else wire.skip
        end = wire.text_end if node.skipper is None else partial(self._skipped, node.skipper, frame.context)
        start, count = frame.position(node.at), self._number(node.count, frame)
        frame.variables[node.name] = skip(frame.buffer, start, count, end, frame.context)

    def _skipped(self, skipper: form.Skipper, context: Context, buffer: wire.Buffer, start: int) -> int:
        inner = Frame(context)
        inner.buffer = buffer
        inner.variables["p"] = start
        self._block(skipper.body, inner)
        return inner.position(skipper.end)

    def _not_past(self, node: form.NotPast, frame: Frame) -> str | None:
        count = frame.variables[node.count]
        if count > node.index:
            return None
        self._message(frame).past = (node.site, node.index, count)
        frame.result = False
        return _LEAVE

    def _read_numbers(self, node: form.ReadNumbers, frame: Frame) -> None:
        start = frame.position(node.at)
        end = max(offset + struct_size(struct_code(kind) or "") for _, kind, offset in node.fields)
        struct.unpack_from(f"{end}x", frame.buffer, start)  # all of them are there, or none is read
        for name, kind, offset in node.fields:
            frame.variables[name] = self._values.decoder(kind)(frame.buffer, start + offset)[0]

    def _read_value(self, node: form.ReadValue, frame: Frame) -> None:
        value, end = self._values.decoder(node.type)(frame.buffer, frame.position(node.at))
        frame.variables[node.name], frame.variables[node.end] = value, end

    def _require(self, node: form.Require, frame: Frame) -> str | None:
        if self.value(node.test, frame):
            return None
        frame.result = False
        return _LEAVE

    def _pending(self, node: form.Pending, frame: Frame) -> None:
        frame.variables[node.name] = node.writes

    def _write_back(self, node: form.WriteBack, frame: Frame) -> str | None:
        message = self._message(frame)
        if message.dropped:
            frame.result = True
            return _LEAVE
        spliced, patched = [], []
        for write in sorted(node.writes, key=lambda write: write.end is None):
            if not frame.variables[write.flag]:
                continue
            out, value, start = bytearray(), self.value(write.value, frame), frame.position(write.at)
            self._values.encoder(write.value.type)(value, out)
            if write.end is None:
                patched.append((start, bytes(out)))
            else:
                spliced.append((start, frame.variables[write.end], bytes(out), 1))
        for start, new in patched:
            message.patch(start, new)
        if spliced:
            message.splice(spliced)
        return None

    # Expressions

    def value(self, node: form.Expression, frame: Frame) -> Any:
        """The value of an expression."""
        return _EXPRESSIONS[type(node)](self, node, frame)

    def _literal(self, node: form.Literal, frame: Frame) -> Any:
        del frame
        return node.value

    def _read(self, node: form.Read, frame: Frame) -> Any:
        return frame.variables[node.name] if node.name in frame.variables else self._shared[node.name]

    def _assign(self, node: form.Assign, frame: Frame) -> Any:
        value = self.value(node.value, frame)
        (self._shared if node.name in frame.shared else frame.variables)[node.name] = value
        return value

    def _convert(self, node: form.Convert, frame: Frame) -> Any:
        return converted(self.value(node.value, frame), node.value.type, node.type)

    def _arithmetic(self, node: form.Arithmetic, frame: Frame) -> Any:
        left, right = self.value(node.left, frame), self.value(node.right, frame)
        kind, operator = node.type, node.operator
        if isinstance(kind, kinds.Floating):
            result = numbers.ratio(left, right) if operator == "/" else _CALCULATED[operator](left, right)
            return numbers.f32(result) if kind.bits == 32 else result
        assert isinstance(kind, kinds.Integer)
        if operator == "/":
            result = numbers.divide(left, right, node.site)
        elif operator == "%":
            result = numbers.remainder(left, right, node.site)
        elif operator in ("<<", ">>"):
            amount = right & (kind.bits - 1)
            result = left << amount if operator == "<<" else left >> amount
        else:
            result = _CALCULATED[operator](left, right)
        return numbers.wrap(result, kind.bits, kind.signed)

    def _unary(self, node: form.Unary, frame: Frame) -> Any:
        value = self.value(node.value, frame)
        result = abs(value) if node.operator == "abs" else -value if node.operator == "-" else ~value
        kind = node.type
        return numbers.wrap(result, kind.bits, kind.signed) if isinstance(kind, kinds.Integer) else result

    def _moment(self, node: form.Moment, frame: Frame) -> int:
        result = _CALCULATED[node.operator](self.value(node.left, frame), self.value(node.right, frame))
        return _limited(node.type, result, node.site)

    def _moment_of(self, node: form.MomentOf, frame: Frame) -> int:
        seconds, nanoseconds = self.value(node.seconds, frame), self.value(node.nanoseconds, frame)
        return _limited(node.type, seconds * times.BILLION + nanoseconds, node.site)

    def _compare(self, node: form.Compare, frame: Frame) -> bool:
        left = self.value(node.left, frame)
        if isinstance(node.left.type, kinds.Vector | kinds.Record):
            vectors.weighed(frame.context, left, self._values.measure(node.left.type), node.site)
        return _COMPARED[node.operator](left, self.value(node.right, frame))

    def _compare_texts(self, node: form.CompareTexts, frame: Frame) -> bool:
        few = isinstance(node.right, form.Read) and len(self.value(node.right, frame)) <= form.SHORT
        left = self.value(node.left, frame)
        if not (node.short or few):
            texts.charged(frame.context, left, node.site)
        return _COMPARED[node.operator](left, self.value(node.right, frame))

    def _logical(self, node: form.Logical, frame: Frame) -> bool:
        left = self.value(node.left, frame)
        return left if left is (node.operator == "or") else bool(self.value(node.right, frame))

    def _not(self, node: form.Not, frame: Frame) -> bool:
        return not self.value(node.value, frame)

    def _conditional(self, node: form.Conditional, frame: Frame) -> Any:
        return self.value(node.yes if self.value(node.test, frame) else node.no, frame)

    def _sequence(self, node: form.Sequence, frame: Frame) -> Any:
        return [self.value(item, frame) for item in node.items][node.chosen]

    def _discard(self, node: form.Discard, frame: Frame) -> None:
        self.value(node.value, frame)

    def _item(self, node: form.Item, frame: Frame) -> Any:
        return self.value(node.base, frame)[node.number]

    def _vector(self, node: form.Vector, frame: Frame) -> list[Any]:
        zeros: list[Any] = self._values.maker(kinds.Vector(node.type.element, node.zeros))()
        return [self.value(item, frame) for item in node.items] + zeros

    def _zero(self, node: form.Zero, frame: Frame) -> Any:
        del frame
        return self._values.maker(node.type)()

    def _copy(self, node: form.Copy, frame: Frame) -> Any:
        return self._values.copier(node.type)(frame.context, self.value(node.value, frame), node.site)

    def _recast(self, node: form.Recast, frame: Frame) -> list[Any]:
        return _recast(frame.context, self.value(node.value, frame), node.type.element, node.site)

    def _of_type(self, node: form.OfType, frame: Frame) -> Callable[..., Any]:
        if node.what == "zero":
            return self._values.maker(node.of)
        if node.what == "measure":
            return self._values.measure(node.of)
        return lambda value: self._values.copier(node.of)(frame.context, value, node.site)

    def _call(self, node: form.Call, frame: Frame) -> Any:
        before = (frame.context,) if node.function in CHARGING else ()
        after = (node.site,) if node.function in FAULTING else ()
        arguments = [self.value(argument, frame) for argument in node.arguments]
        return FUNCTIONS[node.function](*before, *arguments, *after)

    def _accumulate(self, node: form.Accumulate, frame: Frame) -> Any:
        assert isinstance(node.vector.type, kinds.Vector)
        element, wide = node.vector.type.element, node.wide

        def add(sum_of_them: Any, each: Any) -> Any:
            result = converted(sum_of_them, node.type, wide) + converted(each, element, wide)
            if isinstance(wide, kinds.Integer):
                result = numbers.wrap(result, wide.bits, wide.signed)
            return converted(result, wide, node.type)

        values, first, last, start = (
            self.value(part, frame) for part in (node.vector, node.first, node.last, node.start)
        )
        return vectors.accumulate(frame.context, values, first, last, node.site, start, add)

    def _invoke(self, node: form.Invoke, frame: Frame) -> Any:
        function = self._functions[node.function]
        inner = Frame(frame.context, function.shared)
        values = [self.value(argument, frame) for argument in node.arguments]
        inner.variables = dict(zip(function.parameters, values, strict=False))
        inner.depth = frame.depth + 1 if node.depth else 0
        site = self._site
        result = self._run_in(function, inner)
        self._site = site
        return result

    def _format(self, node: form.Format, frame: Frame) -> bytes:
        arguments = tuple(self.value(argument, frame) for argument in node.arguments)
        if node.size is None:
            return node.template % arguments
        return output.formatted(frame.context, node.template, arguments, node.size, node.site)

    def _join(self, node: form.Join, frame: Frame) -> bytes:
        pieces = tuple(self.value(piece, frame) for piece in node.pieces)
        return output.join_all(frame.context, pieces, node.site)

    def _log(self, node: form.Log, frame: Frame) -> None:
        frame.context.log(node.level, self.value(node.text, frame), node.site)

    def _throttle(self, node: form.Throttle, frame: Frame) -> bool:
        return frame.context.throttle(self.value(node.seconds, frame), node.site)

    def _now(self, node: form.Now, frame: Frame) -> int:
        del node
        return frame.context.turn.now

    def _whole(self, node: form.Whole, frame: Frame) -> list[Any]:
        pending = tuple(
            (frame.variables[write.flag], write.path, self.value(write.value, frame))
            for write in frame.variables[node.pending]
        )
        decode = self._values.decoder(node.type)
        return wire.whole(self._message(frame), frame.context, decode, pending, node.site)


def converted(value: Any, source: Type, target: Type) -> Any:
    """A number as one of another type."""
    if isinstance(target, kinds.Bool):
        return value != 0
    if isinstance(target, kinds.Floating):
        if target.bits == 64:
            return float(value)
        return numbers.f32_of_integer(value) if isinstance(source, kinds.Integer) else numbers.f32(value)
    assert isinstance(target, kinds.Integer)
    if isinstance(source, kinds.Floating):
        return numbers.truncate(value, target.least, target.most)
    return numbers.wrap(int(value), target.bits, target.signed)


def _limited(kind: Type, nanoseconds: int, site: int) -> int:
    return (times.time if kind == kinds.TIME else times.duration)(nanoseconds, site)


def _recast(context: Context, values: list[Any], element: Type, site: int) -> list[Any]:
    if isinstance(element, kinds.Vector):
        inner = partial(_recast, context, element=element.element, site=site)
        return vectors.recast_each(context, values, inner, site)
    signed = isinstance(element, kinds.Integer) and element.signed
    to_bytes = vectors.signed if signed else vectors.unsigned
    return vectors.recast(
        context, values, vectors.truths if isinstance(element, kinds.Bool) else to_bytes, site
    )


_EXPRESSIONS: Mapping[type[Any], Callable[[Interpreter, Any, Frame], Any]] = form.methods_of(
    Interpreter, form.Expression
)
_STATEMENTS: Mapping[type[Any], Callable[[Interpreter, Any, Frame], str | None]] = form.methods_of(
    Interpreter, form.Statement
)
