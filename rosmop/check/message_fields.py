"""Generate code that reads bound fields from the bytes of a message, and code that writes assigned fields.

Numbers at known distances are read together. Only a changed string, array or message of a different size
needs a new buffer.
"""

from dataclasses import dataclass

from rosmop.check.assignables import Value, Variable
from rosmop.check.conversion import convert
from rosmop.check.locate import FieldLocator, MessageCursor
from rosmop.check.scope import FunctionScope
from rosmop.form import nodes
from rosmop.form.findings import SpecificationError
from rosmop.form.nodes import Spot
from rosmop.runtime.values import struct_code, struct_size
from rosmop.text import tree
from rosmop.types import value_types
from rosmop.types.value_types import Type


@dataclass(eq=False)
class PatternField:
    """A field of the pattern: the variable it is bound to, or the constant it must equal."""

    binding: tree.Binding
    type: Type
    variable: Variable | None = None
    constant: bool | int | float | bytes | None = None
    spot: Spot | None = None
    read: str = ""  # the code's name for the field's value
    end: str = ""  # the code's name for the end of a field of variable size


def writes(scope: FunctionScope, written: list[PatternField]) -> tuple[nodes.Write, ...]:
    found = []
    for field in written:
        variable = field.variable
        assert variable is not None
        assert variable.flag is not None
        assert variable.assigned
        read = nodes.Read(variable.type, variable.code)
        value = convert(scope, Value(read, field.binding.position, owned=False), field.type)
        end = field.end or None
        found.append(
            nodes.Write(variable.flag, value, field.spot or Spot(None, 0), end, tuple(_slots(scope, field)))
        )
    return tuple(found)


def _slots(scope: FunctionScope, field: PatternField) -> list[int | str]:
    kind: Type = value_types.RecordType(scope.handled.message_type or "")
    path: list[int | str] = []
    for step in field.binding.path:
        if isinstance(kind, value_types.RecordType):
            slot = scope.messages.slot(kind.name, step.name)
            path.append(slot.index)
            kind = slot.type
        else:
            path.append(step.name)
        if step.index is not None and isinstance(kind, value_types.VectorType):
            path.append(step.index)
            kind = kind.element
    return path


def read_fields(scope: FunctionScope, bound: list[PatternField]) -> None:
    layout = scope.messages.definitions.layout(scope.handled.message_type or "")
    walk = MessageCursor(
        FieldLocator(scope.symbols, scope.lines.found, scope.lines.site), layout, Spot(None, 0)
    )
    fixed: list[PatternField] = []
    variable_size: list[PatternField] = []
    for field in bound:
        field.spot = walk.find(field.binding.path)
        if field.variable is None or field.variable.used:
            (variable_size if struct_code(field.type) is None else fixed).append(field)
    if any(
        isinstance(field.type, value_types.VectorType | value_types.RecordType) for field in variable_size
    ):
        scope.add(nodes.Allocate(scope.lines.site, None))
    _read_fixed(scope, fixed)
    for field in variable_size:
        field.read, field.end = scope.temporary("r"), scope.temporary("x")
        at = field.spot or Spot(None, 0)
        scope.add(nodes.ReadValue(scope.lines.site, field.read, field.end, at, field.type))
    for field in bound:
        _take(scope, field)


def _read_fixed(scope: FunctionScope, fixed: list[PatternField]) -> None:
    groups: dict[str | None, list[PatternField]] = {}
    for field in fixed:
        assert field.spot is not None  # a number always has a position
        groups.setdefault(field.spot.base, []).append(field)
    for group in groups.values():
        waiting = sorted(group, key=_offset)
        while waiting:
            together = [waiting.pop(0)]
            while waiting and _near(together[-1], waiting[0]):
                together.append(waiting.pop(0))
            _read_together(scope, together)


def _offset(field: PatternField) -> int:
    return field.spot.offset if field.spot is not None else 0


def _near(field: PatternField, other: PatternField) -> bool:
    gap = _offset(other) - _offset(field) - struct_size(struct_code(field.type) or "")
    return 0 <= gap <= 256


def _read_together(scope: FunctionScope, together: list[PatternField]) -> None:
    first = together[0].spot
    assert first is not None  # a number always has a position
    for field in together:
        field.read = scope.temporary("r")
    fields = tuple((field.read, field.type, _offset(field) - first.offset) for field in together)
    scope.add(nodes.ReadNumbers(scope.lines.site, first, fields))


def _take(scope: FunctionScope, field: PatternField) -> None:
    site, read = scope.lines.site, nodes.Read(field.type, field.read)
    if field.constant is not None:
        constant = nodes.Literal(field.type, field.constant)
        test: nodes.Expression = nodes.Compare("==", read, constant, site)
        if isinstance(field.type, value_types.StringType):
            test = nodes.CompareTexts("==", read, constant, True, site)
        scope.add(nodes.Require(site, test))
    elif field.variable is not None and field.variable.used:
        value = convert(scope, Value(read, field.binding.position), field.variable.type)
        scope.evaluate(nodes.Assign(field.variable.type, field.variable.code, value))


def check_overlaps(bound: list[PatternField], written: list[PatternField]) -> None:
    """Reject an assignment to a field that is bound twice: one change would undo the other."""
    for field in written:
        for other in bound:
            if other is not field and _overlap(field.binding, other.binding):
                raise SpecificationError.at(
                    max(field.binding.position, other.binding.position),
                    "two bindings hold this field, and one of them is assigned; bind it once",
                )


def _overlap(binding: tree.Binding, other: tree.Binding) -> bool:
    return all(
        step.name == beside.name and (step.index == beside.index or None in (step.index, beside.index))
        for step, beside in zip(binding.path, other.path, strict=False)
    )
