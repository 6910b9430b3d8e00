"""Member functions of strings: `text.substr(1, 3)`, `text.find("x")`, `text.push_back('c')`."""

from collections.abc import Callable, Mapping
from types import MappingProxyType

from appliance.rosmop.compile.conversion import convert
from appliance.rosmop.compile.invocation import Invocation, Method, empty, length
from appliance.rosmop.compile.places import Value
from appliance.rosmop.runtime import texts
from appliance.rosmop.types import kinds

FUNCTIONS: dict[str, Callable[..., object]] = {
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
    "t_extend": texts.extend,
    "t_bytes": bytes,
    "t_float": float,
}
_END = texts.NOT_FOUND


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
    charged = f"o_charged({call.scope.context}, {call.base.code}, {call.site})"
    return call.value(kinds.INT, f"t_compare({charged}, {call.text(0)})")


def _text_append(call: Invocation) -> Value:
    call.count(1)
    return call.changes(f"t_extend({call.scope.context}, {call.base.code}, {call.text(0)}, {call.site})")


def _text_push(call: Invocation) -> Value:
    call.count(1)
    code = convert(call.scope, call.arguments[0], kinds.CHAR)
    added = f"t_bytes(({code} & 255,))"
    return call.changes(f"t_extend({call.scope.context}, {call.base.code}, {added}, {call.site})")


def _text_clear(call: Invocation) -> Value:
    call.count(0)
    return call.changes("b''")


def _text_pop(call: Invocation) -> Value:
    call.count(0)
    return call.changes(f"t_shorten({call.scope.context}, {call.base.code}, {call.site})")


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
