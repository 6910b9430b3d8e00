"""Compile `age(event)` and `seen(event)`.

A variable of the specification keeps the time when the event last happened, so it has the life of other variables: it
is saved, restored, undone, and each slice has its own. It is -1 before the first time. The event's function assigns it
after the action, unless the action dropped the message or faulted.
"""

import math
from collections.abc import Iterator

from rosmop.check.assignables import Value, Variable
from rosmop.check.scope import CompilationContext, FunctionScope, SpecificationNames
from rosmop.form import nodes
from rosmop.form.findings import SpecificationError
from rosmop.text import tree
from rosmop.types import value_types
from rosmop.types.messages import nearest, shown

FUNCTIONS = frozenset({"age", "seen"})
NEVER = nodes.Literal(value_types.LONG, -1)


def declare_ages(
    shared: CompilationContext, names: SpecificationNames, specification: tree.Specification
) -> None:
    """Declare a variable for each event whose age the specification uses."""
    events = {event.name: event for event in specification.events}
    names.events = [event.name for event in specification.events if _has_message(event)]
    for name in dict.fromkeys(_asked(specification)):
        if name in names.events:
            code, position = shared.symbols.fresh("g"), events[name].position
            variable = Variable(_name(name), value_types.LONG, code, position, shared=True, constant=True)
            variable.sliced = bool(names.parameters)
            shared.declare(names, variable)


def ages_of(names: SpecificationNames) -> Iterator[Variable]:
    """Yield the variables of events whose age the specification uses."""
    return (names.variables[_name(event)] for event in names.events if _name(event) in names.variables)


def note_age(scope: FunctionScope, event: str) -> bool:
    """Write the assignment of the time when an event happens; return whether its age is used."""
    variable = scope.names.variables.get(_name(event))
    if variable is None:
        return False
    scope.written.add(variable.code)
    scope.evaluate(nodes.Assign(variable.type, variable.code, _NOW))
    return True


def age_or_seen(scope: FunctionScope, node: tree.CallExpression, function: str) -> Value:
    """Compile a call of `age` or `seen`."""
    variable = scope.names.variables[_name(_event(scope, node, function))]
    last = nodes.Read(variable.type, variable.code)
    if function == "seen":
        return Value(nodes.Compare("!=", last, NEVER, scope.site(node)), node.position)
    site = scope.site(node)
    past = nodes.Arithmetic(value_types.LONG, "-", _NOW, last, site)
    seconds = nodes.Arithmetic(
        value_types.DOUBLE, "/", nodes.Convert(value_types.DOUBLE, past), _BILLION, site
    )
    # A clock that went back leaves times in the future. Their age is unknown, so it is infinite.
    unknown = nodes.Logical(
        "or", nodes.Compare("==", last, NEVER, site), nodes.Compare(">", last, _NOW, site)
    )
    infinite = nodes.Literal(value_types.DOUBLE, math.inf)
    return Value(nodes.Conditional(value_types.DOUBLE, unknown, infinite, seconds), node.position)


_NOW = nodes.Call(value_types.LONG, "m_whole", (nodes.Now(),))
_BILLION = nodes.Literal(value_types.DOUBLE, 1e9)


def _event(scope: FunctionScope, node: tree.CallExpression, function: str) -> str:
    name = _argument(node)
    if name in scope.names.events:
        return name
    where = node.arguments[0].position if len(node.arguments) == 1 else node.position
    hint = nearest(name, scope.names.events) if name else ""
    text = f"`{function}` takes the name of an event with a message"
    raise SpecificationError.at(where, f"{text}; {shown(name)} is not one{hint}" if name else text)


def _asked(specification: tree.Specification) -> Iterator[str]:
    own = {function.name for function in specification.functions}
    for node in tree.walk(specification):
        match node:
            case tree.CallExpression(callee=tree.Name(parts=(function,))) if function in FUNCTIONS - own:
                yield _argument(node)


def _argument(node: tree.CallExpression) -> str:
    """Return the only argument if it is a name; otherwise nothing."""
    match node.arguments:
        case (tree.Name(parts=(name,)),):
            return name
    return ""


def _has_message(event: tree.EventDefinition) -> bool:
    return isinstance(event.trigger, tree.MessageTrigger)


def _name(event: str) -> str:
    """Return the name of the variable, which no text can contain."""
    return f"age({event})"
