"""Fields and member functions: `message.field`, `text.substr(…)`, `values.push_back(…)`, `time.toSec()`."""

from collections.abc import Mapping

from rosmop.check import string_members, time_members, vector_members
from rosmop.check.assignables import PartPlace, SlotPlace, Value
from rosmop.check.conversion import constant_value
from rosmop.check.invocation import Invocation, Method
from rosmop.check.scope import Scope
from rosmop.form import nodes
from rosmop.form.positions import Position
from rosmop.runtime.numbers import f32
from rosmop.text.errors import SpecificationError
from rosmop.text.foreign import instead
from rosmop.types import value_types
from rosmop.types.messages import PRIMITIVES, UnknownNameError, nearest, shown


def field(scope: Scope, base: Value, name: str, position: Position, site: int) -> Value:
    """`base.name`."""
    if isinstance(base.type, value_types.Record):
        try:
            slot = scope.messages.slot(base.type.name, name)
        except UnknownNameError as error:
            if name in {constant.name for constant in scope.messages.definition(base.type.name).constants}:
                return constant(scope, base.type.name, name, position)
            raise SpecificationError.at(position, str(error)) from None
        place = SlotPlace(base, slot.index) if base.place is not None else None
        item = nodes.Item(slot.type, base.form, slot.index)
        return Value(item, position, place, owned=base.owned)
    if isinstance(base.type, value_types.Time | value_types.Duration) and name in ("sec", "nsec"):
        kind = value_types.UINT if isinstance(base.type, value_types.Time) else value_types.INT
        part = PartPlace(base, name, site) if base.place is not None else None
        return Value(nodes.Call(kind, f"m_{name}", (base.form,)), position, part)
    members = methods_of(base.type)
    if name in members:
        raise SpecificationError.at(position, f"`{name}` is a function; write `.{name}(…)`")
    raise SpecificationError.at(position, f"{base.type} has no member {shown(name)}{nearest(name, members)}")


def constant(scope: Scope, message_type: str, name: str, position: Position) -> Value:
    """`package::Type::NAME`, and `variable.NAME`."""
    try:
        found = scope.messages.constant(message_type, name)
    except UnknownNameError as error:
        raise SpecificationError.at(position, str(error)) from None
    kind = PRIMITIVES[found.type]
    value = found.value.encode("utf-8", "surrogateescape") if isinstance(found.value, str) else found.value
    if kind == value_types.FLOAT and not isinstance(value, bytes):
        value = f32(value)
    return constant_value(position, kind, value)


def call(invocation: Invocation) -> Value:
    """`base.name(arguments)`."""
    methods = methods_of(invocation.base.type)
    method = methods.get(invocation.name)
    if method is None:
        name = invocation.name
        told = instead((name,))
        hint = f"; {told}" if told else nearest(name, methods)
        raise SpecificationError.at(
            invocation.position, f"{invocation.base.type} has no function {shown(name)}{hint}"
        )
    return method(invocation)


def methods_of(kind: value_types.Type) -> Mapping[str, Method]:
    """The member functions of a type."""
    if isinstance(kind, value_types.String):
        return string_members.TEXT_METHODS
    if isinstance(kind, value_types.Vector):
        return vector_members.VECTOR_METHODS
    if isinstance(kind, value_types.Time | value_types.Duration):
        return time_members.MOMENT_METHODS
    return {}
