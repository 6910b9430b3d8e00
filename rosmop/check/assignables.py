"""Variables, values of expressions, and the places that can be assigned."""

from dataclasses import dataclass

from rosmop.form.nodes import Expression, acts
from rosmop.form.positions import Position
from rosmop.types.value_types import Type


@dataclass(eq=False)
class Variable:
    """A variable: its name in the text and in the code.

    `flag` is the code's name for "was assigned", for parameters that are bound to fields. `alias` is what a
    reference stands for. `shared` variables live in the namespace of the module.
    """

    name: str
    type: Type
    code: str
    position: Position
    shared: bool = False
    constant: bool = False
    known: bool | int | float | None = None
    """What a `const` number is, if it is written down."""
    flag: str | None = None
    alias: "Value | None" = None
    copied: bool = False
    """A `char *` or `T name[]` that holds a copy of another's elements, where C++'s would point to them."""
    used: bool = False
    assigned: bool = False
    sliced: bool = False
    """Each slice of a parametric specification has its own."""


@dataclass(frozen=True)
class Value:
    """An expression: its form, and what is known of it.

    `place` is where the value lives if it can be assigned. `owned` means that nothing else refers to it, so it
    needs no copy. `constant` is known without running. `first` is what the form begins with, before its place is known.
    Of an iterator, `vector` is what it is a place in.
    """

    form: Expression
    position: Position
    place: "Place | None" = None
    owned: bool = True
    constant: bool | int | float | bytes | None = None
    first: tuple[Expression, ...] = ()
    vector: "Value | None" = None

    @property
    def pure(self) -> bool:
        """Whether to compute it changes nothing."""
        return not acts(self.form)

    @property
    def type(self) -> Type:
        """What it is one of."""
        return self.form.type


@dataclass(frozen=True)
class Place:
    """Where a value lives."""


@dataclass(frozen=True)
class VariablePlace(Place):
    """A variable."""

    variable: Variable


@dataclass(frozen=True)
class ElementPlace(Place):
    """An element of a vector."""

    base: Value
    index: Expression
    site: int


@dataclass(frozen=True)
class CharacterPlace(Place):
    """A character of a string."""

    base: Value
    index: Expression
    site: int


@dataclass(frozen=True)
class SlotPlace(Place):
    """A field of a message."""

    base: Value
    slot: int


@dataclass(frozen=True)
class PartPlace(Place):
    """`sec` or `nsec` of a time or duration."""

    base: Value
    part: str
    site: int


def path(value: Value) -> tuple[object, ...]:
    """Where a value lives: the name of the variable, then elements and fields, down to it."""
    place = value.place
    if isinstance(place, VariablePlace):
        alias = place.variable.alias
        return (place.variable.name,) if alias is None else path(alias)
    if isinstance(place, ElementPlace | CharacterPlace):
        return (*path(place.base), place.index)
    if isinstance(place, SlotPlace):
        return (*path(place.base), place.slot)
    return (*path(place.base), place.part) if isinstance(place, PartPlace) else ()


def root(value: Value) -> Variable | None:
    """The variable that a place is part of."""
    place = value.place
    while place is not None:
        if isinstance(place, VariablePlace):
            variable = place.variable
            return root(variable.alias) if variable.alias is not None else variable
        place = place.base.place  # type: ignore[attr-defined]  # every other place has a base
    return None
