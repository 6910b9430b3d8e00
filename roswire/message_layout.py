"""The positions of fields in the bytes of a message, for reading a few fields without decoding the rest.

A layout flattens nested messages. Consecutive fields of fixed size form one `FixedPart`. Two such parts are never
adjacent, so everything before the first string or array has the same offset in every message.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from roswire.message_text import PRIMITIVES

MAX_ITEMS = 20_000
"""The limit of leaves, strings and arrays in a layout. Nested definitions can multiply exponentially."""

MAX_CHARACTERS = 1 << 20
"""The limit of characters in the paths of a layout and of the layouts in it, each of which copies the paths below."""

MAX_SIZE = 1 << 32
"""The limit of bytes in a fixed part or a fixed array: a TCPROS message is never longer."""


@dataclass(frozen=True, slots=True)
class FixedField:
    """A field of fixed size. `offset` and `size` are in bytes; `count` is None for a scalar.

    `type` is a primitive type. In an array, it may also be a message of fixed size with a `layout`.
    """

    path: str
    type: str
    offset: int
    size: int
    count: int | None = None
    layout: "MessageLayout | None" = None


@dataclass(frozen=True, slots=True)
class FixedPart:
    """Consecutive fields of fixed size, together `size` bytes."""

    size: int
    leaves: tuple[FixedField, ...]


@dataclass(frozen=True, slots=True)
class StringPart:
    """A string: 4 bytes for the length, then the bytes."""

    path: str


@dataclass(frozen=True, slots=True)
class ArrayPart:
    """An array of variable length, or of elements of variable size.

    `count` is the length of a fixed array. If it is None, the length (4 bytes) precedes the elements. `element_size`
    is in bytes, or None if it varies.
    """

    path: str
    type: str
    count: int | None
    element_size: int | None
    layout: "MessageLayout | None" = None


Part = FixedPart | StringPart | ArrayPart


@dataclass(frozen=True, slots=True)
class FieldLocation:
    """A field, and the index of the part that contains it."""

    part: int
    item: FixedField | StringPart | ArrayPart


@dataclass(frozen=True, slots=True)
class MessageLayout:
    """The layout of a message. `size` is None if it varies; `minimum` is the size of the shortest message.

    `places` finds items by path (`pose.position.x`). Elements of an array are in the layout of the array.
    `characters` is the length of all paths, limited by `MAX_CHARACTERS`.
    """

    parts: tuple[Part, ...]
    size: int | None
    minimum: int
    places: Mapping[str, FieldLocation] = field(repr=False, compare=False)
    characters: int = field(default=0, repr=False, compare=False)


class LayoutTooLargeError(Exception):
    """The layout would have more items, characters or bytes than the limits allow."""


class LayoutBuilder:
    """Builds a layout from the fields of a message in order. The methods raise `LayoutTooLargeError`."""

    def __init__(self) -> None:
        self._parts: list[Part] = []
        self._leaves: list[FixedField] = []  # the leaves of the open fixed part
        self._offset = 0
        self._items = 0
        self._characters = 0

    def add_primitive(self, path: str, type_name: str, count: int | None) -> None:
        """Add a scalar, or with `count` an array of fixed length."""
        size = PRIMITIVES[type_name][1] * (1 if count is None else count)
        self._add_leaf(FixedField(path, type_name, self._offset, size, count))

    def add_string(self, path: str) -> None:
        self._add_part(StringPart(path))

    def add_array(self, path: str, type_name: str, count: int | None, layout: MessageLayout | None) -> None:
        size = PRIMITIVES[type_name][1] if type_name in PRIMITIVES else None
        if layout is not None:
            size = layout.size
            self._charge(layout.characters)
        if count is not None and size is not None:
            self._add_leaf(FixedField(path, type_name, self._offset, size * count, count, layout))
        else:
            self._add_part(ArrayPart(path, type_name, count, size, layout))

    def add_message(self, path: str, layout: MessageLayout) -> None:
        self._charge(layout.characters)
        for part in layout.parts:
            if isinstance(part, FixedPart):
                for leaf in part.leaves:
                    self._add_leaf(replace(leaf, path=f"{path}.{leaf.path}", offset=self._offset))
            else:
                self._add_part(replace(part, path=f"{path}.{part.path}"))

    def finish(self) -> MessageLayout:
        self._close()
        places: dict[str, FieldLocation] = {}
        for index, part in enumerate(self._parts):
            for item in part.leaves if isinstance(part, FixedPart) else (part,):
                places[item.path] = FieldLocation(index, item)
        minimum = sum(map(_minimum, self._parts))
        fixed = all(isinstance(part, FixedPart) for part in self._parts)
        size = minimum if fixed else None
        return MessageLayout(tuple(self._parts), size, minimum, places, self._characters)

    def _add_leaf(self, leaf: FixedField) -> None:
        self._count(leaf.path)
        self._leaves.append(leaf)
        self._offset += leaf.size
        if self._offset > MAX_SIZE:
            raise LayoutTooLargeError(f"more than {MAX_SIZE} bytes")

    def _add_part(self, part: StringPart | ArrayPart) -> None:
        self._count(part.path)
        self._close()
        self._parts.append(part)
        if _minimum(part) > MAX_SIZE:
            raise LayoutTooLargeError(f"more than {MAX_SIZE} bytes")

    def _count(self, path: str) -> None:
        self._items += 1
        if self._items > MAX_ITEMS:
            raise LayoutTooLargeError(f"more than {MAX_ITEMS} fields, those of nested messages included")
        self._charge(len(path))

    def _charge(self, characters: int) -> None:
        self._characters += characters
        if self._characters > MAX_CHARACTERS:
            raise LayoutTooLargeError(
                f"the names of its fields, with those of nested messages, have more than {MAX_CHARACTERS} characters"
            )

    def _close(self) -> None:
        if self._leaves:
            self._parts.append(FixedPart(self._offset, tuple(self._leaves)))
            self._leaves = []
            self._offset = 0


def _minimum(part: Part) -> int:
    if isinstance(part, FixedPart):
        return part.size
    if isinstance(part, StringPart) or part.count is None:
        return 4
    return part.count * (part.layout.minimum if part.layout is not None else 4)
