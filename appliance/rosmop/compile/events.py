"""Events as functions: match a message against the pattern, run the action, write back what was assigned.

`e(m)` takes the message (None for a timer) and returns whether the event happened. Only fields that the action,
the `when` or a constant of the pattern look at are decoded; only fields that were assigned are written.
"""

from dataclasses import dataclass

from appliance.ros.errors import DefinitionError
from appliance.rosmop.compile.codecs import struct_code, struct_size
from appliance.rosmop.compile.conversion import condition, convert, literal, refusal
from appliance.rosmop.compile.expressions import value_of
from appliance.rosmop.compile.locate import Locator, Spot, Walk, type_of_path
from appliance.rosmop.compile.module import Lines
from appliance.rosmop.compile.places import Value, Variable
from appliance.rosmop.compile.scope import Scope, Shared, SpecificationNames
from appliance.rosmop.compile.statements import check_topic, write
from appliance.rosmop.positions import Position
from appliance.rosmop.runtime.numbers import f32
from appliance.rosmop.syntax import tree
from appliance.rosmop.syntax.errors import SpecificationError
from appliance.rosmop.types import kinds
from appliance.rosmop.types.kinds import Type
from appliance.rosmop.types.messages import UnknownNameError, nearest, shown
from appliance.rosmop.types.resolve import resolve

CHARGED = 1024
"""A message longer than this is charged when an array or all of it is decoded."""


@dataclass(frozen=True)
class EventCode:
    """A compiled event: the name of its function, and what makes it happen.

    `type` is the message type (of a service: that of the request or response), `service_type` the service's.
    """

    name: str
    function: str
    position: Position
    topic: str | None = None
    type: str | None = None
    part: str | None = None
    service_type: str | None = None
    period_ns: int | None = None
    action_line: int = 0
    """The line of the code at which the action begins: what faults there has happened."""


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


def compile_event(shared: Shared, names: SpecificationNames, event: tree.Event) -> EventCode:
    """Write the function of an event."""
    function = shared.module.fresh("e")
    if isinstance(event.trigger, tree.TimerTrigger):
        return _timer(shared, names, event, function)
    trigger = event.trigger
    check_topic(trigger.topic, trigger.position)
    kind = _message_type(shared, trigger)
    scope = Scope(shared, names, "action")
    scope.message_type = kind
    scope.lines.site = scope.site(event)
    bound = _bind(scope, event, trigger, kind)
    body = _body(scope, event, trigger, bound, kind)
    lines, action_starts = _assemble(scope, event, bound, body)
    header = [(f"def {function}(m):", -1), *_globals(scope)]
    action_line = shared.module.next_line + len(header) + action_starts
    shared.module.add(header + lines)
    service = trigger.type if trigger.part is not None else None
    return EventCode(
        event.name,
        function,
        event.position,
        trigger.topic,
        kind,
        trigger.part,
        service,
        action_line=action_line,
    )


def _timer(shared: Shared, names: SpecificationNames, event: tree.Event, function: str) -> EventCode:
    assert isinstance(event.trigger, tree.TimerTrigger)  # noqa: S101  the caller has looked
    if event.parameters:
        raise SpecificationError.at(
            event.parameters[0].position, "a timer has no message, so it takes no parameters"
        )
    scope = Scope(shared, names, "timer")
    scope.drop_refused = "a timer has no message to drop"
    scope.lines.site = scope.site(event)
    write(scope, event.action)
    scope.lines.add("return True")
    shared.module.add([(f"def {function}(m):", -1), *_globals(scope), *scope.lines.lines])
    return EventCode(event.name, function, event.position, period_ns=event.trigger.period_ns)


def _globals(scope: Scope) -> list[tuple[str, int]]:
    return [(f"    global {', '.join(sorted(scope.written))}", -1)] if scope.written else []


def _message_type(shared: Shared, trigger: tree.MessageTrigger) -> str:
    kind = trigger.type
    if trigger.part is not None:
        try:
            service = shared.messages.definitions.service(kind)
        except DefinitionError:
            known = shared.messages.definitions.service_types
            raise SpecificationError.at(
                trigger.type_position,
                f"there is no service type {shown(kind)}{nearest(kind, known)}; others need a .srv file (--msg DIR)",
            ) from None
        kind = (service.request if trigger.part == "request" else service.response).name
    try:
        shared.messages.definition(kind)
    except UnknownNameError as error:
        raise SpecificationError.at(trigger.type_position, str(error)) from None
    return kind


# The pattern


def _bind(scope: Scope, event: tree.Event, trigger: tree.MessageTrigger, kind: str) -> list[Bound]:
    parameters = {}
    for parameter in event.parameters:
        if parameter.name in parameters:
            raise SpecificationError.at(
                parameter.position, f"the parameter {shown(parameter.name)} occurs twice"
            )
        parameters[parameter.name] = parameter
    bound = []
    for binding in trigger.pattern:
        try:
            bound.append(_bind_one(scope, binding, parameters, kind))
        except SpecificationError as error:
            scope.shared.findings += error.findings
    named = {binding.variable for binding in trigger.pattern}
    for parameter in event.parameters:
        if parameter.name not in named:
            raise SpecificationError.at(
                parameter.position,
                f"the parameter {shown(parameter.name)} is bound to no field; write `field:{parameter.name}`",
            )
    return bound


def _bind_one(scope: Scope, binding: tree.Binding, parameters: dict[str, tree.Parameter], kind: str) -> Bound:
    field = type_of_path(scope.messages, kind, binding.path)
    if binding.constant is not None:
        return Bound(binding, field, constant=_constant(scope, binding, field))
    assert binding.variable is not None  # noqa: S101  a binding has one of the two
    parameter = parameters.get(binding.variable)
    if parameter is None:
        raise SpecificationError.at(
            binding.value_position,
            f"there is no parameter {shown(binding.variable)}{nearest(binding.variable, parameters)}",
        )
    target = field if parameter.type.name == ("auto",) else resolve(parameter.type, scope.messages)
    if not kinds.convertible(field, target):
        name = ".".join(step.name for step in binding.path)
        raise SpecificationError.at(
            parameter.position,
            f"`{name}` is {field} and cannot be bound to {target}: {refusal(field, target)}",
        )
    if isinstance(target, kinds.Vector) and isinstance(field, kinds.Vector):
        target = kinds.Vector(target.element, field.length)
    variable = Variable(parameter.name, target, scope.module.fresh("v"), parameter.position)
    variable.constant = parameter.type.constant
    variable.flag = scope.module.fresh("f")
    scope.declare(variable)
    return Bound(binding, field, variable)


def _constant(scope: Scope, binding: tree.Binding, field: Type) -> bool | int | float | bytes:
    assert binding.constant is not None  # noqa: S101  the caller has looked
    constant = value_of(scope, binding.constant).constant
    held = None if constant is None else _held(constant, field)
    if held is None:
        shown_as = repr(constant.decode("utf-8", "replace")) if isinstance(constant, bytes) else constant
        raise SpecificationError.at(binding.value_position, f"a field of type {field} cannot hold {shown_as}")
    return held


def _held(constant: bool | int | float | bytes, field: Type) -> bool | int | float | bytes | None:
    """The constant as the field holds it; None if it cannot."""
    if isinstance(field, kinds.String):
        return constant if isinstance(constant, bytes) else None
    if isinstance(constant, bytes) or not kinds.is_number(field):
        return None
    if isinstance(field, kinds.Floating):
        return f32(float(constant)) if field.bits == 32 else float(constant)
    if isinstance(constant, float) and (constant - constant != 0 or constant != int(constant)):
        return None
    if isinstance(field, kinds.Bool):
        return bool(constant) if constant in (0, 1) else None
    assert isinstance(field, kinds.Integer)  # noqa: S101  numbers are one of the three
    return int(constant) if field.least <= constant <= field.most else None


# The body


def _body(
    scope: Scope, event: tree.Event, trigger: tree.MessageTrigger, bound: list[Bound], kind: str
) -> tuple[list[tuple[str, int]], list[tuple[str, int]]]:
    """The lines of `when` and of the action. They come first, because they say which fields are needed."""
    pending = scope.module.fresh("u")
    scope.read_message = lambda: _whole(scope, pending, kind)
    own, scope.lines = scope.lines, Lines()
    when = trigger.when
    if when is not None:
        with scope.at(when):
            try:
                scope.lines.add(f"if not {condition(value_of(scope, when))}: return False")
            except SpecificationError as error:
                scope.shared.findings += error.findings
        if any(each.variable is not None and each.variable.assigned for each in bound):
            raise SpecificationError.at(when.position, "`when` only looks; assign in the action")
    conditions, scope.lines = scope.lines, Lines()
    scope.lines.site = own.site
    write(scope, event.action)
    action, scope.lines = scope.lines, own
    return conditions.lines, action.lines


def _whole(scope: Scope, pending: str, kind: str) -> str:
    """Code for `MESSAGE`: the message with what was assigned so far, which `pending` tells."""
    scope.whole_asked = pending
    record = kinds.Record(kind)
    return f"x_whole(m, {scope.context}, {scope.codecs.decoder(record)}, {pending}(), {scope.lines.site})"


def _assemble(
    scope: Scope,
    event: tree.Event,
    bound: list[Bound],
    body: tuple[list[tuple[str, int]], list[tuple[str, int]]],
) -> tuple[list[tuple[str, int]], int]:
    """All lines of the function, and how many stand before the action."""
    conditions, action = body
    lines = Lines()
    lines.site = scope.site(event)
    scope.lines = lines
    lines.add("b = m.buffer")
    _read(scope, bound)
    written = [each for each in bound if each.variable is not None and each.variable.assigned]
    _check_overlaps(scope, bound, written)
    for each in written:
        assert each.variable is not None  # noqa: S101
        lines.add(f"{each.variable.flag} = False")
    if scope.whole_asked is not None:
        lines.add(f"{scope.whole_asked} = lambda: {_pending(scope, written)}")
    lines.lines += conditions
    before = len(lines.lines)
    lines.lines += action
    _write_back(scope, written)
    lines.add("return True")
    return lines.lines, before


def _pending(scope: Scope, written: list[Bound]) -> str:
    """Code for the assigned fields, as (whether assigned, path, value)."""
    entries = []
    for each in written:
        assert each.variable is not None  # noqa: S101
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
    assert each.variable is not None  # noqa: S101
    value = Value(each.variable.type, each.variable.code, each.binding.position, owned=False)
    return convert(scope, value, each.type)


# Reading and writing fields


def _read(scope: Scope, bound: list[Bound]) -> None:
    lines = scope.lines
    layout = scope.messages.definitions.layout(scope.message_type or "")
    walk = Walk(Locator(scope.module, scope.codecs, lines), layout, Spot(None, 0))
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
        assert each.spot is not None  # noqa: S101  a number is somewhere
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
    assert spot is not None  # noqa: S101
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


def _write_back(scope: Scope, written: list[Bound]) -> None:
    lines = scope.lines
    edits = scope.temporary("w")
    lines.add("if m.dropped: return True")
    spliced = [each for each in written if struct_code(each.type) is None]
    for each in written:
        code = struct_code(each.type)
        assert each.variable is not None  # noqa: S101
        if code is not None:
            assert each.spot is not None  # noqa: S101
            packed = scope.codecs.pack([(each.type, _as_field(scope, each))])
            lines.add(f"if {each.variable.flag}: m.patch({each.spot.code}, {packed})")
    if not spliced:
        return
    lines.add(f"{edits} = []")
    for each in spliced:
        assert each.variable is not None  # noqa: S101
        start = "0" if each.spot is None else each.spot.code
        lines.add(f"if {each.variable.flag}:")
        lines.add("    o = e_bytearray()")
        lines.add(f"    {scope.codecs.encoder(each.type)}({_as_field(scope, each)}, o)")
        lines.add(f"    {edits}.append(({start}, {each.end}, e_bytes(o)))")
    lines.add(f"if {edits}: m.splice({edits})")


def _check_overlaps(scope: Scope, bound: list[Bound], written: list[Bound]) -> None:
    """Refuse an assignment to a field that is bound twice: one change would undo the other."""
    for each in written:
        path = _path(each)
        for other in bound:
            shorter = min(len(path), len(_path(other)))
            if other is not each and path[:shorter] == _path(other)[:shorter]:
                raise SpecificationError.at(
                    max(each, other, key=lambda one: one.binding.position).binding.position,
                    "two bindings hold this field, and one of them is assigned; bind it once",
                )
    del scope


def _path(each: Bound) -> list[tuple[str, int | None]]:
    return [(step.name, step.index) for step in each.binding.path]
