"""Member functions of times and durations: `t.toSec()`, `d.fromSec(0.5)`."""

from collections.abc import Mapping
from types import MappingProxyType

from rosmop.check.conversion import check_convertible, convert
from rosmop.check.invocation import Invocation, Method
from rosmop.check.places import Value
from rosmop.form import nodes
from rosmop.types import kinds


def _seconds(call: Invocation) -> Value:
    call.count(0)
    return call.value(kinds.DOUBLE, "m_seconds")


def _nanoseconds(call: Invocation) -> Value:
    call.count(0)
    return call.value(kinds.ULONG if call.base.type == kinds.TIME else kinds.LONG, "m_whole")


def _is_zero(call: Invocation) -> Value:
    call.count(0)
    return call.value(kinds.BOOL, "m_is_zero")


def _set_seconds(call: Invocation) -> Value:
    call.count(1)
    check_convertible(call.arguments[0], kinds.DOUBLE)
    seconds = nodes.Call(kinds.LONG, "m_nanoseconds", (call.arguments[0].form,), call.site)
    return _set(call, seconds)


def _set_nanoseconds(call: Invocation) -> Value:
    call.count(1)
    return _set(call, convert(call.scope, call.arguments[0], kinds.LONG))


def _set(call: Invocation, nanoseconds: nodes.Expression) -> Value:
    limit = "m_time" if isinstance(call.base.type, kinds.Time) else "m_duration"
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
