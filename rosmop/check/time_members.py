"""Member functions of times and durations: `t.toSec()`, `d.fromSec(0.5)`."""

from collections.abc import Mapping
from types import MappingProxyType

from rosmop.check.assignables import Value
from rosmop.check.conversion import check_convertible, convert
from rosmop.check.invocation import Invocation, Method
from rosmop.form import nodes
from rosmop.types import value_types


def _seconds(call: Invocation) -> Value:
    call.count(0)
    return call.value(value_types.DOUBLE, "m_seconds")


def _nanoseconds(call: Invocation) -> Value:
    call.count(0)
    return call.value(
        value_types.ULONG if call.base.type == value_types.TIME else value_types.LONG, "m_whole"
    )


def _is_zero(call: Invocation) -> Value:
    call.count(0)
    return call.value(value_types.BOOL, "m_is_zero")


def _set_seconds(call: Invocation) -> Value:
    call.count(1)
    check_convertible(call.arguments[0], value_types.DOUBLE)
    seconds = nodes.Call(value_types.LONG, "m_nanoseconds", (call.arguments[0].form,), call.site)
    return _set(call, seconds)


def _set_nanoseconds(call: Invocation) -> Value:
    call.count(1)
    return _set(call, convert(call.scope, call.arguments[0], value_types.LONG))


def _set(call: Invocation, nanoseconds: nodes.Expression) -> Value:
    limit = "m_time" if isinstance(call.base.type, value_types.Time) else "m_duration"
    return call.changes(nodes.Call(call.base.type, limit, (nanoseconds,), call.site))


MOMENT_METHODS: Mapping[str, Method] = MappingProxyType(
    {
        "toSec": _seconds,
        "toNSec": _nanoseconds,
        "isZero": _is_zero,
        "fromSec": _set_seconds,
        "fromNSec": _set_nanoseconds,
    }
)
