"""Compile member functions of strings: `text.substr(1, 3)`, `text.find("x")`, `text.push_back('c')`."""

from collections.abc import Mapping
from types import MappingProxyType

from rosmop.check.assignables import Value
from rosmop.check.conversion import convert
from rosmop.check.invocation import MemberCall, Method, empty, length
from rosmop.form import nodes
from rosmop.runtime import strings
from rosmop.types import value_types

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
    last = call.called(value_types.STRING, "t_last")
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
        value_types.INT, "t_compare", (call.called(value_types.STRING, "o_charged"), call.text(0))
    )
    return Value(compared, call.position)


def _text_append(call: MemberCall) -> Value:
    call.count(1)
    return call.changes(call.called(value_types.STRING, "t_extend", call.text(0)))


def _text_push(call: MemberCall) -> Value:
    call.count(1)
    added = nodes.Call(
        value_types.STRING, "t_byte", (convert(call.scope, call.arguments[0], value_types.CHAR),)
    )
    return call.changes(call.called(value_types.STRING, "t_extend", added))


def _text_clear(call: MemberCall) -> Value:
    call.count(0)
    return call.changes(nodes.Zero(value_types.STRING))


def _text_pop(call: MemberCall) -> Value:
    call.count(0)
    return call.changes(call.called(value_types.STRING, "t_shorten"))


def _text_resize(call: MemberCall) -> Value:
    call.count(1, 2)
    return call.changes(call.called(value_types.STRING, "t_resize", call.index(0), call.index(1, 0)))


def _text_erase(call: MemberCall) -> Value:
    call.count(0, 2)
    return call.changes(
        call.called(value_types.STRING, "t_erase", call.index(0, 0), call.index(1, strings.NOT_FOUND))
    )


def _text_insert(call: MemberCall) -> Value:
    call.count(2)
    return call.changes(call.called(value_types.STRING, "t_insert", call.index(0), call.text(1)))


def _text_replace(call: MemberCall) -> Value:
    call.count(3)
    return call.changes(
        call.called(value_types.STRING, "t_replace", call.index(0), call.index(1), call.text(2))
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
