"""Member functions of times and durations: `t.toSec()`, `d.fromSec(0.5)`."""

from collections.abc import Callable, Mapping
from types import MappingProxyType

from appliance.rosmop.compile.conversion import check_convertible, convert
from appliance.rosmop.compile.invocation import Invocation, Method
from appliance.rosmop.compile.places import Value
from appliance.rosmop.runtime import times
from appliance.rosmop.types import kinds

FUNCTIONS: dict[str, Callable[..., object]] = {
    "m_nanoseconds": times.nanoseconds,
    "m_time": times.time,
    "m_duration": times.duration,
}


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
