"""Translate expressions of the intermediate form to terms of z3, as `run/interpreter.py` evaluates them."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from types import MappingProxyType

import z3

from rosmop.fast.abi import kept_size, most_kept
from rosmop.form import nodes
from rosmop.prove.event_terms import ActiveCall, EventTerms, Value, View, require_term
from rosmop.prove.message_terms import number, size_of
from rosmop.prove.number_terms import (
    LONG,
    OF_FLOATS,
    OF_INTEGERS,
    QUESTIONS,
    ROUNDED,
    UnknownError,
    choose,
    compare_terms,
    convert_term,
    is_signed,
    parts,
    truncate,
    whole_number,
    width,
    wrap,
)
from rosmop.prove.terms import (
    AT,
    DOUBLE,
    MEMORY,
    MISMATCH,
    MIXED,
    NEAREST,
    SECONDS,
    NotProvedError,
    State,
    Term,
    TextTerm,
    both,
    choice,
    either,
    floating,
    integer,
    merge,
    number_at,
    opposite,
    with_sign,
)
from rosmop.runtime import times
from rosmop.runtime.action_context import BYTES_PER_INSTRUCTION
from rosmop.runtime.values import struct_code
from rosmop.types import value_types
from rosmop.types.value_types import Type


def literal(event: EventTerms, node: nodes.Literal, _state: State) -> Value:
    if node.value is None:
        return None
    if isinstance(node.value, bytes) and kept_size(node.type):
        return constant(event, node.value, kept_size(node.type))
    if isinstance(node.value, bytes | str):
        raise UnknownError("a constant string or array")
    if isinstance(node.type, value_types.FloatingType):
        return floating(node.value, node.type.bits)
    return whole_number(int(node.value), node.type)


def constant(event: EventTerms, raw: bytes, size: int = 1) -> TextTerm:
    if raw not in event.beginning.constants:
        raise UnknownError("a constant string or array")
    return TextTerm(integer(event.beginning.constants[raw], 32), integer(len(raw) // size, 64))


def zero(event: EventTerms, node: nodes.Zero, state: State) -> Value:
    if isinstance(node.type, value_types.FloatingType):
        return literal(event, nodes.Literal(node.type, 0.0), state)
    if isinstance(node.type, value_types.StringType):
        return constant(event, b"")
    if size := kept_size(node.type):
        assert isinstance(node.type, value_types.VectorType)  # noqa: S101  strings are above
        return constant(event, bytes(size * (node.type.length or 0)), size)
    if not isinstance(
        node.type,
        value_types.BoolType | value_types.IntegerType | value_types.TimeType | value_types.DurationType,
    ):
        raise UnknownError(f"a zero of type {node.type}")
    return whole_number(0, node.type)


def read(event: EventTerms, node: nodes.Read, state: State) -> Value:
    own, shared = (event.active.frame, node.name), ("shared", node.name)
    value = state.slots.get(own if own in state.slots else shared)
    if not isinstance(value, Term | TextTerm | View):
        raise UnknownError(f"a variable of type {node.type}")
    return value if own in state.slots else kept(event, value, node.type, state)


def kept(event: EventTerms, value: Value, kind: Type, state: State) -> Value:
    if isinstance(value, View) and kept_size(kind):
        value = TextTerm(AT + z3.Extract(31, 0, value.start), value.count)
    if isinstance(value, TextTerm):
        event.leave_to_python(state, z3.UGT(value.count, most_kept(kind)))
    return value


def assign(event: EventTerms, node: nodes.Assign, state: State) -> Value:
    value = event.value(node.value, state)
    where: int | str = "shared" if node.name in event.active.function.shared else event.active.frame
    if where == "shared" and node.name not in event.beginning.variables:
        raise UnknownError(f"a variable of type {node.type}")
    state.slots[where, node.name] = kept(event, value, node.type, state) if where == "shared" else value
    return value


def convert(event: EventTerms, node: nodes.Convert, state: State) -> Value:
    return convert_term(event.term(node.value, state), node.value.type, node.type)


def arithmetic(event: EventTerms, node: nodes.Arithmetic, state: State) -> Value:
    left, right = event.term(node.left, state), event.term(node.right, state)
    kind, operator = node.type, node.operator
    if isinstance(kind, value_types.FloatingType):
        return OF_FLOATS[operator](NEAREST, left, right)
    assert isinstance(kind, value_types.IntegerType)  # noqa: S101  operands have one of two types
    if operator in "/%":
        event.leave_to_python(state, right == 0)
        if operator == "/":
            result = left / right if kind.signed else z3.UDiv(left, right)
        else:
            result = z3.SRem(left, right) if kind.signed else z3.URem(left, right)
    elif operator in ("<<", ">>"):
        missing = left.size() - right.size()
        amount = z3.ZeroExt(32, right) if missing > 0 else z3.Extract(31, 0, right) if missing else right
        amount = amount & (kind.bits - 1)
        result = (
            left << amount if operator == "<<" else left >> amount if kind.signed else z3.LShR(left, amount)
        )
    else:
        result = OF_INTEGERS[operator](left, right)
    return wrap(result, kind)


def unary(event: EventTerms, node: nodes.Unary, state: State) -> Value:
    value = event.term(node.value, state)
    if isinstance(node.type, value_types.FloatingType):
        return z3.fpAbs(value) if node.operator == "abs" else z3.fpNeg(value)
    if node.operator == "~":
        result = ~value
    elif node.operator == "-":
        result = -value
    else:
        result = z3.If(value < 0, -value, value) if is_signed(node.type) else value
    return wrap(result, node.type) if isinstance(node.type, value_types.IntegerType) else result


def moment(event: EventTerms, node: nodes.Moment, state: State) -> Value:
    left, right = event.term(node.left, state), event.term(node.right, state)
    return within_limits(event, node.type, left + right if node.operator == "+" else left - right, state)


def moment_of(event: EventTerms, node: nodes.MomentOf, state: State) -> Value:
    seconds, rest = event.term(node.seconds, state), event.term(node.nanoseconds, state)
    return of_parts(event, node.type, seconds, rest, state)


def of_parts(event: EventTerms, kind: Type, seconds: Term, rest: Term, state: State) -> Term:
    """Return the time of seconds and nanoseconds.

    Below 2**33 seconds, the product fits in 64 bits, and the sum in 72 bits shows an overflow. More
    seconds are out of range for all allowed nanoseconds, and are not proved.
    """
    far = either(seconds >= 1 << 33, seconds <= -(1 << 33), rest >= 1 << 62, rest <= -(1 << 62))
    known = state.where(far)
    event.ignore(known, "a time of more than 2**33 seconds in parts")
    state.require(opposite(far))
    product = seconds * integer(times.BILLION, 64)
    exact = z3.SignExt(8, product) + z3.SignExt(8, rest)
    limited = within_limits(event, kind, exact, state)
    return z3.Extract(63, 0, limited)


def within_limits(event: EventTerms, kind: Type, moment: Term, state: State) -> Term:
    limits = (0, times.MAX_TIME) if kind == value_types.TIME else (times.MIN_DURATION, times.MAX_DURATION)
    event.leave_to_python(state, either(moment < limits[0], moment > limits[1]))
    return moment


def compare(event: EventTerms, node: nodes.Compare, state: State) -> Value:
    kind = node.left.type
    if isinstance(kind, value_types.VectorType | value_types.RecordType):
        raise UnknownError(f"a comparison of values of type {kind}")
    left, right = event.term(node.left, state), event.term(node.right, state)
    return compare_terms(node.operator, left, right, kind)


def compare_texts(event: EventTerms, node: nodes.CompareTexts, state: State) -> Value:
    given, known = (
        (node.right, node.left) if isinstance(node.left, nodes.Literal) else (node.left, node.right)
    )
    text = known.value if isinstance(known, nodes.Literal) else None
    if node.operator in ("==", "!=") and text is None:
        return same_texts(event, node, state)
    if node.operator not in ("==", "!=") or not node.short or not isinstance(text, bytes):
        raise UnknownError("a comparison of strings")
    view = event.value(given, state)
    if isinstance(view, TextTerm) and not text:
        return view.count == 0 if node.operator == "==" else opposite(view.count == 0)
    if not isinstance(view, View) or len(text) > nodes.SHORT:
        raise UnknownError("a comparison of strings")
    place = z3.Extract(31, 0, view.start)
    letters = [number_at(view.message, place + more, 1) == letter for more, letter in enumerate(text)]
    same = both(view.count == len(text), *letters)
    return same if node.operator == "==" else opposite(same)


def same_texts(event: EventTerms, node: nodes.CompareTexts, state: State) -> Term:
    one, other = event.value(node.left, state), event.value(node.right, state)
    if not isinstance(one, TextTerm) or not isinstance(other, TextTerm):
        raise UnknownError("a comparison of strings")
    if not node.short:
        long: Term = z3.UGT(one.count, integer(nodes.SHORT, 64))
        if isinstance(node.right, nodes.Read):
            long = both(long, z3.UGT(other.count, integer(nodes.SHORT, 64)))
        yes, no = state.where(long), state.where(opposite(long))
        event.spend(z3.UDiv(one.count, integer(BYTES_PER_INSTRUCTION, 64)), yes)
        state.join(long, yes, no)
    first = MISMATCH(one.place, other.place, z3.Extract(31, 0, one.count))
    same = both(one.count == other.count, z3.ZeroExt(32, first) == one.count)
    return same if node.operator == "==" else opposite(same)


def sender(event: EventTerms, node: nodes.SenderName, state: State) -> Value:
    return kept(event, event.beginning.senders[event.active.function.context, node.part], node.type, state)


def altered(event: EventTerms, _node: nodes.Altered, _state: State) -> Value:
    return event.beginning.altered != integer(0, 32)


def logical(event: EventTerms, node: nodes.Logical, state: State) -> Value:
    left = event.term(node.left, state)
    looked_at = left if node.operator == "and" else opposite(left)
    yes, no = state.where(looked_at), state.where(opposite(looked_at))
    right = event.term(node.right, yes)
    state.join(looked_at, yes, no)
    return both(left, right) if node.operator == "and" else either(left, right)


def negation(event: EventTerms, node: nodes.Not, state: State) -> Value:
    return opposite(event.term(node.value, state))


def conditional(event: EventTerms, node: nodes.Conditional, state: State) -> Value:
    test = event.term(node.test, state)
    yes, no = state.where(test), state.where(opposite(test))
    one, other = event.value(node.yes, yes), event.value(node.no, no)
    state.join(test, yes, no)
    return choice(test, one, other)


def sequence(event: EventTerms, node: nodes.Sequence, state: State) -> Value:
    return [event.value(item, state) for item in node.items][node.chosen]


def discard(event: EventTerms, node: nodes.Discard, state: State) -> None:
    event.value(node.value, state)


def now(event: EventTerms, _node: nodes.Now, _state: State) -> Value:
    return event.beginning.now


def throttle(event: EventTerms, node: nodes.Throttle, state: State) -> Value:
    last = event.beginning.throttles.get((event.function.context, node.site))
    if last is None:
        raise UnknownError("output with a rate limit")
    seconds = convert_term(event.term(node.seconds, state), node.seconds.type, value_types.FloatingType(64))
    more = z3.fpMul(NEAREST, seconds, floating(1e9, 64))
    until = z3.fpAdd(NEAREST, z3.fpSignedToFP(NEAREST, last, DOUBLE), more)
    # A whole number is below `until` if it is below the next whole number. A time is from 0 to below 2**62, so the
    # limits of the type do not matter, and nothing is below NaN.
    first = truncate(z3.fpRoundToIntegral(z3.RTP(), until), LONG)
    now = event.beginning.now
    event.leave_to_python(state, opposite(both(last <= now, now < first)))
    return z3.BoolVal(False)


def item(event: EventTerms, node: nodes.Item, state: State) -> Value:
    view = event.value(node.base, state)
    if not isinstance(view, View) or not isinstance(node.base.type, value_types.RecordType):
        raise UnknownError("a part of a value")
    before = event.values.fields(node.base.type)[: node.number]
    return part_of(event, view, sum(map(partial(size_of, event), before)), node.type)


def part_of(event: EventTerms, view: View, offset: Term | int, kind: Type) -> Value:
    start = view.start + offset
    if isinstance(kind, value_types.RecordType):
        return View(view.message, start, integer(1, 64))
    if isinstance(kind, value_types.VectorType) and kind.length is not None:
        return View(view.message, start, integer(kind.length, 64))
    return number(event, view.message, z3.Extract(31, 0, start), kind)


def copied(event: EventTerms, node: nodes.Copy, state: State) -> Value:
    view, kind = event.value(node.value, state), node.type
    if not isinstance(view, View | TextTerm):
        raise UnknownError(f"a copy of type {kind}")
    if isinstance(kind, value_types.VectorType) and struct_code(kind.element) is not None:
        event.make(view.count * event.values.width(kind.element), state)
    elif not isinstance(kind, value_types.RecordType) or any(
        not struct_code(field) for field in event.values.fields(kind)
    ):
        raise UnknownError(f"a copy of type {kind}")
    return view


def call(event: EventTerms, node: nodes.Call, state: State) -> Value:
    name, arguments = node.function, node.arguments
    if name == "a_part":
        return with_part(event, node, state)
    if name == "l_nearest":
        raise NotProvedError("not loop-free: `nearest` reads each element")
    values = [event.value(argument, state) for argument in arguments]
    kind = arguments[0].type if arguments else value_types.VOID
    if name in _OF_VIEWS and isinstance(values[0], View | TextTerm):
        return _OF_VIEWS[name](values[0].count)
    if name == "l_element" and isinstance(values[0], View | TextTerm):
        return element(event, values[0], kind, require_term(values[1], arguments[1].type), state)
    terms = terms_of(values, name)
    rounded = name.removesuffix("f") if kind == value_types.FloatingType(32) else name
    if (
        isinstance(kind, value_types.FloatingType)
        and rounded in ROUNDED
        and (rounded != name) == (kind.bits == 32)
    ):
        return ROUNDED[rounded](terms[0])
    if isinstance(kind, value_types.FloatingType) and name in QUESTIONS:
        return QUESTIONS[name](terms[0])
    if name in ("h_copysign", "h_copysignf"):
        none = QUESTIONS["h_isnan"](terms[1])
        event.ignore(state.where(none), "the sign of a NaN")
        state.require(opposite(none))
        return with_sign(*terms)
    if name in ("h_min", "h_max"):
        return choose(compare_terms("<" if name == "h_min" else ">", terms[1], terms[0], kind), terms)
    if name in ("h_fmin", "h_fmax") and kind == value_types.FloatingType(64):
        less = (z3.fpLT if name == "h_fmin" else z3.fpGT)(terms[1], terms[0])
        return choose(either(z3.fpIsNaN(terms[0]), less), terms)
    if name in _OF_MOMENTS:
        value = _OF_MOMENTS[name](terms[0])
        if isinstance(node.type, value_types.IntegerType) and width(node.type) == 32:
            return z3.Extract(31, 0, value)
        return value
    if name in ("k_after", "k_before"):
        return terms[0] + terms[1] if name == "k_after" else terms[0] - terms[1]
    raise UnknownError(name.partition("_")[2])


def element(event: EventTerms, values: View | TextTerm, kind: Type, index: Term, state: State) -> Value:
    if not isinstance(kind, value_types.VectorType):
        raise UnknownError(f"an element of type {kind}")
    event.leave_to_python(state, z3.UGE(index, values.count))
    offset = index * size_of(event, kind.element)
    if isinstance(values, TextTerm):
        return number(event, MEMORY, values.place + z3.Extract(31, 0, offset), kind.element)
    return part_of(event, values, offset, kind.element)


def with_part(event: EventTerms, node: nodes.Call, state: State) -> Term:
    moment, part, new = node.arguments
    assert isinstance(part, nodes.Literal)  # noqa: S101  the name of a part
    old = event.term(moment, state)
    value = convert_term(event.term(new, state), new.type, LONG)
    seconds, rest = parts(old)
    one, other = (value, rest) if part.value == b"sec" else (seconds, value)
    return of_parts(event, node.type, one, other, state)


def invoke(event: EventTerms, node: nodes.Invoke, state: State) -> Value:
    if node.depth is not None:
        raise UnknownError("recursion")
    function = event.functions[node.function]
    values = [event.value(argument, state) for argument in node.arguments]
    event.calls += 1
    returned: list[tuple[State, Value]] = []
    outer, event.active = event.active, ActiveCall(event.calls, function, returned)
    state.slots |= {
        (event.calls, name): value for name, value in zip(function.parameters, values, strict=False)
    }
    inner = state.where(z3.BoolVal(True))
    try:
        event.block(function.body, inner)
        ends: list[tuple[State, Value]] = [*returned, (inner, None)]
    finally:
        event.active = outer
    ends = [(end, value) for end, value in ends if not z3.is_false(end.alive)]
    if not ends:
        state.alive = z3.BoolVal(False)
        return MIXED
    end, result = ends[-1]
    for before, value in ends[-2::-1]:
        result = choice(before.alive, value, result)
        end = State(either(before.alive, end.alive), merge(before.alive, before, end))
    state.alive, state.slots = end.alive, end.slots
    return result


def terms_of(values: Sequence[Value], function: str) -> Sequence[Term]:
    terms = [value for value in values if isinstance(value, Term)]
    if len(terms) < len(values):
        raise UnknownError(function.partition("_")[2])
    return terms


_OF_VIEWS: Mapping[str, Callable[[Term], Term]] = MappingProxyType(
    {"l_len": lambda count: count, "l_empty": lambda count: count == 0, "l_last": lambda count: count - 1}
)
_OF_MOMENTS: Mapping[str, Callable[[Term], Term]] = MappingProxyType(
    {
        "m_is_zero": lambda value: value == 0,
        "m_whole": lambda value: value,
        "m_seconds": SECONDS,
        "m_sec": lambda value: parts(value)[0],
        "m_nsec": lambda value: parts(value)[1],
    }
)
