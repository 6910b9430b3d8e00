"""Compile parametric specifications, whose parameters an event binds if it has them by name and type.

A second function of the event returns the bound values, and reads nothing else of the message.
"""

from collections.abc import Iterable, Sequence

from rosmop.check.assignables import Variable
from rosmop.check.scope import CompilationContext, SpecificationNames
from rosmop.form import nodes
from rosmop.form.compiled import EventCode, PropertyCode, Slicing
from rosmop.form.findings import Diagnostic, SpecificationError
from rosmop.logics.bounded import BoundedProperty
from rosmop.logics.interface import CompiledProperty
from rosmop.logics.past_monitors import PastProperty
from rosmop.text import tree
from rosmop.types import value_types
from rosmop.types.messages import quote
from rosmop.types.resolve import resolve

MAX_PARAMETERS = 6

_ACTS = (nodes.Log, nodes.Throttle, nodes.Drop, nodes.StopMessage, nodes.Publish)


def declare_parameters(
    shared: CompilationContext, names: SpecificationNames, specification: tree.Specification
) -> None:
    for parameter in specification.parameters:
        try:
            kind = resolve(parameter.type, shared.messages)
            if not (
                value_types.is_number(kind)
                or isinstance(kind, value_types.StringType | value_types.TimeType | value_types.DurationType)
            ):
                text = f"a parameter of a specification is a string, a number or a time, not {kind}"
                raise SpecificationError.at(parameter.position, text)
            if parameter.name in names.variables:
                raise SpecificationError.at(
                    parameter.position, f"the parameter {quote(parameter.name)} occurs twice"
                )
        except SpecificationError as error:
            shared.findings += error.findings
            names.misdeclared.add(parameter.name)
            continue
        code = shared.symbols.fresh("g")
        variable = Variable(
            parameter.name, kind, code, parameter.position, shared=True, constant=True, sliced=True
        )
        names.parameters[parameter.name] = variable
        shared.variables.declare(names, variable)
    if len(specification.parameters) > MAX_PARAMETERS:
        text = f"a specification has at most {MAX_PARAMETERS} parameters"
        shared.findings.append(Diagnostic(specification.parameters[-1].position, "error", text))


def check_own(names: SpecificationNames, variable: Variable) -> None:
    """Reject slice variables that are not numbers or times, because only the number of slices bounds their memory."""
    if variable.sliced and not (
        value_types.is_number(variable.type)
        or isinstance(variable.type, value_types.TimeType | value_types.DurationType)
    ):
        text = (
            f"each slice of {names.name} has its own {quote(variable.name)}, so it is a number or a time; "
            "write `static` for one that all slices share"
        )
        raise SpecificationError.at(variable.position, text)


def slicing_of(
    shared: CompilationContext,
    names: SpecificationNames,
    events: Iterable[EventCode],
    properties: Iterable[PropertyCode],
) -> Slicing | None:
    if not names.parameters:
        return None
    own = (
        variable
        for variable in names.variables.values()
        if variable.sliced and variable.name not in names.parameters
    )
    functions = [event.function for event in events]
    functions += (name for code in properties for name in code.handlers.values())
    return Slicing(
        tuple((parameter.name, parameter.code, parameter.type) for parameter in names.parameters.values()),
        tuple(variable.code for variable in own),
        _enforces(shared, functions),
    )


def _enforces(shared: CompilationContext, functions: Sequence[str]) -> bool:
    waiting, seen = [*functions], {*functions}
    while waiting:
        function = shared.functions.get(waiting.pop())
        for node in () if function is None else nodes.walk(function.body):
            if isinstance(node, nodes.Drop | nodes.StopMessage | nodes.Publish) or (
                isinstance(node, nodes.WriteBack) and node.writes
            ):
                return True
            if isinstance(node, nodes.Invoke) and node.function not in seen:
                seen.add(node.function)
                waiting.append(node.function)
    return False


def binds(names: SpecificationNames, event: tree.EventDefinition) -> tuple[int, ...]:
    own = {parameter.name for parameter in event.parameters}
    return tuple(number for number, name in enumerate(names.parameters) if name in own)


def creates(specification: tree.Specification, event: tree.EventDefinition) -> bool:
    """Whether a slice may begin with an event: with any event unless there is a `creation event`."""

    def is_marked(event: tree.EventDefinition) -> bool:
        return any(modifier.parts == ("creation",) for modifier in event.modifiers)

    return is_marked(event) or not any(map(is_marked, specification.events))


def acts(function: nodes.Function, shared: CompilationContext) -> bool:
    if not shared.variables.unsliced.isdisjoint(function.shared):
        return True
    return any(
        isinstance(node, _ACTS)
        or (isinstance(node, nodes.WriteBack) and bool(node.writes))
        or (isinstance(node, nodes.Invoke) and not node.function.startswith(nodes.PURE))
        for node in nodes.walk(function.body)
    )


def unsliceable(compiled: CompiledProperty) -> str | None:
    if isinstance(compiled, PastProperty) and compiled.timed:
        return (
            "a formula with several time bounds, or with one that neither begins at 0 nor ends at `inf`, cannot be "
            "sliced: the state of a slice would be unbounded; write a property for each bound"
        )
    if isinstance(compiled, PastProperty):
        return "the formula has too many states to be sliced; split it into several properties"
    if isinstance(compiled, BoundedProperty) and any(compiled.folded.bounds):
        return (
            "a formula that looks back and forward within time bounds cannot be sliced: what a slice keeps of it "
            "has no bound; write a property for each"
        )
    return None


def check_parameters(
    shared: CompilationContext, names: SpecificationNames, specification: tree.Specification
) -> None:
    bound = {number for event in specification.events for number in binds(names, event)}
    for number, (name, variable) in enumerate(names.parameters.items()):
        if number not in bound:
            text = f"no event binds the parameter {quote(name)}: give an event a parameter of that name"
            shared.findings.append(Diagnostic(variable.position, "error", text))
