"""Finds fields in the bytes of a message, as code.

Offsets are worked out here as far as they are the same in every message; only what stands behind a string or an
array of variable length is computed when a message comes, once for all fields that need it.
"""

from appliance.ros.layout import ArrayPart, FixedPart, Layout, Leaf, Part, StringPart
from appliance.rosmop.compile.codecs import Codecs
from appliance.rosmop.compile.module import Lines, Module
from appliance.rosmop.syntax import tree
from appliance.rosmop.syntax.errors import SpecificationError
from appliance.rosmop.types import kinds
from appliance.rosmop.types.kinds import Type
from appliance.rosmop.types.messages import Messages, UnknownNameError

_PARTS_OF_TIME = {"sec": 0, "nsec": 4}


def type_of_path(messages: Messages, record: str, path: tuple[tree.PathStep, ...]) -> Type:
    """The type of the field at a path; refuses a path that does not fit, with the nearest that does."""
    kind: Type = kinds.Record(record)
    for step in path:
        kind = _step(messages, kind, step)
        if step.index is not None:
            if not isinstance(kind, kinds.Vector):
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
    if isinstance(kind, kinds.Record):
        try:
            return messages.slot(kind.name, step.name).type
        except UnknownNameError as error:
            raise SpecificationError.at(step.position, str(error)) from None
    if isinstance(kind, kinds.Time | kinds.Duration) and step.name in _PARTS_OF_TIME:
        return kinds.UINT if isinstance(kind, kinds.Time) else kinds.INT
    hint = "; write an index first: `[0]`" if isinstance(kind, kinds.Vector) else ""
    raise SpecificationError.at(step.position, f"{kind} has no field `{step.name}`{hint}")


class Spot:
    """A place in the bytes: a variable of the code (or none) and a distance from it."""

    def __init__(self, base: str | None, offset: int) -> None:
        self.base = base
        self.offset = offset

    def plus(self, more: int) -> "Spot":
        """So many bytes further."""
        return Spot(self.base, self.offset + more)

    @property
    def code(self) -> str:
        """As an expression."""
        if self.base is None:
            return str(self.offset)
        return f"{self.base} + {self.offset}" if self.offset else self.base


class Walk:
    """A message (or an element of an array) being walked through: where its parts begin, as far as is known."""

    def __init__(self, locator: "Locator", layout: Layout, start: Spot) -> None:
        self._locator = locator
        self._layout = layout
        self._starts = [start]
        self._elements: dict[tuple[int, int], Walk | Spot] = {}

    def start_of(self, part: int) -> Spot:
        """Where a part begins; writes the code for what stands before it."""
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
    """Writes the code that finds fields; `lines` are those of the function, `context` the name of who is charged.

    `inner`: the function says where an element ends, and is called for each.
    """

    def __init__(
        self, module: Module, codecs: Codecs, lines: Lines, context: str, *, inner: bool = False
    ) -> None:
        self._module = module
        self._codecs = codecs
        self.lines = lines
        self._context = context
        self._skip = "w_skip_inner" if inner else "w_skip"
        self._skippers: dict[int, str] = {}

    def behind(self, part: Part, start: Spot) -> Spot:
        """Where a part that begins at `start` ends."""
        if isinstance(part, FixedPart):
            return start.plus(part.size)
        length = self._module.struct("<I", "unpack_from")
        end = self._module.fresh("p")
        if isinstance(part, StringPart):
            self.lines.add(f"{end} = {start.plus(4).code} + {length}(b, {start.code})[0]")
            return Spot(end, 0)
        count = str(part.count)
        if part.count is None:
            least = self._least(part)
            count = self._module.fresh("q")
            self.lines.add(f"{count} = w_count(b, {start.code}, {least})")
            start = start.plus(4)
        if part.element_size is not None:
            self.lines.add(f"{end} = {start.code} + {count} * {part.element_size}")
        else:
            self.lines.add(self._skipped(end, start, count, part))
        return Spot(end, 0)

    def element(self, item: Leaf | ArrayPart, start: Spot, step: tree.PathStep) -> Spot:
        """Where an element of an array begins; the event does not happen if there is none."""
        index = step.index or 0
        if isinstance(item, Leaf):
            return start.plus(index * (item.size // (item.count or 1)))
        if item.count is None:
            count = self._module.fresh("q")
            self.lines.add(f"{count} = w_count(b, {start.code}, {self._least(item)})")
            self.lines.add(f"if {count} <= {index}:")
            self.lines.add(f"    m.past = ({self.lines.site}, {index}, {count})")
            self.lines.add("    return False")
            start = start.plus(4)
        if item.element_size is not None:
            return start.plus(index * item.element_size)
        if not index:
            return start
        spot = self._module.fresh("p")
        self.lines.add(self._skipped(spot, start, str(index), item))
        return Spot(spot, 0)

    def _skipped(self, target: str, start: Spot, count: str, item: Leaf | ArrayPart) -> str:
        return f"{target} = {self._skip}(b, {start.code}, {count}, {self.skipper(item)}, {self._context})"

    def skipper(self, item: Leaf | ArrayPart) -> str:
        """The name of the function that says where an element ends."""
        if item.layout is None:
            return "w_text_end"
        key = id(item.layout)
        if key not in self._skippers:
            inner = Lines()
            name = self._module.fresh("k")
            locator = Locator(self._module, self._codecs, inner, self._context, inner=True)
            end = Walk(locator, item.layout, Spot("p", 0)).end()
            self._module.add([(f"def {name}(b, p):", -1), *inner.lines, (f"    return {end.code}", -1)])
            self._skippers[key] = name
        return self._skippers[key]

    def _least(self, item: ArrayPart) -> int:
        if item.element_size is not None:
            return item.element_size
        return item.layout.minimum if item.layout is not None else 4
