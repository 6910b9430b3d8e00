"""Compile `age(event)`, `seen(event)`, `host(event)`, `caller(event)`, `altered(event)` and `topic(event)`.

Variables keep the time when the event last happened (-1: never), and its sender, so they are saved, restored
and undone, and each slice has its own. They are assigned after the action, unless it dropped the message or
faulted. In the action itself, `host` and `caller` are the sender of its message. `altered` is only known there.
`topic` is a literal.
"""

import math
from collections.abc import Iterator

from rosmop.check.assignables import Value, Variable
from rosmop.check.scope import CompilationContext, FunctionScope, SpecificationNames
from rosmop.form import nodes
from rosmop.form.findings import SpecificationError
from rosmop.text import tree
from rosmop.types import value_types
from rosmop.types.messages import nearest, quote

SENDER = ("host", "caller")
ALTERED, TOPIC = "altered", "topic"
FUNCTIONS = frozenset({"age", "seen", ALTERED, TOPIC, *SENDER})


def declare_facts(
    shared: CompilationContext, names: SpecificationNames, specification: tree.Specification
) -> None:
    events = {event.name: event for event in specification.events}
    names.events = {
        event.name: event.trigger.topic
        for event in specification.events
        if isinstance(event.trigger, tree.MessageTrigger)
    }
    for fact, event in dict.fromkeys(_asked(specification)):
        if event in names.events and not (names.parameters and fact in SENDER):
            kind = value_types.STRING if fact in SENDER else value_types.LONG
            code, position = shared.symbols.fresh("g"), events[event].position
            variable = Variable(_name(fact, event), kind, code, position, shared=True, constant=True)
            variable.sliced = bool(names.parameters)
            shared.variables.declare(names, variable)


def first_facts(names: SpecificationNames) -> Iterator[nodes.Assign]:
    for event in names.events:
        for variable in _variables(names, event):
            never: nodes.Expression = (
                _NEVER if variable.type == value_types.LONG else nodes.Zero(variable.type)
            )
            yield nodes.Assign(variable.type, variable.code, never)


def note_facts(scope: FunctionScope, event: str) -> bool:
    variables = _variables(scope.names, event)
    for variable in variables:
        scope.effects.written.add(variable.code)
        value = (
            _NOW if variable.type == value_types.LONG else nodes.SenderName(variable.name.partition("(")[0])
        )
        scope.evaluate(nodes.Assign(variable.type, variable.code, value))
    return bool(variables)


def fact(scope: FunctionScope, node: tree.CallExpression, function: str) -> Value:
    event = _event(scope, node, function)
    if function in SENDER:
        return _sender(scope, node, function, event)
    if function == TOPIC:
        literal = nodes.Literal(value_types.STRING, scope.names.events[event].encode())
        return Value(literal, node.position)
    if function == ALTERED:
        if event != scope.handled.event:
            text = f"`altered({event})` is only known in the `when` and the action of `{event}`"
            raise SpecificationError.at(node.position, text)
        return Value(nodes.Altered(), node.position)
    variable = scope.names.variables[_name("age", event)]
    last = nodes.Read(variable.type, variable.code)
    site = scope.site(node)
    if function == "seen":
        return Value(nodes.Compare("!=", last, _NEVER, site), node.position)
    past = nodes.Arithmetic(value_types.LONG, "-", _NOW, last, site)
    seconds = nodes.Arithmetic(
        value_types.DOUBLE, "/", nodes.Convert(value_types.DOUBLE, past), _BILLION, site
    )
    # A clock that went back leaves times in the future. Their age is unknown, so it is infinite.
    unknown = nodes.Logical(
        "or", nodes.Compare("==", last, _NEVER, site), nodes.Compare(">", last, _NOW, site)
    )
    infinite = nodes.Literal(value_types.DOUBLE, math.inf)
    return Value(nodes.Conditional(value_types.DOUBLE, unknown, infinite, seconds), node.position)


def _sender(scope: FunctionScope, node: tree.CallExpression, function: str, event: str) -> Value:
    if event == scope.handled.event:
        return Value(nodes.SenderName(function), node.position)
    if scope.role == "function":
        text = f"a function may run before the action of `{event}` ends; give it `{function}({event})` as a parameter"
        raise SpecificationError.at(node.position, text)
    variable = scope.names.variables.get(_name(function, event))
    if variable is None:
        text = f"slices do not keep the sender of a message; use `{function}({event})` in the action of `{event}`"
        raise SpecificationError.at(node.position, text)
    return Value(nodes.Read(variable.type, variable.code), node.position, owned=False)


_NEVER = nodes.Literal(value_types.LONG, -1)
_NOW = nodes.Call(value_types.LONG, "m_whole", (nodes.Now(),))
_BILLION = nodes.Literal(value_types.DOUBLE, 1e9)


def _event(scope: FunctionScope, node: tree.CallExpression, function: str) -> str:
    name = _argument(node)
    if name in scope.names.events:
        return name
    where = node.arguments[0].position if len(node.arguments) == 1 else node.position
    hint = nearest(name, scope.names.events) if name else ""
    text = f"`{function}` takes the name of an event with a message"
    raise SpecificationError.at(where, f"{text}; {quote(name)} is not one{hint}" if name else text)


def _asked(specification: tree.Specification) -> Iterator[tuple[str, str]]:
    own = {function.name for function in specification.functions}
    for within in tree.fields_of(specification):
        for part in within if isinstance(within, tuple) else ():
            for node in tree.walk(part):
                match node:
                    case tree.CallExpression(callee=tree.Name(parts=(name,))) if name in FUNCTIONS - own:
                        event = _argument(node)
                        if name in {"age", "seen"}:
                            yield "age", event
                        elif name in SENDER and not (
                            isinstance(part, tree.EventDefinition) and part.name == event
                        ):
                            yield name, event


def _argument(node: tree.CallExpression) -> str:
    match node.arguments:
        case (tree.Name(parts=(name,)),):
            return name
    return ""


def _variables(names: SpecificationNames, event: str) -> list[Variable]:
    found = (names.variables.get(_name(kind, event)) for kind in ("age", *SENDER))
    return [variable for variable in found if variable is not None]


def _name(function: str, event: str) -> str:
    return f"{function}({event})"
