"""Variables, values of expressions, and the places that can be assigned."""

from dataclasses import dataclass

from rosmop.form.findings import Position
from rosmop.form.nodes import Expression, acts
from rosmop.types.value_types import Type


@dataclass(eq=False)
class Variable:
    """A variable: its names in the text and in the code."""

    name: str
    type: Type
    code: str
    position: Position
    shared: bool = False
    """Whether it belongs to the set, and not to one function."""
    constant: bool = False
    known: bool | int | float | None = None
    table: bytes | None = None
    """The elements of a `const` array of numbers that are known, as in a message."""
    flag: str | None = None
    """The code's name for "was assigned"; only for parameters that are bound to fields."""
    alias: "Value | None" = None
    """The value that a reference refers to."""
    copied: bool = False
    """Whether a `char *` or `T name[]` holds a copy of another array, where C++ would point to it."""
    used: bool = False
    assigned: bool = False
    sliced: bool = False


@dataclass(frozen=True)
class Value:
    """A compiled expression: its form, and the facts known about it."""

    form: Expression
    position: Position
    place: "Lvalue | None" = None
    """Set if the value can be assigned."""
    owned: bool = True
    """Whether nothing else refers to the value, so that it needs no copy."""
    constant: bool | int | float | bytes | None = None
    """The value, if it is known at compile time."""
    first: tuple[Expression, ...] = ()
    """The expressions at the start of the form that are evaluated before the place is known."""
    vector: "Value | None" = None
    """For an iterator, the vector that it points into."""

    @property
    def pure(self) -> bool:
        return not acts(self.form)

    @property
    def type(self) -> Type:
        return self.form.type


@dataclass(frozen=True)
class Lvalue:
    """A place that can be assigned."""


@dataclass(frozen=True)
class VariableLvalue(Lvalue):
    variable: Variable


@dataclass(frozen=True)
class ElementLvalue(Lvalue):
    base: Value
    index: Expression
    site: int


@dataclass(frozen=True)
class CharacterLvalue(Lvalue):
    base: Value
    index: Expression
    site: int


@dataclass(frozen=True)
class FieldLvalue(Lvalue):
    base: Value
    slot: int


@dataclass(frozen=True)
class TimePartLvalue(Lvalue):
    """`sec` or `nsec` of a time or duration."""

    base: Value
    part: str
    site: int


def path(value: Value) -> tuple[object, ...]:
    place = value.place
    if isinstance(place, VariableLvalue):
        alias = place.variable.alias
        return (place.variable.name,) if alias is None else path(alias)
    if isinstance(place, ElementLvalue | CharacterLvalue):
        return (*path(place.base), place.index)
    if isinstance(place, FieldLvalue):
        return (*path(place.base), place.slot)
    return (*path(place.base), place.part) if isinstance(place, TimePartLvalue) else ()


def root(value: Value) -> Variable | None:
    place = value.place
    while place is not None:
        if isinstance(place, VariableLvalue):
            variable = place.variable
            return root(variable.alias) if variable.alias is not None else variable
        place = place.base.place  # type: ignore[attr-defined]  # every other place has a base
    return None
