"""Compile events: match a message against the pattern, run the action, write back the assigned fields.

`e(m)` takes the message (None for a timer) and returns whether the event happened. Only fields in use are decoded;
only assigned fields are written.
"""

import math
from dataclasses import replace

from rosmop.check.assignables import Variable
from rosmop.check.conversion import condition, refusal
from rosmop.check.event_facts import note_facts
from rosmop.check.locate import type_of_path
from rosmop.check.message_fields import PatternField, check_overlaps, read_fields, writes
from rosmop.check.scope import CompilationContext, FunctionScope, SpecificationNames
from rosmop.check.slicing import acts, binds, creates
from rosmop.check.statements import check_topic, write
from rosmop.form import nodes
from rosmop.form.compiled import EventCode
from rosmop.form.findings import Diagnostic, SpecificationError
from rosmop.form.sites import Site
from rosmop.runtime.numbers import f32
from rosmop.text import tree
from rosmop.types import value_types
from rosmop.types.messages import UnknownNameError, nearest, quote
from rosmop.types.resolve import resolve
from rosmop.types.value_types import Type
from roswire.errors import DefinitionError

_NAMES = value_types.VectorType(value_types.STRING)


def compile_event(
    shared: CompilationContext,
    names: SpecificationNames,
    specification: tree.Specification,
    event: tree.EventDefinition,
) -> EventCode:
    function = shared.symbols.fresh("e")
    if isinstance(event.trigger, tree.TimerTrigger):
        return replace(_timer(shared, names, event, function), creates=creates(specification, event))
    trigger = event.trigger
    check_topic(trigger.topic, trigger.position)
    kind = _message_type(shared, trigger)
    scope = FunctionScope(shared, names, "action")
    scope.handled.message_type, scope.handled.event = kind, event.name
    scope.lines.site = scope.site(event)
    bound = _bind(scope, event, trigger, kind)
    happens, is_noted = _assemble(scope, event, bound, _body(scope, event, trigger))
    shared.bound[function] = bound
    whole = scope.function(function, ("m",), happens=happens)
    shared.define(whole)
    service = trigger.type if trigger.part is not None else None
    return EventCode(
        event.name,
        function,
        event.position,
        trigger.topic,
        kind,
        trigger.part,
        service,
        binds=binds(names, event),
        key=_key(shared, names, event, trigger, kind) if names.parameters else "",
        creates=creates(specification, event),
        plain=not event.action.statements and trigger.when is None and not is_noted,
        acts=acts(whole, shared),
        each_node=trigger.when is None and _lists_nodes(names, whole),
    )


def _lists_nodes(names: SpecificationNames, function: nodes.Function) -> bool:
    lists = any(variable.type == _NAMES for variable in names.variables.values())
    return lists and any(isinstance(one, nodes.SenderName) for one in nodes.walk(function.body))


def _key(
    shared: CompilationContext,
    names: SpecificationNames,
    event: tree.EventDefinition,
    trigger: tree.MessageTrigger,
    kind: str,
) -> str:
    """Write the function that returns the values that an event binds.

    It returns False if the message does not match, otherwise True alone, or a list of True and the values.
    """
    scope = FunctionScope(shared, names, "action")
    scope.handled.message_type = kind
    # No slice is running, so a fault has no values to show.
    site = scope.lines.site = scope.symbols.site(Site(event.position))
    bound = _bind(scope, event, trigger, kind)
    found = {field.variable.name: field.variable for field in bound if field.variable is not None}
    values = [found[name] for name in names.parameters if name in found]
    for variable in values:
        variable.used = True
    read_fields(scope, bound)
    scope.add(
        nodes.Return(site, nodes.Literal(value_types.BOOL, True), tuple(variable.code for variable in values))
    )
    function = shared.symbols.fresh("k")
    shared.define(scope.function(function, ("m",), happens=len(scope.lines.found)))
    return function


def compile_acceptance(
    shared: CompilationContext, names: SpecificationNames, event: tree.EventDefinition
) -> str:
    """Write a function that returns whether the pattern and the `when` of an event accept a message."""
    trigger = event.trigger
    assert isinstance(trigger, tree.MessageTrigger)  # the caller checks this
    scope = FunctionScope(shared, names, "action")
    scope.handled.message_type, scope.handled.event, scope.notes = (
        _message_type(shared, trigger),
        event.name,
        False,
    )
    site = scope.lines.site = scope.symbols.site(Site(event.position))
    bound = _bind(scope, event, trigger, scope.handled.message_type)
    tests_only = replace(event, action=replace(event.action, statements=()), after=())
    conditions, _, _ = _body(scope, tests_only, trigger)
    read_fields(scope, bound)
    scope.lines.found += conditions
    scope.add(nodes.Return(site, nodes.Literal(value_types.BOOL, True)))
    function = shared.symbols.fresh("k")
    shared.define(scope.function(function, ("m",), happens=len(scope.lines.found)))
    return function


def _timer(
    shared: CompilationContext, names: SpecificationNames, event: tree.EventDefinition, function: str
) -> EventCode:
    assert isinstance(event.trigger, tree.TimerTrigger)  # the caller checks this
    if event.parameters:
        raise SpecificationError.at(
            event.parameters[0].position, "a timer has no message, so it takes no parameters"
        )
    scope = FunctionScope(shared, names, "timer")
    scope.handled.drop_refused = "a timer has no message to drop"
    scope.lines.site = scope.site(event)
    write(scope, event.action)
    scope.add(nodes.Leave(scope.lines.site, True))
    whole = scope.function(function, ("m",))
    shared.define(whole)
    return EventCode(
        event.name, function, event.position, period_ns=event.trigger.period_ns, acts=acts(whole, shared)
    )


def _message_type(shared: CompilationContext, trigger: tree.MessageTrigger) -> str:
    kind = trigger.type
    if trigger.part is not None:
        try:
            service = shared.messages.definitions.service(kind)
        except DefinitionError:
            known = shared.messages.definitions.service_types
            raise SpecificationError.at(
                trigger.type_position,
                f"unknown service type {quote(kind)}{nearest(kind, known)}; others need a .srv file (--msg DIR)",
            ) from None
        kind = (service.request if trigger.part == "request" else service.response).name
    try:
        shared.messages.definition(kind)
    except UnknownNameError as error:
        raise SpecificationError.at(trigger.type_position, str(error)) from None
    return kind


# The pattern


def _bind(
    scope: FunctionScope, event: tree.EventDefinition, trigger: tree.MessageTrigger, kind: str
) -> list[PatternField]:
    parameters = {}
    for parameter in event.parameters:
        if parameter.name in parameters:
            raise SpecificationError.at(
                parameter.position, f"the parameter {quote(parameter.name)} occurs twice"
            )
        parameters[parameter.name] = parameter
    bound = []
    named = {binding.variable for binding in trigger.pattern}
    unbound = parameters.keys() - named
    for binding in trigger.pattern:
        try:
            if (
                binding.variable is not None
                and not unbound
                and _binds_nothing(scope, binding, parameters, kind)
            ):
                continue
            bound.append(_bind_one(scope, binding, parameters, kind))
        except SpecificationError as error:
            scope.shared.findings += error.findings
            scope.misdeclared.add(binding.variable or "")
    for parameter in event.parameters:
        if parameter.name not in named:
            raise SpecificationError.at(
                parameter.position,
                f"the parameter {quote(parameter.name)} is not bound to a field; write `field:{parameter.name}`",
            )
    return bound


def _binds_nothing(
    scope: FunctionScope, binding: tree.Binding, parameters: dict[str, tree.ParameterDeclaration], kind: str
) -> bool:
    """Whether a variable of a pattern is not a parameter. ROSMOP accepts this, so it is only a warning."""
    name = binding.variable or ""
    if name in parameters or name in scope.names.parameters:
        return False
    type_of_path(scope.messages, kind, binding.path)
    text = f"{quote(name)} is not a parameter of the event, so it binds nothing; leave it out"
    scope.shared.findings.append(Diagnostic(binding.value_position, "warning", text))
    return True


def _bind_one(
    scope: FunctionScope, binding: tree.Binding, parameters: dict[str, tree.ParameterDeclaration], kind: str
) -> PatternField:
    field = type_of_path(scope.messages, kind, binding.path)
    if binding.constant is not None:
        return PatternField(binding, field, constant=constant_of_field(scope, binding, field))
    assert binding.variable is not None  # a binding has a constant or a variable
    parameter = parameters.get(binding.variable)
    if parameter is None:
        raise SpecificationError.at(
            binding.value_position,
            f"unknown parameter {quote(binding.variable)}{nearest(binding.variable, parameters)}",
        )
    target = field if parameter.type.name == ("auto",) else resolve(parameter.type, scope.messages)
    if not value_types.convertible(field, target):
        name = ".".join(step.name for step in binding.path)
        raise SpecificationError.at(
            parameter.position,
            f"`{name}` is {field} and cannot be bound to {target}: {refusal(field, target)}",
        )
    if isinstance(target, value_types.VectorType) and isinstance(field, value_types.VectorType):
        target = value_types.VectorType(target.element, field.length)
    sliced = scope.names.parameters.get(parameter.name)
    if sliced is not None and sliced.type != target:
        text = (
            f"the parameter {quote(parameter.name)} of the specification is {sliced.type}, and {target} here"
        )
        raise SpecificationError.at(parameter.position, text)
    variable = Variable(parameter.name, target, scope.symbols.fresh("v"), parameter.position)
    variable.constant = parameter.type.constant
    variable.flag = scope.symbols.fresh("f")
    scope.declare(variable)
    return PatternField(binding, field, variable)


def constant_of_field(scope: FunctionScope, binding: tree.Binding, field: Type) -> bool | int | float | bytes:
    assert binding.constant is not None  # the caller checks this
    constant = scope.value_of(binding.constant).constant
    held = None if constant is None else _held(constant, field)
    if held is None:
        shown_as = repr(constant.decode("utf-8", "replace")) if isinstance(constant, bytes) else constant
        raise SpecificationError.at(binding.value_position, f"a field of type {field} cannot hold {shown_as}")
    return held


def _held(constant: bool | int | float | bytes, field: Type) -> bool | int | float | bytes | None:
    if isinstance(field, value_types.StringType):
        return constant if isinstance(constant, bytes) else None
    if isinstance(constant, bytes) or not value_types.is_number(field):
        return None
    if isinstance(field, value_types.FloatingType):
        held = f32(float(constant)) if field.bits == 32 else float(constant)
        return None if math.isinf(held) and not math.isinf(float(constant)) else held
    if isinstance(constant, float) and (constant - constant != 0 or constant != int(constant)):
        return None
    if isinstance(field, value_types.BoolType):
        return bool(constant) if constant in (0, 1) else None
    assert isinstance(field, value_types.IntegerType)  # a number has one of three types
    return int(constant) if field.least <= constant <= field.most else None


# The body


def _body(
    scope: FunctionScope, event: tree.EventDefinition, trigger: tree.MessageTrigger
) -> tuple[list[nodes.Statement], list[nodes.Statement], list[nodes.Statement]]:
    when = trigger.when
    with scope.nested() as conditions:
        if when is not None:
            with scope.at(when), scope.looking():
                try:
                    test = condition(scope.value_of(when))
                    scope.add(nodes.Require(scope.lines.site, test))
                except SpecificationError as error:
                    scope.shared.findings += error.findings
            if scope.changes_anything():
                raise SpecificationError.at(when.position, "`when` only tests; assign in the action")
    with scope.nested() as action:
        write(scope, event.action)
    with scope.nested() as after:
        for statement in event.after:
            write(scope, statement)
    return conditions, action, after


def _assemble(
    scope: FunctionScope,
    event: tree.EventDefinition,
    bound: list[PatternField],
    body: tuple[list[nodes.Statement], list[nodes.Statement], list[nodes.Statement]],
) -> tuple[int, bool]:
    conditions, action, after = body
    read_fields(scope, bound)  # at a site without parameters, because they have no values yet
    site = scope.lines.site = scope.site(event)
    written = [field for field in bound if field.variable is not None and field.variable.assigned]
    check_overlaps(bound, written)
    fields = writes(scope, written)
    for field in fields:
        scope.evaluate(nodes.Assign(value_types.BOOL, field.flag, nodes.Literal(value_types.BOOL, False)))
    if scope.handled.pending is not None:
        scope.add(nodes.Pending(site, scope.handled.pending, fields))
    scope.lines.found += conditions
    before = len(scope.lines.found)
    scope.lines.found += action
    scope.add(nodes.WriteBack(site, fields, scope.temporary("w")))
    is_noted = note_facts(scope, event.name) or bool(after)
    scope.lines.found += after
    scope.add(nodes.Leave(site, True))
    return before, is_noted
