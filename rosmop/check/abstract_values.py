"""Abstract values and the states of paths: the lattices of the flow analysis.

A value is known, or unknown; it notes the places where NaN decided it, and the inputs on which it depends. An unknown
number may be NaN.
"""

import math
from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from rosmop.types import value_types
from rosmop.types.value_types import Type

NAN = math.nan  # this one object, so that values with it are equal
UNKNOWN = object()
LIVE, SENT, DROPPED, REPLACED = "live", "sent", "dropped", "replaced"
"""The fate of a message: it passes, passes while safe messages of other topics are sent, or does not pass."""
PASSES = (LIVE, SENT)
COMPARISON, TEST, CAST, CALL = "comparison", "test", "cast", "call"
ANY = "*"
"""The index of every element of a vector."""

Place = tuple[str, int]
"""Where NaN decided something: the kind (or the name of a function such as `min`), and the site."""
Places = frozenset[Place]
Path = tuple[int | str, ...]
EMPTY: frozenset[Any] = frozenset()


class AbstractValue(NamedTuple):
    """An abstract value; `known` is a number, NaN, a `AbstractParts`, the parts of a result, or `UNKNOWN`.

    NaN decided it at the places in `why`. If it is an unknown truth, NaN took a reason away to be true (`less_true`)
    or to be false (`less_false`). It depends on `inputs`: shared variables, and the fields whose
    numbers it carries.
    """

    known: Any = UNKNOWN
    why: Places = EMPTY
    less_true: Places = EMPTY
    less_false: Places = EMPTY
    may_be_nan: bool = False
    inputs: frozenset[str] = EMPTY

    @property
    def is_nan(self) -> bool:
        return self.known is NAN

    @property
    def is_number(self) -> bool:
        return isinstance(self.known, bool | int | float)

    @property
    def is_constant(self) -> bool:
        return isinstance(self.known, bool | int | float | bytes)

    def part(self, number: int | str, kind: Type) -> "AbstractValue":
        if isinstance(self.known, tuple):
            return self.known[number] if isinstance(number, int) else AbstractValue(inputs=self.inputs)
        if not isinstance(self.known, AbstractParts):
            return AbstractValue(inputs=self.inputs)
        return self.known.part(number, kind, self.inputs)


ANYTHING = AbstractValue()


@dataclass(frozen=True)
class AbstractParts:
    """A message or a vector: its known parts by path, and the value of all other numbers."""

    parts: Mapping[Path, AbstractValue] = field(default_factory=dict)
    others: AbstractValue = ANYTHING

    def part(self, number: int | str, kind: Type, inputs: frozenset[str]) -> AbstractValue:
        if value_types.is_number(kind):
            found = self.parts.get((number,)) or self.parts.get((ANY,)) or self.others
            return found._replace(inputs=found.inputs | inputs)
        inner = {path[1:]: value for path, value in self.parts.items() if path[0] == ANY and len(path) > 1}
        inner |= {
            path[1:]: value for path, value in self.parts.items() if path[0] == number and len(path) > 1
        }
        return AbstractValue(AbstractParts(inner, self.others), inputs=inputs)

    def with_part(self, path: Path, value: AbstractValue) -> "AbstractParts":
        size = len(path)
        parts = {known: part for known, part in self.parts.items() if known[:size] != path}
        if isinstance(value.known, AbstractParts):
            parts |= {(*path, *inner): part for inner, part in value.known.parts.items()}
        else:
            parts[path] = value
        return AbstractParts(parts, self.others)


@dataclass(eq=False, slots=True)
class PathState:
    """The state on a path: variables, the places where NaN skipped a restriction, and what is true of the message."""

    values: dict[str, AbstractValue] = field(default_factory=dict)
    skipped: Places = EMPTY
    control: Places = EMPTY
    """The places where NaN decided that this path is taken."""
    inputs: frozenset[str] = EMPTY
    """The inputs on which it depends that this path is taken."""
    fate: str = LIVE
    spoke: bool = False
    """Something may have been printed or published."""
    written: frozenset[int] = EMPTY
    """The sites that assigned a field."""
    result: AbstractValue = ANYTHING

    def branch(self) -> "PathState":
        return PathState(
            dict(self.values), self.skipped, self.control, self.inputs, self.fate, self.spoke, self.written,
            self.result,
        )  # fmt: skip

    def set(self, name: str, value: AbstractValue) -> None:
        if self.control and value.is_constant:
            value = value._replace(why=value.why | self.control)
        if isinstance(value.known, float) and value.known == 0:  # a robot at rest
            value = value._replace(why=EMPTY)
        self.values[name] = value._replace(inputs=value.inputs | self.inputs)


def join(one: AbstractValue | None, other: AbstractValue | None) -> AbstractValue:
    if one is None or other is None or one == other:
        return one if one is not None else other if other is not None else AbstractValue()
    inputs = one.inputs | other.inputs
    if one.known is other.known or (one.is_constant and other.is_constant and _same(one.known, other.known)):
        return AbstractValue(
            one.known, one.why | other.why, one.less_true | other.less_true,
            one.less_false | other.less_false, one.may_be_nan or other.may_be_nan, inputs,
        )  # fmt: skip
    if isinstance(one.known, AbstractParts) and isinstance(other.known, AbstractParts):
        paths = {*one.known.parts, *other.known.parts}
        parts = {
            path: join(
                one.known.parts.get(path, one.known.others), other.known.parts.get(path, other.known.others)
            )
            for path in paths
        }
        return AbstractValue(AbstractParts(parts, join(one.known.others, other.known.others)), inputs=inputs)
    true, false = EMPTY, EMPTY
    for value in (one, other):
        true |= value.less_true | (value.why if value.known is False else EMPTY)
        false |= value.less_false | (value.why if value.known is True else EMPTY)
    nan = any(value.is_nan or value.may_be_nan for value in (one, other))
    why = one.why | other.why if nan or one.known is UNKNOWN or other.known is UNKNOWN else EMPTY
    return AbstractValue(UNKNOWN, why, true, false, nan, inputs)


def _same(one: object, other: object) -> bool:
    return type(one) is type(other) and one == other


def merge(states: Iterable[PathState]) -> PathState:
    first, *rest = states
    made = first.branch()
    for state in rest:
        for name in made.values.keys() - state.values.keys():
            made.values[name] = join(made.values[name], unset(name))
        for name, theirs in state.values.items():
            ours = made.values.get(name)
            if ours is not theirs:
                made.values[name] = join(unset(name) if ours is None else ours, theirs)
        made.skipped |= state.skipped
        made.control |= state.control
        made.inputs |= state.inputs
        made.written |= state.written
        made.spoke = made.spoke or state.spoke
        made.result = join(made.result, state.result)
    return made


def unset(name: str) -> AbstractValue:
    return AbstractValue(inputs=frozenset({name})) if is_shared(name) else ANYTHING


def key_of(value: AbstractValue | None) -> Hashable:
    """Return a key that distinguishes values also by the types of their numbers."""
    if value is None:
        return None
    known = value.known
    if isinstance(known, AbstractParts):
        parts = frozenset((path, key_of(part)) for path, part in known.parts.items())
        return (parts, key_of(known.others), *value[1:])
    if isinstance(known, tuple):
        known = tuple(map(key_of, known))
    return (type(known), known, *value[1:])


def is_tainted(value: AbstractValue) -> bool:
    """Whether it is NaN, or NaN decided it."""
    if isinstance(value.known, AbstractParts):
        return any(map(is_tainted, (*value.known.parts.values(), value.known.others)))
    return bool(value.is_nan or value.may_be_nan or value.why or value.less_true or value.less_false)


def why_of(values: Iterable[AbstractValue]) -> Places:
    return frozenset[Place]().union(*(value.why for value in values))


def shared_of(inputs: frozenset[str]) -> frozenset[str]:
    """Return the shared variables among the inputs: a truth depends on them, and carries no number of a field."""
    return frozenset(filter(is_shared, inputs)) if inputs else inputs


def is_shared(name: str) -> bool:
    return name.startswith("g")


def of_number(known: Any, why: Places = EMPTY, inputs: frozenset[str] = EMPTY) -> AbstractValue:
    return AbstractValue(NAN if known != known else known, why, inputs=inputs)  # noqa: PLR0124  NaN


def of_compared(value: AbstractValue) -> Places:
    """Return the places that decided a number; a 0 that a comparison decided is a robot at rest, or no distance."""
    if isinstance(value.known, float) and value.known == 0:
        return frozenset(place for place in value.why if place[0] != COMPARISON)
    return value.why


def negate(value: AbstractValue) -> AbstractValue:
    known = value.known if value.known is UNKNOWN else not value.known
    return value._replace(known=known, less_true=value.less_false, less_false=value.less_true)
