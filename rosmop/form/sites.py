"""Places in the text of specifications, by which faults and decisions are told, and how values are shown there."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rosmop.form.positions import Position
from rosmop.types import value_types
from rosmop.types.value_types import Type


@dataclass(frozen=True, slots=True)
class SiteVariable:
    """A variable by its name in the text and in the form. `steady`: a value of it never changes in place."""

    name: str
    code: str
    type: Type
    steady: bool


@dataclass(frozen=True, slots=True)
class Site:
    """A place in the text that statements belong to, and the variables whose values explain a fault there."""

    position: Position
    variables: tuple[SiteVariable, ...] = ()

    @property
    def compared(self) -> list[SiteVariable]:
        """The variables of a condition that are told when it was met: they are still what they were then."""
        return [variable for variable in self.variables if variable.steady]


class Symbols:
    """The names that are made for the variables and functions of a set while it is compiled, and its sites.

    The names of a specification are the same whatever else is in the set.
    """

    def __init__(self) -> None:
        self.sites: list[Site] = []
        self._names: Counter[str] = Counter()
        self._owner = ""

    def begin(self, specification: str) -> None:
        """The names that follow are of this specification."""
        self._owner = specification

    def fresh(self, prefix: str) -> str:
        """A name that nothing else has."""
        self._names[self._owner] += 1
        return f"{prefix}{self._names[self._owner]} {self._owner}"

    @staticmethod
    def owner(name: str) -> str:
        """The specification that a name was made for."""
        return name.partition(" ")[2]

    def site(self, site: Site) -> int:
        """The number of a site."""
        self.sites.append(site)
        return len(self.sites) - 1


def showing(kind: Type) -> Callable[[Any], object]:
    """How a value of a type is shown where a fault is told: something JSON has."""
    if isinstance(kind, value_types.String | value_types.Characters):
        return lambda value: _short(value[:200].split(b"\0")[0].decode("utf-8", "replace"))
    if isinstance(kind, value_types.Time | value_types.Duration):
        return lambda value: value / 1e9
    if isinstance(kind, value_types.Vector):
        inner = showing(kind.element)
        return lambda values: [inner(value) for value in values[:8]] + ["…"] * (len(values) > 8)
    if isinstance(kind, value_types.Floating):
        return lambda value: value if value - value == 0 else str(value)
    if isinstance(kind, value_types.Record):
        return lambda value: _short(str(value)[:200])
    return lambda value: value


def _short(text: str) -> str:
    return text if len(text) <= 80 else text[:79] + "…"
