"""Fields as code: what a bound parameter reads from the bytes of a message, and what an assigned one writes.

Numbers at known distances from each other are read with one call. A changed number is written in place; only a
changed string, array or message of another size makes a new buffer.
"""

from dataclasses import dataclass

from appliance.rosmop.compile.codecs import struct_code, struct_size
from appliance.rosmop.compile.conversion import convert, literal
from appliance.rosmop.compile.locate import Locator, Spot, Walk
from appliance.rosmop.compile.places import Value, Variable
from appliance.rosmop.compile.scope import Scope
from appliance.rosmop.syntax import tree
from appliance.rosmop.syntax.errors import SpecificationError
from appliance.rosmop.types import kinds
from appliance.rosmop.types.kinds import Type

CHARGED = 1024
"""A message longer than this is charged when an array or all of it is decoded."""


@dataclass(eq=False)
class Bound:
    """A field of the pattern: the variable it is bound to, or the constant it must equal."""

    binding: tree.Binding
    type: Type
    variable: Variable | None = None
    constant: bool | int | float | bytes | None = None
    spot: Spot | None = None
    read: str = ""  # the code's name for the field's value
    end: str = ""  # of a field of variable size: the code's name for where it ends


def pending(scope: Scope, written: list[Bound]) -> str:
    """Code for the assigned fields, as (whether assigned, path, value)."""
    entries = []
    for each in written:
        assert each.variable is not None
        path = tuple(_slots(scope, each))
        value = _as_field(scope, each)
        entries.append(f"({each.variable.flag}, {path!r}, {value})")
    return f"({', '.join(entries)},)" if entries else "()"


def _slots(scope: Scope, each: Bound) -> list[int | str]:
    """The path as indexes into lists; the parts of a time by name."""
    kind: Type = kinds.Record(scope.message_type or "")
    path: list[int | str] = []
    for step in each.binding.path:
        if isinstance(kind, kinds.Record):
            slot = scope.messages.slot(kind.name, step.name)
            path.append(slot.index)
            kind = slot.type
        else:
            path.append(step.name)
        if step.index is not None and isinstance(kind, kinds.Vector):
            path.append(step.index)
            kind = kind.element
    return path


def _as_field(scope: Scope, each: Bound) -> str:
    """Code for a variable's value as the field has it."""
    assert each.variable is not None
    value = Value(each.variable.type, each.variable.code, each.binding.position, owned=False)
    return convert(scope, value, each.type)


def read_fields(scope: Scope, bound: list[Bound]) -> None:
    """Write the lines that find and read the fields that are used, and compare those that have constants."""
    lines = scope.lines
    layout = scope.messages.definitions.layout(scope.message_type or "")
    walk = Walk(Locator(scope.module, scope.codecs, lines, scope.context), layout, Spot(None, 0))
    fixed: list[Bound] = []
    large = False
    for each in bound:
        each.spot = walk.find(each.binding.path)
        if each.variable is not None and not each.variable.used:
            continue
        if struct_code(each.type) is not None:
            fixed.append(each)
        elif isinstance(each.type, kinds.Vector | kinds.Record):
            large = True
    if large:
        lines.add(f"if w_len(b) > {CHARGED}: {scope.context}.allocate(w_len(b), {lines.site})")
    _read_fixed(scope, fixed)
    for each in bound:
        if struct_code(each.type) is None and (each.variable is None or each.variable.used):
            each.read, each.end = scope.temporary("r"), scope.temporary("x")
            start = "0" if each.spot is None else each.spot.code
            lines.add(f"{each.read}, {each.end} = {scope.codecs.decode(each.type, 'b', start)}")
    for each in bound:
        _take(scope, each)


def _read_fixed(scope: Scope, fixed: list[Bound]) -> None:
    """Read numbers; those at known distances from each other with one call."""
    groups: dict[str | None, list[Bound]] = {}
    for each in fixed:
        assert each.spot is not None  # a number is somewhere
        groups.setdefault(each.spot.base, []).append(each)
    for group in groups.values():
        waiting = sorted(group, key=_offset)
        while waiting:
            together = [waiting.pop(0)]
            while waiting and _near(together[-1], waiting[0]):
                together.append(waiting.pop(0))
            _read_together(scope, together)


def _offset(each: Bound) -> int:
    return each.spot.offset if each.spot is not None else 0


def _near(one: Bound, other: Bound) -> bool:
    gap = _offset(other) - _offset(one) - struct_size(struct_code(one.type) or "")
    return 0 <= gap <= 256


def _read_together(scope: Scope, together: list[Bound]) -> None:
    codes, names = "<", []
    at = _offset(together[0])
    for each in together:
        code = struct_code(each.type) or ""
        gap = _offset(each) - at
        codes += (f"{gap}x" if gap else "") + code
        at = _offset(each) + struct_size(code)
        each.read = scope.temporary("r")
        names += [f"{each.read}_{index}" for index in range(2)] if len(code) == 2 else [each.read]
    unpack = scope.module.struct(codes, "unpack_from")
    spot = together[0].spot
    assert spot is not None
    scope.lines.add(f"{', '.join(names)}, = {unpack}(b, {spot.code})")
    for each in together:
        if len(struct_code(each.type) or "") == 2:
            scope.lines.add(f"{each.read} = {each.read}_0 * 1000000000 + {each.read}_1")


def _take(scope: Scope, each: Bound) -> None:
    """Compare a field with its constant, or give it to its variable."""
    if each.constant is not None:
        scope.lines.add(f"if not {each.read} == {literal(each.constant)}: return False")
    elif each.variable is not None and each.variable.used:
        value = Value(each.type, each.read, each.binding.position)
        scope.lines.add(f"{each.variable.code} = {convert(scope, value, each.variable.type)}")


def write_back(scope: Scope, written: list[Bound]) -> None:
    """Write the lines that put assigned fields into the message, unless it was dropped.

    What can fault, the encoding of fields of variable size, comes before the first byte is written: all of the action's
    changes are relayed, or none.
    """
    lines = scope.lines
    edits = scope.temporary("w")
    lines.add("if m.dropped: return True")
    spliced = [each for each in written if struct_code(each.type) is None]
    if spliced:
        lines.add(f"{edits} = []")
    for each in spliced:
        assert each.variable is not None
        start = "0" if each.spot is None else each.spot.code
        lines.add(f"if {each.variable.flag}:")
        lines.add("    o = e_bytearray()")
        lines.add(f"    {scope.codecs.encoder(each.type)}({_as_field(scope, each)}, o)")
        lines.add(f"    {edits}.append(({start}, {each.end}, e_bytes(o)))")
    for each in written:
        if struct_code(each.type) is not None:
            assert each.variable is not None
            assert each.spot is not None
            packed = scope.codecs.pack([(each.type, _as_field(scope, each))])
            lines.add(f"if {each.variable.flag}: m.patch({each.spot.code}, {packed})")
    if spliced:
        lines.add(f"if {edits}: m.splice({edits})")


def check_overlaps(bound: list[Bound], written: list[Bound]) -> None:
    """Refuse an assignment to a field that is bound twice: one change would undo the other."""
    for each in written:
        for other in bound:
            if other is not each and _overlap(each.binding, other.binding):
                raise SpecificationError.at(
                    max(each, other, key=lambda one: one.binding.position).binding.position,
                    "two bindings hold this field, and one of them is assigned; bind it once",
                )


def _overlap(one: tree.Binding, other: tree.Binding) -> bool:
    """Whether one is the other or a part of it; an array without an index is all its elements."""
    return all(
        step.name == beside.name and (step.index == beside.index or None in (step.index, beside.index))
        for step, beside in zip(one.path, other.path, strict=False)
    )
