"""Where the fields of a message are, worked out from the code that finds them: what equal frames have in common.

Messages of one topic that are equally long mostly have strings and arrays of equal lengths, too (the `frame_id` of
a header does not change), so that every field stands at the same distance from the start of its frame. Then a batch
of them is read by one `struct.iter_unpack`, if each message is asked whether its lengths are those of the first.

A *spot* is a distance in bytes: a constant, and for each length before it the number that stands there, so many
bytes each. `Shape` gathers what the events on one topic read; with the lengths of a first message it becomes a
`Struct`.
"""

import ast
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field

from appliance.rosmop.ir.values import struct_size

_LENGTH = struct.Struct("<I")


class NoShapeError(Exception):
    """A position depends on more than lengths (an element of an array of strings), or is written in another way."""


@dataclass(frozen=True, order=True)
class Spot:
    """A distance from the start of a message. `lengths`: which length, and the bytes that each of it stands for."""

    lengths: tuple[tuple[int, int], ...] = ()
    constant: int = 0

    def plus(self, other: "Spot") -> "Spot":
        """Further on."""
        return Spot(self.lengths + other.lengths, self.constant + other.constant)

    def at(self, known: tuple[int, ...]) -> int:
        """The distance, where the lengths are known."""
        return self.constant + sum(known[number] * size for number, size in self.lengths)


@dataclass(frozen=True)
class Layout:
    """A shape with its lengths known: frames of so many bytes, and how to read them."""

    frames: struct.Struct
    lengths: tuple[int, ...]
    written: tuple[int, ...]
    """Where the fields that may be written stand, from the start of a frame."""


@dataclass
class Shape:
    """What is read of a message, in the order in which it stands there."""

    lengths: list[Spot] = field(default_factory=list)
    """Where the lengths stand, each behind those that it depends on."""
    reads: dict[tuple[Spot, str], str] = field(default_factory=dict)
    """The name of the value of this `struct` code at this spot."""
    written: list[Spot] = field(default_factory=list)
    ends: list[Spot] = field(default_factory=list)
    """What must be within the message."""

    def length(self, spot: Spot) -> int:
        """The number of the length that stands there."""
        if spot not in self.lengths:
            self.lengths.append(spot)
        return self.lengths.index(spot)

    def name(self, spot: Spot, code: str) -> str:
        """The name of a value."""
        return self.reads.setdefault((spot, code), f"r_{len(self.reads)}")

    def place(self, spot: Spot) -> int:
        """The number of a field that may be written."""
        if spot not in self.written:
            self.written.append(spot)
        return self.written.index(spot)

    @property
    def items(self) -> list[tuple[Spot, str, str]]:
        """Everything that is read: spot, code, name; in the order of the message."""
        lengths = [(spot, "I", f"l_{number}") for number, spot in enumerate(self.lengths)]
        values = [(spot, code, name) for (spot, code), name in self.reads.items()]
        return sorted(lengths + values, key=lambda item: (len(item[0].lengths), item[0].constant, item[1]))

    def lengths_of(self, body: memoryview) -> tuple[int, ...] | None:
        """The lengths in a message; None if it ends before they do."""
        known: tuple[int, ...] = ()
        for spot in self.lengths:
            at = spot.at(known)
            if at + 4 > len(body):
                return None
            known += (int(_LENGTH.unpack_from(body, at)[0]),)
        return known

    def layout(self, stride: int, known: tuple[int, ...]) -> Layout | None:
        """How frames of `stride` bytes with these lengths are read; None if they cannot be read so."""
        size = stride - 4
        if any(spot.at(known) > size for spot in self.ends):
            return None
        codes, position = "<4x", 0
        for spot, code, _name in self.items:
            gap = spot.at(known) - position
            if gap < 0:
                return None
            codes += f"{gap}x{code}" if gap else code
            position += gap + struct_size(code)
        if position > size or any(spot.at(known) >= size for spot in self.written):
            return None
        frames = struct.Struct(f"{codes}{size - position}x")
        return Layout(frames, known, tuple(spot.at(known) + 4 for spot in self.written))


class Reader:
    """Follows the statements of one event that find and read fields. `names`: the event's names for values."""

    def __init__(self, shape: Shape, structs: Mapping[str, tuple[str, str]]) -> None:
        self._shape = shape
        self._structs = structs
        self._spots: dict[str, Spot] = {}
        self._counts: dict[str, Spot] = {}
        self.names: dict[tuple[Spot, str], str] = {}

    def follow(self, node: ast.stmt) -> list[tuple[str, str]] | None:
        """Take in a statement: the event's names of the values it reads, each with that of the shape.

        None if the statement does not look at the message. Raises `NoShapeError`.
        """
        if not isinstance(node, ast.Assign) or len(node.targets) != 1 or not _looks(node.value):
            return None
        target, value = node.targets[0], node.value
        if isinstance(target, ast.Tuple) and isinstance(value, ast.Call):
            return self._read(target, value)
        if not isinstance(target, ast.Name):
            raise NoShapeError
        if isinstance(value, ast.Call) and isinstance(value.func, ast.Name) and value.func.id == "w_count":
            spot, least = self.spot(value.args[1]), value.args[2]
            if not isinstance(least, ast.Constant) or not isinstance(least.value, int) or not least.value:
                raise NoShapeError
            number = self._shape.length(spot)
            self._counts[target.id] = Spot(((number, 1),))
            self._shape.ends.append(spot.plus(Spot(((number, least.value),), 4)))
            return [(target.id, f"l_{number}")]
        self._spots[target.id] = self.spot(value)
        return []

    def hide(self, node: ast.stmt) -> None:
        """A position that is known only when a message is there: a spot that is like no other."""
        for part in ast.walk(node):
            if isinstance(part, ast.Name) and isinstance(part.ctx, ast.Store):
                self._spots[part.id] = Spot(((-1 - len(self._spots), 1),))

    def moves(self, node: ast.stmt) -> bool:
        """Whether a statement gives a position a name; it is taken in. Raises `NoShapeError`."""
        if not isinstance(node, ast.Assign) or not isinstance(node.targets[0], ast.Name):
            return False
        used = {part.id for part in ast.walk(node.value) if isinstance(part, ast.Name)}
        if not used & (self._spots.keys() | self._counts.keys()):
            return False
        self._spots[node.targets[0].id] = self.spot(node.value)
        return True

    def spot(self, node: ast.expr) -> Spot:
        """The spot that an expression is. Raises `NoShapeError`."""
        if isinstance(node, ast.Constant) and isinstance(node.value, int):
            return Spot((), node.value)
        if isinstance(node, ast.Name) and node.id in self._spots:
            return self._spots[node.id]
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
            return self.spot(node.left).plus(self.spot(node.right))
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult):
            return self._times(node)
        if isinstance(node, ast.Subscript) and isinstance(node.value, ast.Call):
            call = node.value
            if isinstance(call.func, ast.Name) and self._structs.get(call.func.id) == ("<I", "unpack_from"):
                return Spot(((self._shape.length(self.spot(call.args[1])), 1),))
        raise NoShapeError

    def _times(self, node: ast.BinOp) -> Spot:
        left, right = node.left, node.right
        if isinstance(right, ast.Constant) and isinstance(right.value, int):
            if isinstance(left, ast.Name) and left.id in self._counts:
                ((number, _one),) = self._counts[left.id].lengths
                return Spot(((number, right.value),))
            if isinstance(left, ast.Constant) and isinstance(left.value, int):
                return Spot((), left.value * right.value)
        raise NoShapeError

    def _read(self, target: ast.Tuple, call: ast.Call) -> list[tuple[str, str]]:
        function = call.func
        if not isinstance(function, ast.Name) or self._structs.get(function.id, ("", ""))[1] != "unpack_from":
            raise NoShapeError
        spot = self.spot(call.args[1])
        given = []
        names = iter(target.elts)
        for code, gap in codes_of(self._structs[function.id][0]):
            spot = spot.plus(Spot((), gap))
            own = next(names)
            assert isinstance(own, ast.Name)  # so `fields._read_together` writes it
            self.names[spot, code] = own.id
            given.append((own.id, self._shape.name(spot, code)))
            spot = spot.plus(Spot((), struct_size(code)))
        return given


def codes_of(text: str) -> list[tuple[str, int]]:
    """The codes of a `struct` format like `<d16xdII`, each with the bytes that are passed over before it."""
    found, number, gap = [], "", 0
    for character in text.removeprefix("<"):
        if character.isdigit():
            number += character
        elif character == "x":
            gap += int(number or 1)
            number = ""
        else:
            found.append((character, gap))
            gap = 0
    return found


def _looks(node: ast.expr) -> bool:
    return any(isinstance(part, ast.Name) and part.id == "b" for part in ast.walk(node))
