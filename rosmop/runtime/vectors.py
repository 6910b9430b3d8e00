"""Operations on vectors, which are Python lists. Long values are charged before they are made.

`width` is the size of an element in C++ in bytes, for the memory limit.
"""

import math
import struct
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

from rosmop.runtime.action_context import BYTES_PER_INSTRUCTION, PART, Context, FaultError
from rosmop.types.value_types import Value
from roswire.counted import counted

Values = list[Value]
_T = TypeVar("_T")
_Bytes = TypeVar("_Bytes", int, bool)

LARGE = 1024  # bytes; reading a smaller value is not charged


def element(values: list[_T], index: int, site: int) -> _T:
    if 0 <= index < len(values):
        return values[index]
    raise FaultError(site, f"index {index} is past the end of a vector of {len(values)}")


def put(values: list[_T], index: int, value: _T, site: int) -> _T:
    if 0 <= index < len(values):
        values[index] = value
        return value
    raise FaultError(site, f"index {index} is past the end of a vector of {len(values)}")


def put_slot(record: list[_T], slot: int, value: _T) -> _T:
    record[slot] = value
    return value


def append(context: Context, values: list[_T], value: _T, width: int, site: int) -> None:
    context.allocate(width, site)
    values.append(value)


def append_text(context: Context, values: Values, value: bytes, width: int, site: int) -> None:
    context.allocate(width + len(value), site)
    values.append(value)


def charge(context: Context, values: Values, measure: Callable[[Values], int], site: int) -> Values:
    size = measure(values)
    if size > LARGE:
        context.spend(size // BYTES_PER_INSTRUCTION, site)
    return values


def in_parts(values: list[_T], check: Callable[[int], None]) -> Iterator[_T]:
    """Yield the elements, and call `check` with the number of those that follow, at most `PART`."""
    for first in range(0, len(values), PART):
        part = values[first : first + PART]
        check(len(part))
        yield from part


def pop(values: Values, site: int) -> None:
    if not values:
        raise FaultError(site, "pop_back of an empty vector")
    values.pop()


def copy(context: Context, values: Values, width: int, site: int) -> Values:
    context.allocate(len(values) * width, site)
    return values.copy()


def copied_deep(
    context: Context, values: Values, width: int, copy: Callable[[Context, Value, int], Value], site: int
) -> Values:
    context.allocate(len(values) * width, site)
    return [copy(context, value, site) for value in in_parts(values, context.turn.check)]


def recast(
    context: Context, values: list[_T], convert: Callable[[list[_T]], list[_Bytes]], site: int
) -> list[_Bytes]:
    context.allocate(len(values), site)
    return convert(values)


def recast_each(
    context: Context, values: list[_T], convert: Callable[[_T], Values], site: int
) -> list[Values]:
    context.allocate(len(values), site)
    return [convert(value) for value in values]


def to_signed(values: list[int]) -> list[int]:
    return memoryview(bytes(values)).cast("b").tolist()


def to_unsigned(values: list[int]) -> list[int]:
    return list(struct.pack(f"{len(values)}b", *values))


def truths(values: Values) -> list[bool]:
    return list(map(bool, values))


def fill(context: Context, count: int, make: Callable[[], Value], width: int, site: int) -> Values:
    context.allocate(count * width, site)
    context.spend(count // 4, site)
    return _make(context, count, make)


def _make(context: Context, count: int, make: Callable[[], Value]) -> Values:
    values: Values = []
    for first in range(0, count, PART):
        context.turn.check()
        values += [make() for _ in range(min(PART, count - first))]
    return values


def resize(  # noqa: PLR0917  the arguments are C++'s
    context: Context, values: Values, count: int, make: Callable[[], Value], width: int, site: int
) -> None:
    more = count - len(values)
    if more <= 0:
        del values[count:]
        return
    values += fill(context, more, make, width, site)


def assign(values: Values, others: Values) -> Values:
    values[:] = others
    return values


def filled_with(  # noqa: PLR0917  the arguments are C++'s
    context: Context,
    count: int,
    value: _T,
    copy: Callable[[_T], Value],
    measure: Callable[[_T], int],
    site: int,
) -> Values:
    context.allocate(count * max(measure(value), 1), site)
    context.spend(count // 4, site)
    return _make(context, count, lambda: copy(value))


def require_count(values: Values, count: int, site: int) -> Values:
    if len(values) != count:
        raise FaultError(site, f"{counted(len(values), 'element')} for an array of exactly {count}")
    return values


def _check_span(values: Sequence[object], first: int, last: int, site: int) -> None:
    if not 0 <= first <= last <= len(values):
        raise FaultError(site, f"from {first} to {last} is not within a vector of {len(values)}")


def erase(context: Context, values: Values, first: int, last: int | None, site: int) -> None:
    last = first + 1 if last is None else last
    _check_span(values, first, last, site)
    context.spend((len(values) - first) // 64, site)
    del values[first:last]


def insert(context: Context, values: list[_T], at: int, value: _T, width: int, site: int) -> None:  # noqa: PLR0917  the arguments are C++'s
    _check_span(values, at, len(values), site)
    context.allocate(width, site)
    context.spend(len(values) // 64, site)
    values.insert(at, value)


def sort(context: Context, values: list[Any], first: int, last: int, site: int) -> None:
    _check_span(values, first, last, site)
    steps = (last - first).bit_length()
    context.spend((last - first) * steps, site)
    if values and isinstance(values[0], bytes):
        context.spend(sum(map(len, values[first:last])) // BYTES_PER_INSTRUCTION * steps, site)
    values[first:last] = sorted(values[first:last])


def reverse(context: Context, values: Values, first: int, last: int, site: int) -> None:
    _check_span(values, first, last, site)
    context.spend((last - first) // 4, site)
    values[first:last] = values[first:last][::-1]


def nearest(context: Context, values: list[float], first: int, last: int, site: int) -> float:
    """Return the smallest number from `first` to before `last`, or infinity; NaN is ignored.

    If `first` is after `last`, the range continues at the beginning.
    """
    first, last = (min(max(limit, 0), len(values)) for limit in (first, last))
    least = math.inf
    for begin, end in [(first, last)] if first <= last else [(first, len(values)), (0, last)]:
        context.spend(end - begin, site)
        for at in range(begin, end, PART):
            context.turn.check()
            least = min((value for value in values[at : min(at + PART, end)] if value < least), default=least)
    return float(least)


def accumulate(  # noqa: PLR0917  the arguments are C++'s, and how to add
    context: Context,
    values: Values,
    first: int,
    last: int,
    site: int,
    start: _T,
    add: Callable[[_T, Value], _T],
) -> _T:
    _check_span(values, first, last, site)
    context.spend(last - first, site)
    for index in range(first, last):
        if not index % PART:
            context.turn.check()
        start = add(start, values[index])
    return start
