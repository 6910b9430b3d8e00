"""Fields and member functions: `message.field`, `text.substr(…)`, `values.push_back(…)`, `time.toSec()`."""

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType

from appliance.rosmop.compile import cursors
from appliance.rosmop.compile.conversion import check_convertible, convert, number
from appliance.rosmop.compile.places import ElementPlace, PartPlace, SlotPlace, Value
from appliance.rosmop.compile.scope import Scope
from appliance.rosmop.compile.storing import mark, require_place, store
from appliance.rosmop.positions import Position
from appliance.rosmop.runtime import texts, times, vectors
from appliance.rosmop.syntax.errors import SpecificationError
from appliance.rosmop.types import kinds
from appliance.rosmop.types.messages import UnknownNameError, nearest, shown

FUNCTIONS = {
    "t_member": texts.member,
    "t_substring": texts.substring,
    "t_find": texts.find,
    "t_find_last": texts.find_last,
    "t_find_any": texts.find_any,
    "t_compare": texts.compare,
    "t_resize": texts.resize,
    "t_erase": texts.erase,
    "t_insert": texts.insert,
    "t_replace": texts.replace,
    "t_shorten": texts.shorten,
    "t_join": texts.join,
    "t_bytes": bytes,
    "t_float": float,
    "m_nanoseconds": times.nanoseconds,
    "m_time": times.time,
    "m_duration": times.duration,
    "l_element": vectors.element,
    "l_append": vectors.append,
    "l_append_text": vectors.append_text,
    "l_pop": vectors.pop,
    "l_resized": vectors.resized,
    "l_clear": list.clear,
    "l_len": len,
}
_END = texts.NOT_FOUND


def field(scope: Scope, base: Value, name: str, position: Position, site: int) -> Value:
    """`base.name`."""
    if isinstance(base.type, kinds.Record):
        try:
            slot = scope.messages.slot(base.type.name, name)
        except UnknownNameError as error:
            raise SpecificationError.at(position, str(error)) from None
        place = SlotPlace(base, slot.index) if base.place is not None else None
        code = f"{base.code}[{slot.index}]"
        return Value(slot.type, code, position, place, owned=base.owned, pure=base.pure)
    if isinstance(base.type, kinds.Time | kinds.Duration) and name in ("sec", "nsec"):
        kind = kinds.UINT if isinstance(base.type, kinds.Time) else kinds.INT
        operator = "//" if name == "sec" else "%"
        part = PartPlace(base, name, site) if base.place is not None else None
        return Value(kind, f"({base.code} {operator} 1000000000)", position, part, pure=base.pure)
    members = methods_of(base.type)
    if name in members:
        raise SpecificationError.at(position, f"`{name}` is a function; write `.{name}(…)`")
    raise SpecificationError.at(position, f"{base.type} has no member {shown(name)}{nearest(name, members)}")


class Invocation:
    """A call of a member function."""

    def __init__(
        self, scope: Scope, base: Value, name: str, arguments: Sequence[Value], at: tuple[Position, int]
    ) -> None:
        self.scope = scope
        self.base = base
        self.name = name
        self.arguments = arguments
        self.position, self.site = at

    def count(self, least: int, most: int | None = None) -> int:
        """How many arguments there are; refuses another number."""
        number_of = len(self.arguments)
        if not least <= number_of <= (least if most is None else most):
            wanted = str(least) if most in (None, least) else f"{least} to {most}"
            raise SpecificationError.at(
                self.position, f"`{self.name}` takes {wanted} argument(s), not {number_of}"
            )
        return number_of

    def index(self, position: int, default: int | None = None) -> str:
        """An argument as an index."""
        if default is not None and position >= len(self.arguments):
            return str(default)
        value = self.arguments[position]
        if not kinds.is_number(value.type):
            raise SpecificationError.at(value.position, f"`{self.name}` needs a number; this is {value.type}")
        return number(value.code, value.type, kinds.ULONG)

    def text(self, position: int) -> str:
        """An argument as a string; a character is one of length 1."""
        value = self.arguments[position]
        if value.type == kinds.CHAR:
            return f"t_bytes(({value.code} & 255,))"
        return convert(self.scope, value, kinds.STRING)

    def value(self, kind: kinds.Type, code: str, *, pure: bool = True) -> Value:
        """The result."""
        return Value(kind, code, self.position, pure=pure and self.base.pure)

    def changes(self, code: str) -> Value:
        """The result of a function that gives the base a new value."""
        require_place(self.base, f"`{self.name}`")
        return Value(kinds.VOID, store(self.scope, self.base, code), self.position, pure=False)

    def changes_in_place(self, code: str, *, grows: bool = True) -> Value:
        """The result of a function that changes the vector itself."""
        require_place(self.base, f"`{self.name}`")
        if grows and isinstance(self.base.type, kinds.Vector) and self.base.type.length is not None:
            raise SpecificationError.at(
                self.position, f"`{self.name}`: an array of fixed length stays so long"
            )
        flag = mark(self.scope, self.base)
        whole = f"(({flag} := True), {code})[1]" if flag else code
        return Value(kinds.VOID, whole, self.position, pure=False)


Method = Callable[[Invocation], Value]


def call(invocation: Invocation) -> Value:
    """`base.name(arguments)`."""
    methods = methods_of(invocation.base.type)
    method = methods.get(invocation.name)
    if method is None:
        name = invocation.name
        raise SpecificationError.at(
            invocation.position,
            f"{invocation.base.type} has no function {shown(name)}{nearest(name, methods)}",
        )
    return method(invocation)


def methods_of(kind: kinds.Type) -> Mapping[str, Method]:
    """The member functions of a type."""
    if isinstance(kind, kinds.String):
        return TEXT_METHODS
    if isinstance(kind, kinds.Vector):
        return VECTOR_METHODS
    if isinstance(kind, kinds.Time | kinds.Duration):
        return MOMENT_METHODS
    return {}


# Strings


def _length(call: Invocation) -> Value:
    call.count(0)
    return call.value(kinds.ULONG, f"l_len({call.base.code})")


def _empty(call: Invocation) -> Value:
    call.count(0)
    return call.value(kinds.BOOL, f"(not {call.base.code})")


def _same(call: Invocation) -> Value:
    call.count(0)
    return Value(
        kinds.STRING, call.base.code, call.position, constant=call.base.constant, pure=call.base.pure
    )


def _text_at(call: Invocation) -> Value:
    call.count(1)
    return call.value(kinds.CHAR, f"t_member({call.base.code}, {call.index(0)}, {call.site})")


def _text_front(call: Invocation) -> Value:
    call.count(0)
    return call.value(kinds.CHAR, f"t_member({call.base.code}, 0, {call.site})")


def _text_back(call: Invocation) -> Value:
    call.count(0)
    return call.value(kinds.CHAR, f"t_member({call.base.code}[-1:], 0, {call.site})")


def _substring(call: Invocation) -> Value:
    call.count(0, 2)
    arguments = f"{call.base.code}, {call.index(0, 0)}, {call.index(1, _END)}, {call.site}"
    return call.value(kinds.STRING, f"t_substring({call.scope.context}, {arguments})")


def _finder(function: str, start: int) -> Method:
    def method(call: Invocation) -> Value:
        call.count(1, 2)
        arguments = f"{call.base.code}, {call.text(0)}, {call.index(1, start)}, {call.site}"
        return call.value(kinds.ULONG, f"{function}({call.scope.context}, {arguments})")

    return method


def _compare(call: Invocation) -> Value:
    call.count(1)
    return call.value(kinds.INT, f"t_compare({call.base.code}, {call.text(0)})")


def _text_append(call: Invocation) -> Value:
    call.count(1)
    return call.changes(f"t_join({call.scope.context}, {call.base.code}, {call.text(0)}, {call.site})")


def _text_push(call: Invocation) -> Value:
    call.count(1)
    code = convert(call.scope, call.arguments[0], kinds.CHAR)
    added = f"t_bytes(({code} & 255,))"
    return call.changes(f"t_join({call.scope.context}, {call.base.code}, {added}, {call.site})")


def _text_clear(call: Invocation) -> Value:
    call.count(0)
    return call.changes("b''")


def _text_pop(call: Invocation) -> Value:
    call.count(0)
    return call.changes(f"t_shorten({call.base.code}, {call.site})")


def _text_resize(call: Invocation) -> Value:
    call.count(1, 2)
    arguments = f"{call.base.code}, {call.index(0)}, {call.index(1, 0)}, {call.site}"
    return call.changes(f"t_resize({call.scope.context}, {arguments})")


def _text_erase(call: Invocation) -> Value:
    call.count(0, 2)
    arguments = f"{call.base.code}, {call.index(0, 0)}, {call.index(1, _END)}, {call.site}"
    return call.changes(f"t_erase({call.scope.context}, {arguments})")


def _text_insert(call: Invocation) -> Value:
    call.count(2)
    arguments = f"{call.base.code}, {call.index(0)}, {call.text(1)}, {call.site}"
    return call.changes(f"t_insert({call.scope.context}, {arguments})")


def _text_replace(call: Invocation) -> Value:
    call.count(3)
    arguments = f"{call.base.code}, {call.index(0)}, {call.index(1)}, {call.text(2)}, {call.site}"
    return call.changes(f"t_replace({call.scope.context}, {arguments})")


TEXT_METHODS: Mapping[str, Method] = MappingProxyType(
    {
        "size": _length,
        "length": _length,
        "empty": _empty,
        "c_str": _same,
        "data": _same,
        "at": _text_at,
        "front": _text_front,
        "back": _text_back,
        "substr": _substring,
        "find": _finder("t_find", 0),
        "rfind": _finder("t_find_last", _END),
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


# Vectors


def element_value(scope: Scope, base: Value, index: Value, position: Position, site: int) -> Value:
    """`base[index]` of a vector."""
    assert isinstance(base.type, kinds.Vector)  # noqa: S101  the caller has looked
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
    assert isinstance(call.base.type, kinds.Vector)  # noqa: S101  methods_of has looked
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
        "size": _length,
        "empty": _empty,
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


# Times


def _seconds(call: Invocation) -> Value:
    call.count(0)
    return call.value(kinds.DOUBLE, f"({call.base.code} / 1000000000)")


def _nanoseconds(call: Invocation) -> Value:
    call.count(0)
    kind = kinds.ULONG if isinstance(call.base.type, kinds.Time) else kinds.LONG
    return call.value(kind, call.base.code)


def _is_zero(call: Invocation) -> Value:
    call.count(0)
    return call.value(kinds.BOOL, f"({call.base.code} == 0)")


def _set_seconds(call: Invocation) -> Value:
    call.count(1)
    check_convertible(call.arguments[0], kinds.DOUBLE)
    limit = "m_time" if isinstance(call.base.type, kinds.Time) else "m_duration"
    seconds = f"m_nanoseconds({call.arguments[0].code}, {call.site})"
    return call.changes(f"{limit}({seconds}, {call.site})")


def _set_nanoseconds(call: Invocation) -> Value:
    limit = "m_time" if isinstance(call.base.type, kinds.Time) else "m_duration"
    call.count(1)
    return call.changes(f"{limit}({convert(call.scope, call.arguments[0], kinds.LONG)}, {call.site})")


MOMENT_METHODS: Mapping[str, Method] = MappingProxyType(
    {
        "toSec": _seconds,
        "toNSec": _nanoseconds,
        "isZero": _is_zero,
        "fromSec": _set_seconds,
        "fromNSec": _set_nanoseconds,
    }
)
