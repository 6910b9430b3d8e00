"""Define the intermediate form (`form/nodes.py`) by running it. Faster implementations are compared with this one.

Each expression becomes a Python function of a call's variables. Each statement becomes a function that
returns how the block ends, or None if the block goes on. Strings are bytes, vectors and messages are lists,
times and durations are integers. This is one file because it is the definition. Invariants:

1. A name is a variable of the monitor set (`g…`) or of one call. Only variables of the set, and the values they refer
to, outlive a call. In a call, `m` is the message, `b` its original bytes, `p` the start of a skipped element, and `n`
the depth of a recursion.
2. `_site` is the site of the running statement. A fault stops the function and all its callers.
"""

import operator
import struct
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from types import MappingProxyType
from typing import Any

from rosmop.form import nodes
from rosmop.form.sites import Site
from rosmop.runtime import formatting, numbers, safe_messages, strings, times, vectors, wire
from rosmop.runtime.action_context import MAX_CALLS, ActionState, Context, FaultError
from rosmop.runtime.builtin_functions import CHARGING, FAULTING, FUNCTIONS
from rosmop.runtime.values import BILLION, ValueCodec, struct_code, struct_size
from rosmop.types import value_types
from rosmop.types.messages import MessageTypes
from rosmop.types.value_types import Type
from roswire.definitions import Definitions

_FRAMES = 40_000  # Python frames for `MAX_CALLS` nested calls, each within deep expressions

_CALCULATED: Mapping[str, Callable[[Any, Any], Any]] = MappingProxyType(
    {
        "+": operator.add,
        "-": operator.sub,
        "*": operator.mul,
        "&": operator.and_,
        "|": operator.or_,
        "^": operator.xor,
        "==": operator.eq,
        "!=": operator.ne,
        "<": operator.lt,
        ">": operator.gt,
        "<=": operator.le,
        ">=": operator.ge,
    }
)

_CALCULATED_OF_ONE: Mapping[str, Callable[[Any], Any]] = MappingProxyType(
    {"-": operator.neg, "~": operator.invert, "abs": abs}
)

Variables = dict[str, Any]
_Value = Callable[[Variables], Any]
_Run = Callable[[Variables], str | None]

_BREAK, _CONTINUE, _LEAVE = "break", "continue", "leave"  # how a block can end early
_RESULT = "result"


@dataclass(frozen=True)
class LastFailure:
    """The last error, and whether its event had already `happened`."""

    error: Exception | None = None
    site: int = -1
    variables: Mapping[str, Any] = field(default_factory=dict)
    happened: bool = False


class Interpreter:
    """Runs one set's functions. `variables` and `contexts` (budgets) are by name."""

    def __init__(
        self,
        functions: Mapping[str, nodes.Function],
        sites: Sequence[Site],
        types: Mapping[str, Type],
        contexts: Mapping[str, str],
        messages: MessageTypes,
    ) -> None:
        self.sites = sites
        self.turn = ActionState()
        self.variables: dict[str, Any] = {}
        self.failed = LastFailure()
        self._values = ValueCodec(messages, self.turn.check)
        self._functions = functions
        self._made: dict[str, Callable[[Variables], Any]] = {}
        self._calls: list[Variables] = []
        measures = {name: self._values.measure(kind) for name, kind in types.items()}
        variables, calls = self.variables, self._calls
        self.contexts = {
            name: Context(monitor, self.turn, measures, lambda: [variables, *calls])
            for name, monitor in contexts.items()
        }
        self._site = -1

    def had_happened(self, error: Exception) -> bool:
        return error is self.failed.error and self.failed.happened

    def let_go(self) -> None:
        """Break the reference cycles that would keep the set alive."""
        self._made.clear()

    def value(self, name: str, variables: Mapping[str, Any]) -> Any:
        return variables[name] if name in variables else self.variables[name]

    def function(self, name: str) -> Callable[..., Any]:
        """Return a function of a message, or of None if the event has none; `nodes.Function` describes its result.

        The function raises the error that stops it; `failed` has the details.
        """
        deep = any(isinstance(node, nodes.Invoke) for node in nodes.walk(self._functions[name].body))

        def run(message: wire.WireMessage | None = None) -> Any:
            variables = {"m": message} if message is None else {"m": message, "b": message.buffer}
            if not deep:
                return self._call(name, variables)
            limit = sys.getrecursionlimit()
            sys.setrecursionlimit(max(limit, _FRAMES))
            try:
                return self._call(name, variables)
            finally:
                sys.setrecursionlimit(limit)

        return run

    def _call(self, name: str, variables: Variables) -> Any:
        call = self._made.get(name)
        if call is None:
            call = self._made[name] = self.turn.exclude(lambda: self._make(self._functions[name]))
        return call(variables)

    def _make(self, function: nodes.Function) -> Callable[[Variables], Any]:
        maker = _Maker(self, function)
        events, calls = function.happens is not None, self._calls
        before, after = maker.block(function.body[: function.happens]), maker.block(())
        if function.happens is not None:
            after = maker.block(function.body[function.happens :])

        def call(variables: Variables) -> Any:
            calls.append(variables)
            happened = False
            try:
                if before(variables) is None:
                    happened = events
                    after(variables)
            except Exception as error:
                if error is not self.failed.error:
                    site = error.site if isinstance(error, FaultError) and error.site >= 0 else self._site
                    self.failed = LastFailure(error, site, variables, happened)
                elif events:  # the error came from a called function
                    self.failed = replace(self.failed, happened=happened)
                raise
            finally:
                calls.pop()
            return variables.get(_RESULT)

        return call


def constant_of(node: nodes.Expression) -> bool | int | float:
    nowhere = nodes.Function("", "", (), ())
    maker = _Maker(_nobody(), nowhere)
    value: bool | int | float = maker.value(node)({})
    return value


@cache
def _nobody() -> Interpreter:
    return Interpreter({}, (), {}, {"": ""}, MessageTypes(Definitions({})))


class _Maker:
    def __init__(self, interpreter: Interpreter, function: nodes.Function) -> None:
        self._interpreter = interpreter
        self._context = interpreter.contexts[function.context]
        self._values = interpreter._values
        self._shared = interpreter.variables
        self._whole_with: dict[str, list[tuple[str, tuple[int | str, ...], _Value]]] = {}
        self._flags = frozenset(
            write.flag
            for statement in function.body
            if isinstance(statement, nodes.WriteBack | nodes.Pending)
            for write in statement.writes
        )
        self._marks: list[int] = []  # sites that assign to fields of the message
        self._at = -1  # the site of the statement that is being built

    # Statements

    def block(self, statements: Sequence[nodes.Statement]) -> _Run:
        runs = [(node.site, self._statement(node)) for node in statements]
        interpreter = self._interpreter

        def run(v: Variables) -> str | None:
            for site, statement in runs:
                interpreter._site = site
                end = statement(v)
                if end is not None:
                    return end
            return None

        def run_one(v: Variables) -> str | None:
            interpreter._site = only[0]
            return only[1](v)

        if len(runs) != 1:
            return run
        only = runs[0]
        return run_one

    def _statement(self, node: nodes.Statement) -> _Run:
        self._at = node.site
        made: _Run = STATEMENTS[type(node)](self, node)
        return made

    def _evaluate(self, node: nodes.Evaluate) -> _Run:
        return self._effect(node.value)

    def _effect(self, node: nodes.Expression) -> _Run:
        if isinstance(node, nodes.Assign):
            return self._store(node)
        if isinstance(node, nodes.Sequence):
            effects = [self._effect(item) for item in node.items]

            def run_all(v: Variables) -> None:
                for effect in effects:
                    effect(v)

            return run_all
        value = self.value(node)

        def run(v: Variables) -> None:
            value(v)

        return run

    def _store(self, node: nodes.Assign) -> _Run:
        name, value, shared = node.name, self._assigned(node), self._shared

        def store(v: Variables) -> None:
            v[name] = value(v)

        def share(v: Variables) -> None:
            shared[name] = value(v)

        return share if _is_shared(name) else store

    def _if(self, node: nodes.If) -> _Run:
        test = self.value(node.test)
        yes, no = self._branch(node.site, node.yes), self._branch(node.site, node.no)

        def run(v: Variables) -> str | None:
            return yes(v) if test(v) else no(v)

        def run_yes(v: Variables) -> str | None:
            return yes(v) if test(v) else None

        return run if node.no else run_yes

    def _branch(self, site: int, statements: Sequence[nodes.Statement]) -> _Run:
        block = self.block(statements)
        if not any(isinstance(node, nodes.Drop | nodes.StopMessage | nodes.Publish | nodes.Log)
                   or self._marks_field(node) for node in nodes.walk(tuple(statements))):  # fmt: skip
            return block
        look = self._look(site)

        def run(v: Variables) -> str | None:
            look(v)
            return block(v)

        return run

    def _look(self, site: int) -> _Run:
        turn = self._interpreter.turn
        compared = [self._variable(variable.code) for variable in self._interpreter.sites[site].compared]

        def look(v: Variables) -> None:
            turn.looked[site] = tuple([value(v) for value in compared])

        return look

    def _loop(self, node: nodes.Loop) -> _Run:
        body = self.block(node.body)

        def run(v: Variables) -> str | None:
            while True:
                end = body(v)
                if end is not None and end is not _CONTINUE:
                    return end if end is _LEAVE else None

        return run

    def _for_each(self, node: nodes.ForEach) -> _Run:
        name, values, body = node.name, self.value(node.values), self.block(node.body)

        def run(v: Variables) -> str | None:
            for value in values(v):
                v[name] = value
                end = body(v)
                if end is not None and end is not _CONTINUE:
                    return end if end is _LEAVE else None
            return None

        return run

    def _break(self, _node: nodes.Break) -> _Run:
        return lambda _: _BREAK

    def _continue(self, _node: nodes.Continue) -> _Run:
        return lambda _: _CONTINUE

    def _select(self, node: nodes.Select) -> _Run:
        name, value, table, default = node.name, self.value(node.value), dict(node.table), node.default

        def run(v: Variables) -> None:
            v[name] = table.get(value(v), default)

        return run

    def _return(self, node: nodes.Return) -> _Run:
        value, references = self.value(node.value), node.references

        def run(v: Variables) -> str:
            result = value(v)
            v[_RESULT] = [result, *[v[name] for name in references]] if references else result
            return _LEAVE

        return run

    def _leave(self, node: nodes.Leave) -> _Run:
        return self._left(result=node.happened)

    def _left(self, *, result: bool | None) -> _Run:
        def run(v: Variables) -> str:
            v[_RESULT] = result
            return _LEAVE

        return run

    def _charge(self, node: nodes.Charge) -> _Run:
        context, instructions, site = self._context, node.instructions, node.site

        def run(_: Variables) -> None:
            context.budget -= instructions
            if context.budget < 0:
                context.spend(0, site)

        return run

    def _allocate(self, node: nodes.Allocate) -> _Run:
        context, given, site = self._context, node.size, node.site

        def run(v: Variables) -> None:
            size = len(v["b"]) if given is None else given
            if given is not None or size > nodes.CHARGED:
                context.allocate(size, site)

        return run

    def _limit_depth(self, node: nodes.LimitDepth) -> _Run:
        name, site = node.name, node.site

        def run(v: Variables) -> None:
            if v["n"] > MAX_CALLS:
                raise FaultError(site, f"`{name}` calls itself endlessly")

        return run

    def _drop(self, node: nodes.Drop) -> _Run:
        site = node.site

        def run(v: Variables) -> None:
            message = v["m"]
            if message is not None:
                message.dropped, message.cause = True, site

        return run

    def _stop(self, node: nodes.StopMessage) -> _Run:
        context, turn, site = self._context, self._interpreter.turn, node.site
        own = {safe.topic: safe for safe in node.safes}

        def run(v: Variables) -> None:
            message = v["m"]
            if message is not None and message.channel in own:
                message.stop(own[message.channel], site)
                return
            for safe in node.safes:
                context.publish(safe.topic, safe.type, safe_messages.to_bytes(safe, turn.now), site)

        return run

    def _reset(self, _node: nodes.Reset) -> _Run:
        turn = self._interpreter.turn

        def run(_: Variables) -> None:
            turn.reset = True

        return run

    def _publish(self, node: nodes.Publish) -> _Run:
        context, encode, value = self._context, self._values.encoder(node.kind), self.value(node.value)
        topic, kind, site = node.topic, node.service or node.kind.name, node.site
        is_call = bool(node.service)

        def run(v: Variables) -> None:
            context.publish(topic, kind, _encode(encode, value(v), site), site, is_call=is_call)

        return run

    # Fields of the message

    def _position(self, spot: nodes.Spot) -> _Value:
        base, offset = spot.base, spot.offset
        if base is None:
            return lambda _: offset
        return (lambda v: v[base] + offset) if offset else operator.itemgetter(base)

    def _counted(self, count: str | int) -> _Value:
        return operator.itemgetter(count) if isinstance(count, str) else lambda _: count

    def _after_text(self, node: nodes.AfterText) -> _Run:
        name, at = node.name, self._position(node.at)

        def run(v: Variables) -> None:
            v[name] = wire.text_end(v["b"], at(v))

        return run

    def _count(self, node: nodes.Count) -> _Run:
        name, at, least = node.name, self._position(node.at), node.least

        def run(v: Variables) -> None:
            v[name] = wire.count(v["b"], at(v), least)

        return run

    def _after_elements(self, node: nodes.AfterElements) -> _Run:
        name, at, count, size = node.name, self._position(node.at), self._counted(node.count), node.size

        def run(v: Variables) -> None:
            v[name] = at(v) + count(v) * size

        return run

    def _skip(self, node: nodes.Skip) -> _Run:
        name, at, count, context = (
            node.name,
            self._position(node.at),
            self._counted(node.count),
            self._context,
        )
        skip = wire.skip_inner if node.inner else wire.skip
        end = wire.text_end if node.skipper is None else self._skipper(node.skipper)

        def run(v: Variables) -> None:
            v[name] = skip(v["b"], at(v), count(v), end, context)

        return run

    def _skipper(self, skipper: nodes.Skipper) -> Callable[[wire.Buffer, int], int]:
        strings = [one for one in skipper.body if isinstance(one, nodes.AfterText) and not one.at.offset]
        if len(strings) == len(skipper.body) and not skipper.end.offset:
            return partial(wire.texts_end, number=len(skipper.body))
        body, end = self.block(skipper.body), self._position(skipper.end)

        def skip(buffer: wire.Buffer, start: int) -> int:
            inner: Variables = {"b": buffer, "p": start}
            body(inner)
            return int(end(inner))

        return skip

    def _not_past(self, node: nodes.NotPast) -> _Run:
        name, index, site = node.count, node.index, node.site

        def run(v: Variables) -> str | None:
            count = v[name]
            if count > index:
                return None
            v["m"].past = (site, index, count)
            v[_RESULT] = False
            return _LEAVE

        return run

    def _ends(self, node: nodes.Ends) -> _Run:
        at = self._position(node.at)

        def run(v: Variables) -> None:
            wire.require_end(v["b"], at(v))

        return run

    def _read_numbers(self, node: nodes.ReadNumbers) -> _Run:
        codes, at, reads = "<", 0, []
        for name, kind, offset in node.fields:
            code = struct_code(kind) or ""
            codes += f"{offset - at}x{code}"
            at = offset + struct_size(code)
            reads.append((name, len(code) == 2))
        unpack, start = struct.Struct(codes).unpack_from, self._position(node.at)
        names = [name for name, _ in reads]

        def numbers_only(v: Variables) -> None:
            v.update(zip(names, unpack(v["b"], start(v)), strict=True))

        def with_moments(v: Variables) -> None:
            parts = iter(unpack(v["b"], start(v)))
            for name, is_moment in reads:
                v[name] = next(parts) * BILLION + next(parts) if is_moment else next(parts)

        return with_moments if any(is_moment for _, is_moment in reads) else numbers_only

    def _read_value(self, node: nodes.ReadValue) -> _Run:
        name, end, decode, at = node.name, node.end, self._values.decoder(node.type), self._position(node.at)

        def run(v: Variables) -> None:
            v[name], v[end] = decode(v["b"], at(v))

        return run

    def _require(self, node: nodes.Require) -> _Run:
        test, look = self.value(node.test), self._look(node.site)

        def run(v: Variables) -> str | None:
            if test(v):
                return look(v)
            v[_RESULT] = False
            return _LEAVE

        return run

    def _pending(self, node: nodes.Pending) -> _Run:
        self._whole_with[node.name] = [
            (write.flag, write.path, self.value(write.value)) for write in node.writes
        ]
        return lambda _: None

    def _write_back(self, node: nodes.WriteBack) -> _Run:
        """Fields of variable size can fault, so they are encoded before the first byte is written."""
        marks, writes = tuple(self._marks), []
        for write in sorted(node.writes, key=lambda write: write.end is None):
            value, encode = self.value(write.value), self._values.encoder(write.value.type)
            writes.append((write.flag, value, encode, self._position(write.at), write.end))

        def run(v: Variables) -> str | None:
            message = v["m"]
            if message.dropped or message.stopped is not None:
                v[_RESULT] = True
                return _LEAVE
            if not writes:
                return None
            message.marks = marks
            spliced, patched = [], []
            for flag, value, encode, at, end in writes:
                by = v[flag]
                if by:
                    out = _encode(encode, value(v), marks[by.bit_length() - 1])
                    if end is None:
                        patched.append((at(v), out, by))
                    else:
                        spliced.append((at(v), v[end], out, by))
            for start, new, by in patched:
                message.patch(start, new, by)
            if spliced:
                message.splice(spliced)
            return None

        return run

    # Expressions

    def value(self, node: nodes.Expression) -> _Value:
        made: _Value = EXPRESSIONS[type(node)](self, node)
        return made

    def _literal(self, node: nodes.Literal) -> _Value:
        constant: Any = node.value
        if isinstance(node.type, value_types.VectorType):
            unpacked = struct.iter_unpack(f"<{struct_code(node.type.element)}", constant)
            constant = [value for (value,) in unpacked]
        return lambda _: constant

    def _read(self, node: nodes.Read) -> _Value:
        return self._variable(node.name)

    def _variable(self, name: str) -> _Value:
        shared = self._shared
        return (lambda _: shared[name]) if _is_shared(name) else operator.itemgetter(name)

    def _assign(self, node: nodes.Assign) -> _Value:
        store, read = self._store(node), self._variable(node.name)

        def assign(v: Variables) -> Any:
            store(v)
            return read(v)

        return assign

    def _marks_field(self, node: object) -> bool:
        if not isinstance(node, nodes.Assign) or node.name not in self._flags:
            return False
        value = node.value.value if isinstance(node.value, nodes.Convert) else node.value
        return isinstance(value, nodes.Literal) and value.value is True

    def _assigned(self, node: nodes.Assign) -> _Value:
        if not self._marks_field(node):
            return self.value(node.value)
        if self._at not in self._marks:
            self._marks.append(self._at)
        name, bit = node.name, 1 << self._marks.index(self._at)
        return lambda v: v[name] | bit

    def _both(
        self, calculate: Callable[[Any, Any], Any], left: nodes.Expression, right: nodes.Expression
    ) -> _Value:
        one, other = self.value(left), self.value(right)
        if isinstance(right, nodes.Literal):
            constant = right.value
            return lambda v: calculate(one(v), constant)
        return lambda v: calculate(one(v), other(v))

    def _then(self, value: _Value, calculate: Callable[[Any], Any] | None) -> _Value:
        return value if calculate is None else lambda v: calculate(value(v))

    def _convert(self, node: nodes.Convert) -> _Value:
        return self._then(self.value(node.value), conversion(node.value.type, node.type))

    def _arithmetic(self, node: nodes.Arithmetic) -> _Value:
        kind, sign, site = node.type, node.operator, node.site
        if isinstance(kind, value_types.FloatingType):
            result = self._both(numbers.ratio if sign == "/" else _CALCULATED[sign], node.left, node.right)
            return self._then(result, numbers.f32 if kind.bits == 32 else None)
        assert isinstance(kind, value_types.IntegerType)  # noqa: S101  the common type of two numbers
        last = kind.bits - 1
        calculate = {
            "/": lambda left, right: numbers.divide(left, right, site),
            "%": lambda left, right: numbers.remainder(left, right, site),
            "<<": lambda left, right: left << (right & last),
            ">>": lambda left, right: left >> (right & last),
            **_CALCULATED,
        }[sign]
        return self._then(self._both(calculate, node.left, node.right), wrapping(kind))

    def _unary(self, node: nodes.Unary) -> _Value:
        result = self._then(self.value(node.value), _CALCULATED_OF_ONE[node.operator])
        return self._then(
            result, wrapping(node.type) if isinstance(node.type, value_types.IntegerType) else None
        )

    def _moment(self, node: nodes.Moment) -> _Value:
        result = self._both(_CALCULATED[node.operator], node.left, node.right)
        return self._then(result, _limit(node.type, node.site))

    def _moment_of(self, node: nodes.MomentOf) -> _Value:
        result = self._both(
            lambda seconds, nanoseconds: seconds * BILLION + nanoseconds, node.seconds, node.nanoseconds
        )
        return self._then(result, _limit(node.type, node.site))

    def _compare(self, node: nodes.Compare) -> _Value:
        kind, compare = node.left.type, _CALCULATED[node.operator]
        if not isinstance(kind, value_types.VectorType | value_types.RecordType):
            return self._both(compare, node.left, node.right)
        left, right, measure = self.value(node.left), self.value(node.right), self._values.measure(kind)
        context, site, same = self._context, node.site, self._values.same(kind)
        equal = node.operator == "=="
        return lambda v: same(vectors.charge(context, left(v), measure, site), right(v)) is equal

    def _compare_texts(self, node: nodes.CompareTexts) -> _Value:
        compare, context, site = _CALCULATED[node.operator], self._context, node.site
        if node.short:
            return self._both(compare, node.left, node.right)
        left, right, known = self.value(node.left), self.value(node.right), isinstance(node.right, nodes.Read)

        def compared(v: Variables) -> bool:
            few = known and len(right(v)) <= nodes.SHORT
            first = left(v)
            if not few:
                strings.charge(context, first, site)
            return bool(compare(first, right(v)))

        return compared

    def _logical(self, node: nodes.Logical) -> _Value:
        left, right = self.value(node.left), self.value(node.right)
        return (lambda v: left(v) or right(v)) if node.operator == "or" else lambda v: left(v) and right(v)

    def _not(self, node: nodes.Not) -> _Value:
        return self._then(self.value(node.value), operator.not_)

    def _conditional(self, node: nodes.Conditional) -> _Value:
        test, yes, no = self.value(node.test), self.value(node.yes), self.value(node.no)
        return lambda v: yes(v) if test(v) else no(v)

    def _sequence(self, node: nodes.Sequence) -> _Value:
        items, chosen = [self.value(item) for item in node.items], node.chosen
        return lambda v: [item(v) for item in items][chosen]

    def _discard(self, node: nodes.Discard) -> _Value:
        return self.value(node.value)

    def _item(self, node: nodes.Item) -> _Value:
        return self._then(self.value(node.base), operator.itemgetter(node.number))

    def _vector(self, node: nodes.Vector) -> _Value:
        items = [self.value(item) for item in node.items]
        zeros: Callable[[], list[Any]] = self._values.maker(
            value_types.VectorType(node.type.element, node.zeros)
        )
        return lambda v: [item(v) for item in items] + zeros()

    def _zero(self, node: nodes.Zero) -> _Value:
        make = self._values.maker(node.type)
        return lambda _: make()

    def _copy(self, node: nodes.Copy) -> _Value:
        value = self.value(node.value)
        return (
            value
            if value_types.is_scalar(node.type)
            else self._then(value, self._copier(node.type, node.site))
        )

    def _copier(self, kind: Type, site: int) -> Callable[[Any], Any]:
        context, copy = self._context, self._values.copier(kind)
        return lambda value: copy(context, value, site)

    def _recast(self, node: nodes.Recast) -> _Value:
        context, element, site = self._context, node.type.element, node.site
        return self._then(self.value(node.value), lambda values: _recast(context, values, element, site))

    def _of_type(self, node: nodes.OfType) -> _Value:
        if node.what == "copy":
            copy = self._copier(node.of, node.site)
            return lambda _: copy
        does = self._values.maker(node.of) if node.what == "zero" else self._values.measure(node.of)
        return lambda _: does

    def _call(self, node: nodes.Call) -> _Value:
        function, site = FUNCTIONS[node.function], node.site
        if node.function in CHARGING:
            function = partial(function, self._context)
        arguments = [self.value(argument) for argument in node.arguments]
        after = (site,) if node.function in FAULTING else ()
        if len(arguments) == 1 and not after:
            value = self._then(arguments[0], function)
            if node.function == "m_sec" and isinstance(node.type, value_types.IntegerType):
                # A message may have more nanoseconds than a second has: the seconds overflow their type.
                return self._then(value, wrapping(node.type))
            return value
        if len(arguments) == 2:  # a faster form of the code below
            one, other = arguments
            if after:
                return lambda v: function(one(v), other(v), site)
            return lambda v: function(one(v), other(v))
        return lambda v: function(*[argument(v) for argument in arguments], *after)

    def _accumulate(self, node: nodes.Accumulate) -> _Value:
        assert isinstance(node.vector.type, value_types.VectorType)  # noqa: S101  only vectors are summed
        context, site, wide = self._context, node.site, node.wide
        widened, added = _converting(node.type, wide), _converting(node.vector.type.element, wide)
        wrapped = wrapping(wide) if isinstance(wide, value_types.IntegerType) else float
        narrowed = _converting(wide, node.type)
        parts = [self.value(part) for part in (node.vector, node.first, node.last, node.start)]

        def add(total: Any, each: Any) -> Any:
            return narrowed(wrapped(widened(total) + added(each)))

        def accumulate(v: Variables) -> Any:
            values, first, last, start = [part(v) for part in parts]
            return vectors.accumulate(context, values, first, last, site, start, add)

        return accumulate

    def _invoke(self, node: nodes.Invoke) -> _Value:
        interpreter, name, depth = self._interpreter, node.function, node.depth
        arguments = [self.value(argument) for argument in node.arguments]
        function = interpreter._functions[name]
        parameters = function.parameters
        if function.same_as:
            called = FUNCTIONS[function.same_as]
            return lambda v: called(*[argument(v) for argument in arguments])

        def invoke(v: Variables) -> Any:
            given = [argument(v) for argument in arguments]
            inner = dict(zip(parameters, given, strict=False))
            if depth is not None:
                inner["n"] = v["n"] + 1 if depth else 0
            site = interpreter._site
            result = interpreter._call(name, inner)
            interpreter._site = site
            return result

        return invoke

    def _format(self, node: nodes.Format) -> _Value:
        template, size, context, site = node.template, node.size, self._context, node.site
        arguments = [self.value(argument) for argument in node.arguments]

        def format_row(v: Variables) -> bytes:
            row = tuple([argument(v) for argument in arguments])
            return template % row if size is None else formatting.render(context, template, row, size, site)

        return format_row

    def _join(self, node: nodes.Join) -> _Value:
        pieces, context, site = [self.value(piece) for piece in node.pieces], self._context, node.site
        return lambda v: formatting.join_all(context, tuple([piece(v) for piece in pieces]), site)

    def _log(self, node: nodes.Log) -> _Value:
        text, context, level, site = self.value(node.text), self._context, node.level, node.site
        return lambda v: context.log(level, text(v), site)

    def _throttle(self, node: nodes.Throttle) -> _Value:
        seconds, context, site = self.value(node.seconds), self._context, node.site
        return lambda v: context.throttle(seconds(v), site)

    def _now(self, _node: nodes.Now) -> _Value:
        turn = self._interpreter.turn
        return lambda _: turn.now

    def _sender(self, node: nodes.SenderName) -> _Value:
        turn, place = self._interpreter.turn, ("host", "caller").index(node.part)
        return lambda _: turn.names(turn.source)[place]

    def _altered(self, _node: nodes.Altered) -> _Value:
        return lambda v: v["m"].altered

    def _whole(self, node: nodes.Whole) -> _Value:
        context, decode, site = self._context, self._values.decoder(node.type), node.site
        pending = self._whole_with[node.pending]

        def whole(v: Variables) -> list[Any]:
            assigned = tuple([(v[flag], path, value(v)) for flag, path, value in pending])
            return wire.whole(v["m"], context, decode, assigned, site)

        return whole


def _encode(encode: Callable[[Any, bytearray], None], value: Any, site: int) -> bytes:
    out = bytearray()
    try:
        encode(value, out)
    except struct.error:  # the seconds and nanoseconds of a time are set one by one
        raise FaultError(site, "a time or duration is out of range: no message can hold it") from None
    return bytes(out)


def _is_shared(name: str) -> bool:
    return name.startswith("g")


def conversion(  # noqa: PLR0911  one for each kind
    source: Type, target: Type
) -> Callable[[Any], Any] | None:
    if source == target:
        return None
    if isinstance(target, value_types.BoolType):
        return bool
    if isinstance(target, value_types.FloatingType):
        if target.bits == 64:
            return float
        return numbers.f32_of_integer if isinstance(source, value_types.IntegerType) else numbers.f32
    assert isinstance(target, value_types.IntegerType)  # noqa: S101  a number has one of three types
    if isinstance(source, value_types.FloatingType):
        least, most = target.least, target.most
        return lambda value: numbers.truncate(value, least, most)
    if isinstance(source, value_types.BoolType):
        return int
    assert isinstance(source, value_types.IntegerType)  # noqa: S101  as above
    return None if target.holds(source) else wrapping(target)


def _converting(source: Type, target: Type) -> Callable[[Any], Any]:
    return conversion(source, target) or (lambda value: value)


def wrapping(kind: value_types.IntegerType) -> Callable[[int], int]:
    mask, half = (1 << kind.bits) - 1, 1 << (kind.bits - 1) if kind.signed else 0
    return lambda value: (value + half & mask) - half


def _limit(kind: Type, site: int) -> Callable[[int], int]:
    limit = times.time if kind == value_types.TIME else times.duration
    return lambda nanoseconds: limit(nanoseconds, site)


def _recast(context: Context, values: list[Any], element: Type, site: int) -> list[Any]:
    if isinstance(element, value_types.VectorType):
        inner = partial(_recast, context, element=element.element, site=site)
        return vectors.recast_each(context, values, inner, site)
    signed = isinstance(element, value_types.IntegerType) and element.signed
    to_bytes = vectors.to_signed if signed else vectors.to_unsigned
    return vectors.recast(
        context, values, vectors.truths if isinstance(element, value_types.BoolType) else to_bytes, site
    )


EXPRESSIONS: Mapping[type[nodes.FormNode], Callable[[_Maker, Any], _Value]] = MappingProxyType(
    {
        nodes.Literal: _Maker._literal,
        nodes.Read: _Maker._read,
        nodes.Assign: _Maker._assign,
        nodes.Convert: _Maker._convert,
        nodes.Arithmetic: _Maker._arithmetic,
        nodes.Unary: _Maker._unary,
        nodes.Moment: _Maker._moment,
        nodes.MomentOf: _Maker._moment_of,
        nodes.Compare: _Maker._compare,
        nodes.CompareTexts: _Maker._compare_texts,
        nodes.Logical: _Maker._logical,
        nodes.Not: _Maker._not,
        nodes.Conditional: _Maker._conditional,
        nodes.Sequence: _Maker._sequence,
        nodes.Discard: _Maker._discard,
        nodes.Item: _Maker._item,
        nodes.Vector: _Maker._vector,
        nodes.Zero: _Maker._zero,
        nodes.Copy: _Maker._copy,
        nodes.Recast: _Maker._recast,
        nodes.OfType: _Maker._of_type,
        nodes.Call: _Maker._call,
        nodes.Accumulate: _Maker._accumulate,
        nodes.Invoke: _Maker._invoke,
        nodes.Format: _Maker._format,
        nodes.Join: _Maker._join,
        nodes.Log: _Maker._log,
        nodes.Throttle: _Maker._throttle,
        nodes.Now: _Maker._now,
        nodes.SenderName: _Maker._sender,
        nodes.Altered: _Maker._altered,
        nodes.Whole: _Maker._whole,
    }
)
STATEMENTS: Mapping[type[nodes.FormNode], Callable[[_Maker, Any], _Run]] = MappingProxyType(
    {
        nodes.Evaluate: _Maker._evaluate,
        nodes.If: _Maker._if,
        nodes.Loop: _Maker._loop,
        nodes.ForEach: _Maker._for_each,
        nodes.Break: _Maker._break,
        nodes.Continue: _Maker._continue,
        nodes.Select: _Maker._select,
        nodes.Return: _Maker._return,
        nodes.Leave: _Maker._leave,
        nodes.Charge: _Maker._charge,
        nodes.Allocate: _Maker._allocate,
        nodes.LimitDepth: _Maker._limit_depth,
        nodes.Drop: _Maker._drop,
        nodes.StopMessage: _Maker._stop,
        nodes.Reset: _Maker._reset,
        nodes.Publish: _Maker._publish,
        nodes.AfterText: _Maker._after_text,
        nodes.Count: _Maker._count,
        nodes.AfterElements: _Maker._after_elements,
        nodes.Skip: _Maker._skip,
        nodes.NotPast: _Maker._not_past,
        nodes.Ends: _Maker._ends,
        nodes.ReadNumbers: _Maker._read_numbers,
        nodes.ReadValue: _Maker._read_value,
        nodes.Require: _Maker._require,
        nodes.Pending: _Maker._pending,
        nodes.WriteBack: _Maker._write_back,
    }
)
