"""Compile fields and member functions: `message.field`, `text.substr(…)`, `values.push_back(…)`, `time.toSec()`."""

from collections.abc import Mapping
from types import MappingProxyType

from rosmop.check import string_members, vector_members
from rosmop.check.assignables import FieldLvalue, TimePartLvalue, Value
from rosmop.check.conversion import check_convertible, constant_value, convert
from rosmop.check.invocation import MemberCall, Method
from rosmop.check.scope import FunctionScope
from rosmop.form import nodes
from rosmop.form.findings import Position, SpecificationError
from rosmop.runtime.numbers import f32
from rosmop.text.foreign import instead
from rosmop.types import value_types
from rosmop.types.messages import PRIMITIVES, UnknownNameError, nearest, shown


def field(scope: FunctionScope, base: Value, name: str, position: Position, site: int) -> Value:
    if isinstance(base.type, value_types.RecordType):
        try:
            slot = scope.messages.slot(base.type.name, name)
        except UnknownNameError as error:
            if name in {constant.name for constant in scope.messages.definition(base.type.name).constants}:
                return constant(scope, base.type.name, name, position)
            raise SpecificationError.at(position, str(error)) from None
        place = FieldLvalue(base, slot.index) if base.place is not None else None
        item = nodes.Item(slot.type, base.form, slot.index)
        return Value(item, position, place, owned=base.owned)
    if isinstance(base.type, value_types.TimeType | value_types.DurationType) and name in ("sec", "nsec"):
        kind = value_types.UINT if isinstance(base.type, value_types.TimeType) else value_types.INT
        part = TimePartLvalue(base, name, site) if base.place is not None else None
        return Value(nodes.Call(kind, f"m_{name}", (base.form,)), position, part)
    members = methods_of(base.type)
    if name in members:
        raise SpecificationError.at(position, f"`{name}` is a function; write `.{name}(…)`")
    raise SpecificationError.at(position, f"{base.type} has no member {shown(name)}{nearest(name, members)}")


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
            invocation.position, f"{invocation.base.type} has no function {shown(name)}{hint}"
        )
    return method(invocation)


def methods_of(kind: value_types.Type) -> Mapping[str, Method]:
    if isinstance(kind, value_types.StringType):
        return string_members.TEXT_METHODS
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
