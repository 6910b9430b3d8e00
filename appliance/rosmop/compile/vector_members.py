"""Member functions of vectors, and `[]`: `values.push_back(x)`, `values.at(1)`, `values.erase(…)`."""

from collections.abc import Callable, Mapping
from types import MappingProxyType

from appliance.rosmop.compile import cursors
from appliance.rosmop.compile.conversion import convert, number
from appliance.rosmop.compile.invocation import Invocation, Method, empty, length
from appliance.rosmop.compile.places import ElementPlace, Value
from appliance.rosmop.compile.scope import Scope
from appliance.rosmop.positions import Position
from appliance.rosmop.runtime import vectors
from appliance.rosmop.syntax.errors import SpecificationError
from appliance.rosmop.types import kinds

FUNCTIONS: dict[str, Callable[..., object]] = {
    "l_element": vectors.element,
    "l_append": vectors.append,
    "l_append_text": vectors.append_text,
    "l_pop": vectors.pop,
    "l_resized": vectors.resized,
    "l_clear": list.clear,
    "l_len": len,
}


def element_value(scope: Scope, base: Value, index: Value, position: Position, site: int) -> Value:
    """`base[index]` of a vector."""
    assert isinstance(base.type, kinds.Vector)  # the caller has looked
    kind = base.type
    if not kinds.is_number(index.type):
        raise SpecificationError.at(index.position, f"an index is a number; this is {index.type}")
    code = number(index.code, index.type, kinds.LONG)
    known = index.constant
    if kind.length is not None and isinstance(known, int) and not 0 <= known < kind.length:
        raise SpecificationError.at(
            index.position, f"index {known} is past the end of an array of {kind.length} elements"
        )
    place = ElementPlace(base, code, site) if base.place is not None else None
    read = f"l_element({base.code}, {code}, {site})"
    del scope
    return Value(kind.element, read, position, place, owned=base.owned, pure=base.pure and index.pure)


def _vector(call: Invocation) -> kinds.Vector:
    assert isinstance(call.base.type, kinds.Vector)  # methods_of has looked
    return call.base.type


def _vector_at(call: Invocation) -> Value:
    call.count(1)
    return element_value(call.scope, call.base, call.arguments[0], call.position, call.site)


def _vector_front(call: Invocation) -> Value:
    call.count(0)
    first = Value(kinds.LONG, "0", call.position, constant=0)
    return element_value(call.scope, call.base, first, call.position, call.site)


def _vector_back(call: Invocation) -> Value:
    call.count(0)
    last = Value(kinds.LONG, f"(l_len({call.base.code}) - 1)", call.position, pure=call.base.pure)
    return element_value(call.scope, call.base, last, call.position, call.site)


def _push_back(call: Invocation) -> Value:
    call.count(1)
    kind = _vector(call)
    value = convert(call.scope, call.arguments[0], kind.element, call.site)
    width = call.scope.codecs.width(kind.element)
    function = "l_append_text" if isinstance(kind.element, kinds.String) else "l_append"
    return call.changes_in_place(
        f"{function}({call.scope.context}, {call.base.code}, {value}, {width}, {call.site})"
    )


def _pop_back(call: Invocation) -> Value:
    call.count(0)
    return call.changes_in_place(f"l_pop({call.base.code}, {call.site})")


def _vector_clear(call: Invocation) -> Value:
    call.count(0)
    return call.changes_in_place(f"l_clear({call.base.code})")


def _vector_resize(call: Invocation) -> Value:
    call.count(1)
    kind = _vector(call)
    codecs = call.scope.codecs
    maker, width = codecs.maker(kind.element), codecs.width(kind.element)
    arguments = f"{call.base.code}, {call.index(0)}, {maker}, {width}, {call.site}"
    return call.changes_in_place(f"l_resized({call.scope.context}, {arguments})")


def _cursor(call: Invocation) -> Value:
    call.count(0)
    return cursors.begin_or_end(call.base, call.name, call.position)


def _vector_erase(call: Invocation) -> Value:
    call.count(1, 2)
    _refuse_fixed(call)
    return cursors.erase(call.scope, call.base, call.arguments, (call.position, call.site))


def _vector_insert(call: Invocation) -> Value:
    call.count(2)
    _refuse_fixed(call)
    return cursors.insert(call.scope, call.base, call.arguments, (call.position, call.site))


def _refuse_fixed(call: Invocation) -> None:
    if _vector(call).length is not None:
        raise SpecificationError.at(call.position, f"`{call.name}`: an array of fixed length stays so long")


def _nothing(call: Invocation) -> Value:
    call.count(1)
    return Value(kinds.VOID, "None", call.position)


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
