"""Finds fields in the bytes of a message.

Offsets are worked out here as far as they are the same in every message; only what stands behind a string or an
array of variable length is computed when a message comes, once for all fields that need it.
"""

from rosmop.form import nodes
from rosmop.form.nodes import Spot
from rosmop.form.sites import Symbols
from rosmop.text import tree
from rosmop.text.errors import SpecificationError
from rosmop.types import value_types
from rosmop.types.messages import Messages, UnknownNameError
from rosmop.types.value_types import Type
from roswire.message_layout import ArrayPart, FixedPart, Layout, Leaf, Part, StringPart

_PARTS_OF_TIME = {"sec": 0, "nsec": 4}


def type_of_path(messages: Messages, record: str, path: tuple[tree.PathStep, ...]) -> Type:
    """The type of the field at a path; refuses a path that does not fit, with the nearest that does."""
    kind: Type = value_types.Record(record)
    for step in path:
        kind = _step(messages, kind, step)
        if step.index is not None:
            if not isinstance(kind, value_types.Vector):
                raise SpecificationError.at(
                    step.position, f"`{step.name}` is {kind}, no array; leave out the index"
                )
            if kind.length is not None and step.index >= kind.length:
                raise SpecificationError.at(
                    step.position, f"`{step.name}` has {kind.length} elements; {step.index} is past the end"
                )
            kind = kind.element
    return kind


def _step(messages: Messages, kind: Type, step: tree.PathStep) -> Type:
    if isinstance(kind, value_types.Record):
        try:
            return messages.slot(kind.name, step.name).type
        except UnknownNameError as error:
            raise SpecificationError.at(step.position, str(error)) from None
    if isinstance(kind, value_types.Time | value_types.Duration) and step.name in _PARTS_OF_TIME:
        return value_types.UINT if isinstance(kind, value_types.Time) else value_types.INT
    hint = "; write an index first: `[0]`" if isinstance(kind, value_types.Vector) else ""
    raise SpecificationError.at(step.position, f"{kind} has no field `{step.name}`{hint}")


class Walk:
    """A message (or an element of an array) being walked through: where its parts begin, as far as is known."""

    def __init__(self, locator: "Locator", layout: Layout, start: Spot) -> None:
        self._locator = locator
        self._layout = layout
        self._starts = [start]
        self._elements: dict[tuple[int, int], Walk | Spot] = {}

    def start_of(self, part: int) -> Spot:
        """Where a part begins; writes what finds the parts before it."""
        while len(self._starts) <= part:
            index = len(self._starts) - 1
            self._starts.append(self._locator.behind(self._layout.parts[index], self._starts[index]))
        return self._starts[part]

    def end(self) -> Spot:
        """Where the message ends."""
        return self.start_of(len(self._layout.parts))

    def find(self, path: tuple[tree.PathStep, ...]) -> Spot | None:
        """Where a field begins; None for a message without fields. Writes the checks of indexes."""
        names = []
        for position, step in enumerate(path):
            names.append(step.name)
            place = self._layout.places.get(".".join(names))
            if place is None:
                continue
            start = self.start_of(place.part)
            if isinstance(place.item, Leaf):
                start = start.plus(place.item.offset)
            rest = path[position + 1 :]
            if step.index is None:
                return start.plus(_PARTS_OF_TIME[rest[0].name]) if rest else start
            return self._element(place.part, place.item, start, step, rest)
        return self._first(".".join(names) + ".")

    def _first(self, prefix: str) -> Spot | None:
        """Where a nested message begins: where its first field does."""
        for name, place in self._layout.places.items():
            if name.startswith(prefix):
                start = self.start_of(place.part)
                return start.plus(place.item.offset) if isinstance(place.item, Leaf) else start
        return None

    def _element(
        self,
        part: int,
        item: Leaf | StringPart | ArrayPart,
        start: Spot,
        step: tree.PathStep,
        rest: tuple[tree.PathStep, ...],
    ) -> Spot | None:
        assert isinstance(item, Leaf | ArrayPart)  # the types say that it is an array
        index = step.index or 0
        key = (part * 1_000_000 + start.offset, index)
        if key not in self._elements:
            spot = self._locator.element(item, start, step)
            self._elements[key] = spot if item.layout is None else Walk(self._locator, item.layout, spot)
        found = self._elements[key]
        if isinstance(found, Spot):
            return found.plus(_PARTS_OF_TIME[rest[0].name]) if rest else found
        return found.find(rest) if rest else found.start_of(0)


class Locator:
    """Writes the statements that find fields into `found`; `inner`: for an element that is skipped."""

    def __init__(
        self, symbols: Symbols, found: list[nodes.Statement], site: int, *, inner: bool = False
    ) -> None:
        self._symbols = symbols
        self._found = found
        self._site = site
        self._inner = inner
        self._skippers: dict[int, nodes.Skipper] = {}

    def behind(self, part: Part, start: Spot) -> Spot:
        """Where a part that begins at `start` ends."""
        if isinstance(part, FixedPart):
            return start.plus(part.size)
        end = self._symbols.fresh("p")
        if isinstance(part, StringPart):
            self._found.append(nodes.AfterText(self._site, end, start))
            return Spot(end, 0)
        count: str | int
        if part.count is None:
            count = self._count(start, part)
            start = start.plus(4)
        else:
            count = part.count
        if part.element_size is not None:
            self._found.append(nodes.AfterElements(self._site, end, start, count, part.element_size))
        else:
            self._skip(end, start, count, part)
        return Spot(end, 0)

    def element(self, item: Leaf | ArrayPart, start: Spot, step: tree.PathStep) -> Spot:
        """Where an element of an array begins; the event does not happen if there is none."""
        index = step.index or 0
        if isinstance(item, Leaf):
            return start.plus(index * (item.size // (item.count or 1)))
        if item.count is None:
            self._found.append(nodes.NotPast(self._site, self._count(start, item), index))
            start = start.plus(4)
        if item.element_size is not None:
            return start.plus(index * item.element_size)
        if not index:
            return start
        end = self._symbols.fresh("p")
        self._skip(end, start, index, item)
        return Spot(end, 0)

    def _count(self, start: Spot, item: ArrayPart) -> str:
        least = item.element_size
        if least is None:
            least = item.layout.minimum if item.layout is not None else 4
        count = self._symbols.fresh("q")
        self._found.append(nodes.Count(self._site, count, start, least))
        return count

    def _skip(self, name: str, start: Spot, count: str | int, item: Leaf | ArrayPart) -> None:
        skipper = None if item.layout is None else self._skipper(item.layout)
        self._found.append(nodes.Skip(self._site, name, start, count, skipper, self._inner))

    def _skipper(self, layout: Layout) -> nodes.Skipper:
        if id(layout) not in self._skippers:
            inner: list[nodes.Statement] = []
            name = self._symbols.fresh("k")
            end = Walk(Locator(self._symbols, inner, -1, inner=True), layout, Spot("p", 0)).end()
            self._skippers[id(layout)] = nodes.Skipper(name, tuple(inner), end)
        return self._skippers[id(layout)]
