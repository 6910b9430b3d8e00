"""Compile member functions of vectors, and `[]`: `values.push_back(x)`, `values.at(1)`, `values.erase(…)`."""

from collections.abc import Mapping
from types import MappingProxyType

from rosmop.check import cursors
from rosmop.check.assignables import ElementLvalue, Value
from rosmop.check.conversion import constant_value, convert, number
from rosmop.check.invocation import MemberCall, Method, empty, length
from rosmop.form import nodes
from rosmop.form.findings import Position, SpecificationError
from rosmop.types import value_types
from roswire.counted import counted


def element_value(base: Value, index: Value, position: Position, site: int) -> Value:
    assert isinstance(base.type, value_types.VectorType)  # the caller checks this
    kind = base.type
    if not value_types.is_number(index.type):
        raise SpecificationError.at(index.position, f"an index is a number; this is {index.type}")
    at = number(index.form, value_types.LONG)
    known = index.constant
    if kind.length is not None and isinstance(known, int) and not 0 <= known < kind.length:
        raise SpecificationError.at(
            index.position, f"index {known} is past the end of an array of {counted(kind.length, 'element')}"
        )
    lvalue = ElementLvalue(base, at, site) if base.place is not None else None
    element = nodes.Call(kind.element, "l_element", (base.form, at), site)
    return Value(element, position, lvalue, owned=base.owned)


def _vector(call: MemberCall) -> value_types.VectorType:
    assert isinstance(call.base.type, value_types.VectorType)  # methods_of checks this
    return call.base.type


def _vector_at(call: MemberCall) -> Value:
    call.count(1)
    return element_value(call.base, call.arguments[0], call.position, call.site)


def _vector_front(call: MemberCall) -> Value:
    call.count(0)
    first = constant_value(call.position, value_types.LONG, 0)
    return element_value(call.base, first, call.position, call.site)


def _vector_back(call: MemberCall) -> Value:
    call.count(0)
    return element_value(call.base, call.value(value_types.LONG, "l_last"), call.position, call.site)


def _push_back(call: MemberCall) -> Value:
    call.count(1)
    kind = _vector(call)
    value = convert(call.scope, call.arguments[0], kind.element, call.site)
    width = nodes.Literal(value_types.ULONG, call.scope.values.width(kind.element))
    function = "l_append_text" if isinstance(kind.element, value_types.StringType) else "l_append"
    return call.changes_in_place(function, value, width)


def _pop_back(call: MemberCall) -> Value:
    call.count(0)
    return call.changes_in_place("l_pop")


def _vector_clear(call: MemberCall) -> Value:
    call.count(0)
    return call.changes_in_place("l_clear")


def _vector_resize(call: MemberCall) -> Value:
    call.count(1)
    element = _vector(call).element
    width = nodes.Literal(value_types.ULONG, call.scope.values.width(element))
    return call.changes_in_place("l_resized", call.index(0), nodes.OfType("zero", element), width)


def _cursor(call: MemberCall) -> Value:
    call.count(0)
    return cursors.begin_or_end(call.base, call.name, call.position)


def _vector_erase(call: MemberCall) -> Value:
    call.count(1, 2)
    _refuse_fixed(call)
    return cursors.erase(call.scope, call.base, call.arguments, (call.position, call.site))


def _vector_insert(call: MemberCall) -> Value:
    call.count(2)
    _refuse_fixed(call)
    return cursors.insert(call.scope, call.base, call.arguments, (call.position, call.site))


def _refuse_fixed(call: MemberCall) -> None:
    if _vector(call).length is not None:
        raise SpecificationError.at(
            call.position, f"`{call.name}`: an array of fixed length cannot change its length"
        )


def _nothing(call: MemberCall) -> Value:
    call.count(1)
    return Value(nodes.Literal(value_types.VOID, None), call.position)


VECTOR_METHODS: Mapping[str, Method] = MappingProxyType(
    {
        "size": length,
        "empty": empty,
        "at": _vector_at,
        "front": _vector_front,
        "back": _vector_back,
        "push_back": _push_back,
        "pop_back": _pop_back,
        "clear": _vector_clear,
        "resize": _vector_resize,
        "reserve": _nothing,
        "begin": _cursor,
        "end": _cursor,
        "erase": _vector_erase,
        "insert": _vector_insert,
    }
)
