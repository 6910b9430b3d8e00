"""Find fields in the bytes of a message.

Offsets that are the same in every message are computed here; positions after a string or an array of variable length
once for each message.
"""

from rosmop.form import nodes
from rosmop.form.findings import SpecificationError
from rosmop.form.nodes import Spot
from rosmop.form.sites import Symbols
from rosmop.text import tree
from rosmop.types import value_types
from rosmop.types.messages import MessageTypes, UnknownNameError
from rosmop.types.value_types import Type
from roswire.counted import counted
from roswire.message_layout import ArrayPart, FixedField, FixedPart, MessageLayout, Part, StringPart

_PARTS_OF_TIME = {"sec": 0, "nsec": 4}


def type_of_path(messages: MessageTypes, record: str, path: tuple[tree.PathStep, ...]) -> Type:
    kind: Type = value_types.RecordType(record)
    for step in path:
        kind = _step(messages, kind, step)
        if step.index is not None:
            if not isinstance(kind, value_types.VectorType):
                raise SpecificationError.at(
                    step.position, f"`{step.name}` is {kind}, not an array; leave out the index"
                )
            if kind.length is not None and step.index >= kind.length:
                raise SpecificationError.at(
                    step.position,
                    f"`{step.name}` has {counted(kind.length, 'element')}; {step.index} is past the end",
                )
            kind = kind.element
    return kind


def _step(messages: MessageTypes, kind: Type, step: tree.PathStep) -> Type:
    if isinstance(kind, value_types.RecordType):
        try:
            return messages.slot(kind.name, step.name).type
        except UnknownNameError as error:
            raise SpecificationError.at(step.position, str(error)) from None
    if isinstance(kind, value_types.TimeType | value_types.DurationType) and step.name in _PARTS_OF_TIME:
        return value_types.UINT if isinstance(kind, value_types.TimeType) else value_types.INT
    hint = "; write an index first: `[0]`" if isinstance(kind, value_types.VectorType) else ""
    raise SpecificationError.at(step.position, f"{kind} has no field `{step.name}`{hint}")


class MessageCursor:
    """A position in a message or an array element, with the known start positions of its parts."""

    def __init__(self, locator: "FieldLocator", layout: MessageLayout, start: Spot) -> None:
        self._locator = locator
        self._layout = layout
        self._starts = [start]
        self._elements: dict[tuple[Spot, int], MessageCursor | Spot] = {}

    def start_of(self, part: int) -> Spot:
        while len(self._starts) <= part:
            index = len(self._starts) - 1
            self._starts.append(self._locator.behind(self._layout.parts[index], self._starts[index]))
        return self._starts[part]

    def end(self) -> Spot:
        return self.start_of(len(self._layout.parts))

    def find(self, path: tuple[tree.PathStep, ...]) -> Spot | None:
        """Return the position of a path, after writing the checks of indices, or None if there are no fields."""
        names = []
        for position, step in enumerate(path):
            names.append(step.name)
            place = self._layout.places.get(".".join(names))
            if place is None:
                continue
            start = self.start_of(place.part)
            if isinstance(place.item, FixedField):
                start = start.plus(place.item.offset)
            rest = path[position + 1 :]
            if step.index is None:
                return start.plus(_PARTS_OF_TIME[rest[0].name]) if rest else start
            return self._element(place.item, start, step, rest)
        return self._first(".".join(names) + ".")

    def _first(self, prefix: str) -> Spot | None:
        for name, place in self._layout.places.items():
            if name.startswith(prefix):
                start = self.start_of(place.part)
                return start.plus(place.item.offset) if isinstance(place.item, FixedField) else start
        return None

    def _element(
        self,
        item: FixedField | StringPart | ArrayPart,
        start: Spot,
        step: tree.PathStep,
        rest: tuple[tree.PathStep, ...],
    ) -> Spot | None:
        assert isinstance(item, FixedField | ArrayPart)  # its type is an array here
        index = step.index or 0
        key = start, index
        if key not in self._elements:
            spot = self._locator.element(item, start, step)
            self._elements[key] = (
                spot if item.layout is None else MessageCursor(self._locator, item.layout, spot)
            )
        found = self._elements[key]
        if isinstance(found, Spot):
            return found.plus(_PARTS_OF_TIME[rest[0].name]) if rest else found
        return found.find(rest) if rest else found.start_of(0)


class FieldLocator:
    """Writes the statements that find fields to `found`; `inner` is for a skipped element."""

    def __init__(
        self, symbols: Symbols, statements: list[nodes.Statement], site: int, *, inner: bool = False
    ) -> None:
        self._symbols = symbols
        self._found = statements
        self._site = site
        self._inner = inner
        self._skippers: dict[int, nodes.Skipper] = {}

    def behind(self, part: Part, start: Spot) -> Spot:
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

    def element(self, item: FixedField | ArrayPart, start: Spot, step: tree.PathStep) -> Spot:
        """Return the position of an element, with a check that the array has it: otherwise the event does not occur."""
        index = step.index or 0
        if isinstance(item, FixedField):
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

    def _skip(self, name: str, start: Spot, count: str | int, item: FixedField | ArrayPart) -> None:
        skipper = None if item.layout is None else self._skipper(item.layout)
        self._found.append(nodes.Skip(self._site, name, start, count, skipper, self._inner))

    def _skipper(self, layout: MessageLayout) -> nodes.Skipper:
        if id(layout) not in self._skippers:
            inner: list[nodes.Statement] = []
            name = self._symbols.fresh("k")
            end = MessageCursor(
                FieldLocator(self._symbols, inner, -1, inner=True), layout, Spot("p", 0)
            ).end()
            self._skippers[id(layout)] = nodes.Skipper(name, tuple(inner), end)
        return self._skippers[id(layout)]
