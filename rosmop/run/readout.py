"""Read the variables of a running specification for a person, within limits.

A value is a `bool`, a number, a text, a list or a dictionary. Numbers that are not finite, and all that is cut, are
text: `nan`, `… 344 more`. Times and durations are seconds.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple, TypeAlias

from rosmop.form.compiled import SpecificationCode
from rosmop.types import value_types
from rosmop.types.messages import MessageTypes
from rosmop.types.value_types import Type

MAX_VALUES = 200
MAX_ELEMENTS = 16
MAX_CHARACTERS = 200
Value: TypeAlias = "bool | int | float | bytes | bytearray | list[Value]"
"""The value of a variable (`rosmop/types/value_types.py`)."""
_CUT = "…"
_AGE = "age("


class Readout(NamedTuple):
    """The variables by name, and the seconds since each event whose age the specification uses; None: never."""

    values: dict[str, object]
    ages: dict[str, float | None]


class _FullError(Exception):
    pass


class _Reader:
    def __init__(self, messages: MessageTypes) -> None:
        self._messages = messages
        self._left = MAX_VALUES

    def value(self, kind: Type, value: Value) -> object:
        self._left -= 1
        if self._left < 0:
            raise _FullError
        if isinstance(value, list):
            return self._list(kind, value)
        if isinstance(value, float):
            return value if math.isfinite(value) else str(value)
        if isinstance(value, bytes | bytearray):
            text = bytes(value[:MAX_CHARACTERS]).decode("utf-8", "backslashreplace")
            return text + (_more(len(value) - MAX_CHARACTERS) if len(value) > MAX_CHARACTERS else "")
        return value / 1e9 if isinstance(kind, value_types.TimeType | value_types.DurationType) else value

    def _list(self, kind: Type, value: list[Value]) -> object:
        if isinstance(kind, value_types.RecordType):
            slots = self._messages.slots(kind.name).values()
            return {slot.name: self.value(slot.type, one) for slot, one in zip(slots, value, strict=True)}
        if not isinstance(kind, value_types.VectorType):
            raise TypeError(f"{kind} has no elements")
        shown = [self.value(kind.element, one) for one in value[:MAX_ELEMENTS]]
        return shown + ([_more(len(value) - MAX_ELEMENTS)] if len(value) > MAX_ELEMENTS else [])


def read_out(
    code: SpecificationCode,
    variables: Mapping[str, Value],
    types: Mapping[str, Type],
    messages: MessageTypes,
    now: int,
) -> Readout:
    """Return the variables that all slices share, at the time `now` (ns of the monitors' clock)."""
    own = code.slicing.own if code.slicing is not None else ()
    shared = {name: each for name, each in code.variables.items() if each not in own}
    reader, values, ages = _Reader(messages), dict[str, object](), dict[str, float | None]()
    for name, each in shared.items():
        if name.startswith(_AGE):
            last = variables[each]
            assert isinstance(last, int)  # noqa: S101  it is a time
            ages[name.removeprefix(_AGE).removesuffix(")")] = (now - last) / 1e9 if 0 <= last <= now else None
            continue
        try:
            values[name] = reader.value(types[each], variables[each])
        except _FullError:
            values[name] = _CUT
    return Readout(values, ages)


def _more(count: int) -> str:
    return f"{_CUT} {count} more"
