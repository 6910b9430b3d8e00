"""Compile fields and member functions: `message.field`, `text.substr(…)`, `values.push_back(…)`, `time.toSec()`."""

from collections.abc import Mapping
from types import MappingProxyType

from rosmop.check import vector_members
from rosmop.check.assignables import FieldLvalue, TimePartLvalue, Value
from rosmop.check.conversion import check_convertible, constant_value, convert
from rosmop.check.invocation import MemberCall, Method, empty, length
from rosmop.check.scope import FunctionScope
from rosmop.form import nodes
from rosmop.form.findings import Position, SpecificationError
from rosmop.runtime import strings
from rosmop.runtime.numbers import f32
from rosmop.text.foreign import instead
from rosmop.types import value_types
from rosmop.types.messages import PRIMITIVES, UnknownNameError, nearest, quote

# Compile member functions of strings: `text.substr(1, 3)`, `text.find("x")`, `text.push_back('c')`.

_BEGIN = nodes.Literal(value_types.ULONG, 0)


def _same(call: MemberCall) -> Value:
    call.count(0)
    return Value(call.base.form, call.position, constant=call.base.constant)


def _text_at(call: MemberCall) -> Value:
    call.count(1)
    return call.value(value_types.CHAR, "t_member", call.index(0))


def _text_front(call: MemberCall) -> Value:
    call.count(0)
    return call.value(value_types.CHAR, "t_member", _BEGIN)


def _text_back(call: MemberCall) -> Value:
    call.count(0)
    last = call.call(value_types.STRING, "t_last")
    return Value(nodes.Call(value_types.CHAR, "t_member", (last, _BEGIN), call.site), call.position)


def _substring(call: MemberCall) -> Value:
    call.count(0, 2)
    return call.value(value_types.STRING, "t_substring", call.index(0, 0), call.index(1, strings.NOT_FOUND))


def _finder(function: str, start: int) -> Method:
    def method(call: MemberCall) -> Value:
        call.count(1, 2)
        return call.value(value_types.ULONG, function, call.text(0), call.index(1, start))

    return method


def _compare(call: MemberCall) -> Value:
    call.count(1)
    compared = nodes.Call(
        value_types.INT, "t_compare", (call.call(value_types.STRING, "o_charged"), call.text(0))
    )
    return Value(compared, call.position)


def _text_append(call: MemberCall) -> Value:
    call.count(1)
    return call.changes(call.call(value_types.STRING, "t_extend", call.text(0)))


def _text_push(call: MemberCall) -> Value:
    call.count(1)
    added = nodes.Call(
        value_types.STRING, "t_byte", (convert(call.scope, call.arguments[0], value_types.CHAR),)
    )
    return call.changes(call.call(value_types.STRING, "t_extend", added))


def _text_clear(call: MemberCall) -> Value:
    call.count(0)
    return call.changes(nodes.Zero(value_types.STRING))


def _text_pop(call: MemberCall) -> Value:
    call.count(0)
    return call.changes(call.call(value_types.STRING, "t_shorten"))


def _text_resize(call: MemberCall) -> Value:
    call.count(1, 2)
    return call.changes(call.call(value_types.STRING, "t_resize", call.index(0), call.index(1, 0)))


def _text_erase(call: MemberCall) -> Value:
    call.count(0, 2)
    return call.changes(
        call.call(value_types.STRING, "t_erase", call.index(0, 0), call.index(1, strings.NOT_FOUND))
    )


def _text_insert(call: MemberCall) -> Value:
    call.count(2)
    return call.changes(call.call(value_types.STRING, "t_insert", call.index(0), call.text(1)))


def _text_replace(call: MemberCall) -> Value:
    call.count(3)
    return call.changes(
        call.call(value_types.STRING, "t_replace", call.index(0), call.index(1), call.text(2))
    )


TEXT_METHODS: Mapping[str, Method] = MappingProxyType(
    {
        "size": length,
        "length": length,
        "empty": empty,
        "c_str": _same,
        "data": _same,
        "at": _text_at,
        "front": _text_front,
        "back": _text_back,
        "substr": _substring,
        "find": _finder("t_find", 0),
        "rfind": _finder("t_find_last", strings.NOT_FOUND),
        "find_first_of": _finder("t_find_any", 0),
        "compare": _compare,
        "append": _text_append,
        "assign": lambda call: call.changes(call.text(call.count(1) - 1)),
        "push_back": _text_push,
        "pop_back": _text_pop,
        "clear": _text_clear,
        "resize": _text_resize,
        "erase": _text_erase,
        "insert": _text_insert,
        "replace": _text_replace,
    }
)


def field(scope: FunctionScope, base: Value, name: str, position: Position, site: int) -> Value:
    if isinstance(base.type, value_types.RecordType):
        try:
            slot = scope.messages.slot(base.type.name, name)
        except UnknownNameError as error:
            if name in {constant.name for constant in scope.messages.definition(base.type.name).constants}:
                return constant(scope, base.type.name, name, position)
            raise SpecificationError.at(position, str(error)) from None
        lvalue = FieldLvalue(base, slot.index) if base.place is not None else None
        item = nodes.Item(slot.type, base.form, slot.index)
        return Value(item, position, lvalue, owned=base.owned)
    if isinstance(base.type, value_types.TimeType | value_types.DurationType) and name in ("sec", "nsec"):
        kind = value_types.UINT if isinstance(base.type, value_types.TimeType) else value_types.INT
        part = TimePartLvalue(base, name, site) if base.place is not None else None
        return Value(nodes.Call(kind, f"m_{name}", (base.form,)), position, part)
    members = methods_of(base.type)
    if name in members:
        raise SpecificationError.at(position, f"`{name}` is a function; write `.{name}(…)`")
    raise SpecificationError.at(position, f"{base.type} has no member {quote(name)}{nearest(name, members)}")


def constant(scope: FunctionScope, message_type: str, name: str, position: Position) -> Value:
    try:
        found = scope.messages.constant(message_type, name)
    except UnknownNameError as error:
        raise SpecificationError.at(position, str(error)) from None
    kind = PRIMITIVES[found.type]
    value = found.value.encode("utf-8", "surrogateescape") if isinstance(found.value, str) else found.value
    if kind == value_types.FLOAT and not isinstance(value, bytes):
        value = f32(value)
    return constant_value(position, kind, value)


def call(invocation: MemberCall) -> Value:
    methods = methods_of(invocation.base.type)
    method = methods.get(invocation.name)
    if method is None:
        name = invocation.name
        advice = instead((name,))
        hint = f"; {advice}" if advice else nearest(name, methods)
        raise SpecificationError.at(
            invocation.position, f"{invocation.base.type} has no function {quote(name)}{hint}"
        )
    return method(invocation)


def methods_of(kind: value_types.Type) -> Mapping[str, Method]:
    if isinstance(kind, value_types.StringType):
        return TEXT_METHODS
    if isinstance(kind, value_types.VectorType):
        return vector_members.VECTOR_METHODS
    if isinstance(kind, value_types.TimeType | value_types.DurationType):
        return TIME_METHODS
    return {}


def _seconds(call: MemberCall) -> Value:
    call.count(0)
    return call.value(value_types.DOUBLE, "m_seconds")


def _nanoseconds(call: MemberCall) -> Value:
    call.count(0)
    return call.value(
        value_types.ULONG if call.base.type == value_types.TIME else value_types.LONG, "m_whole"
    )


def _is_zero(call: MemberCall) -> Value:
    call.count(0)
    return call.value(value_types.BOOL, "m_is_zero")


def _set_seconds(call: MemberCall) -> Value:
    call.count(1)
    check_convertible(call.arguments[0], value_types.DOUBLE)
    seconds = nodes.Call(value_types.LONG, "m_nanoseconds", (call.arguments[0].form,), call.site)
    return _set(call, seconds)


def _set_nanoseconds(call: MemberCall) -> Value:
    call.count(1)
    return _set(call, convert(call.scope, call.arguments[0], value_types.LONG))


def _set(call: MemberCall, nanoseconds: nodes.Expression) -> Value:
    limit = "m_time" if isinstance(call.base.type, value_types.TimeType) else "m_duration"
    return call.changes(nodes.Call(call.base.type, limit, (nanoseconds,), call.site))


TIME_METHODS: Mapping[str, Method] = MappingProxyType(
    {
        "toSec": _seconds,
        "toNSec": _nanoseconds,
        "isZero": _is_zero,
        "fromSec": _set_seconds,
        "fromNSec": _set_nanoseconds,
    }
)
