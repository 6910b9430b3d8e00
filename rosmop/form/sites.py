"""Sites: the positions that reports of faults and decisions name, with variables whose values explain them."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rosmop.form.findings import Position
from rosmop.types import value_types
from rosmop.types.value_types import Type


@dataclass(frozen=True, slots=True)
class SiteVariable:
    """A variable that a report shows; `code` is its name in the form.

    The value of a `steady` variable never changes in place.
    """

    name: str
    code: str
    type: Type
    steady: bool


@dataclass(frozen=True, slots=True)
class Site:
    """The position of statements, and the variables whose values explain a fault there."""

    position: Position
    variables: tuple[SiteVariable, ...] = ()

    @property
    def compared(self) -> list[SiteVariable]:
        return [variable for variable in self.variables if variable.steady]


class Symbols:
    """Makes names and sites; the names of a specification do not depend on the rest of the set."""

    def __init__(self) -> None:
        self.sites: list[Site] = []
        self._names: Counter[str] = Counter()
        self._owner = ""

    def begin(self, specification: str) -> None:
        self._owner = specification

    def fresh(self, prefix: str) -> str:
        self._names[self._owner] += 1
        return f"{prefix}{self._names[self._owner]} {self._owner}"

    @staticmethod
    def owner(name: str) -> str:
        return name.partition(" ")[2]

    def site(self, site: Site) -> int:
        self.sites.append(site)
        return len(self.sites) - 1


def showing(kind: Type) -> Callable[[Any], object]:
    if isinstance(kind, value_types.StringType | value_types.CharactersType):
        return lambda value: _short(value[:200].split(b"\0")[0].decode("utf-8", "replace"))
    if isinstance(kind, value_types.TimeType | value_types.DurationType):
        return lambda value: value / 1e9
    if isinstance(kind, value_types.VectorType):
        inner = showing(kind.element)
        return lambda values: [inner(value) for value in values[:8]] + ["…"] * (len(values) > 8)
    if isinstance(kind, value_types.FloatingType):
        return lambda value: value if value - value == 0 else str(value)
    if isinstance(kind, value_types.RecordType):
        return lambda value: _short(str(value)[:200])
    return lambda value: value


def _short(text: str) -> str:
    return text if len(text) <= 80 else text[:79] + "…"
