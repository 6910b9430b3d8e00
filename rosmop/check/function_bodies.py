"""Compile helper functions, `init`, first values and handlers."""

from collections.abc import Callable, Iterable, Mapping, Set
from typing import TypeVar

from rosmop.check.assignables import Value, Variable
from rosmop.check.conversion import convert
from rosmop.check.event_facts import first_facts
from rosmop.check.function_library import ELEMENTARY, FREE
from rosmop.check.loops import charge
from rosmop.check.scope import CompilationContext, FunctionScope, HelperFunction, SpecificationNames
from rosmop.check.slicing import check_own
from rosmop.check.statements import initial, literal_constant, table, write
from rosmop.form import nodes
from rosmop.form.findings import SpecificationError
from rosmop.text import tree
from rosmop.types import value_types
from rosmop.types.messages import quote
from rosmop.types.resolve import resolve

_T = TypeVar("_T")
_TAKEN = frozenset({"MESSAGE", "PUBLISH", "DROP", "init"})


def declare_variables(
    shared: CompilationContext, names: SpecificationNames, specification: tree.Specification
) -> None:
    for declaration in specification.declarations:
        for declarator in declaration.declarators:
            try:
                variable = _shared_variable(shared, names, declaration, declarator)
                check_own(names, variable)
            except SpecificationError as error:
                shared.findings += error.findings
                names.misdeclared.add(declarator.name)
                continue
            shared.variables.declare(names, variable)


def _shared_variable(
    shared: CompilationContext,
    names: SpecificationNames,
    declaration: tree.Declaration,
    declarator: tree.Declarator,
) -> Variable:
    if declarator.name in names.variables or declarator.name in _TAKEN:
        raise SpecificationError.at(declarator.position, f"{quote(declarator.name)} is declared twice")
    scope = FunctionScope(shared, names, "init")
    scope.lines.site = scope.site(declaration)
    automatic = declaration.type.name == ("auto",)
    if automatic and _constant(scope, declarator) is None:
        raise SpecificationError.at(
            declaration.position,
            "a shared variable needs a type; `auto` is for local variables, and for constants with a literal value",
        )
    value = declarator.value if automatic or (declarator.is_array and declarator.size is None) else None
    if declarator.is_array and value is None and isinstance(declarator.value, tree.InitializerList):
        value = tree.InitializerList(declarator.value.position, ())
    kind, _ = initial(scope, declaration.type, tree.Declarator(
        declarator.position, declarator.name, size=declarator.size, is_array=declarator.is_array, value=value,
    ))  # fmt: skip
    return Variable(
        declarator.name,
        kind,
        shared.symbols.fresh("g"),
        declarator.position,
        shared=True,
        constant=declaration.type.constant,
        known=_known(scope, declaration, declarator, kind, literal_constant),
        table=_known(scope, declaration, declarator, kind, table),
        sliced=bool(names.parameters) and not (declaration.type.static or declaration.type.constant),
    )


def _known(
    scope: FunctionScope,
    declaration: tree.Declaration,
    declarator: tree.Declarator,
    kind: value_types.Type,
    value_of: Callable[[FunctionScope, tree.TypeName, tree.Declarator, value_types.Type], _T | None],
) -> _T | None:
    try:
        return value_of(scope, declaration.type, declarator, kind)
    except SpecificationError:
        return None


def compile_start(
    shared: CompilationContext, names: SpecificationNames, specification: tree.Specification
) -> tuple[str, ...]:
    """Write the functions that start a specification: constants and zeros, first values, `init`.

    Each stage runs for all specifications before the next one, because a specification may read another's variables.
    """
    scopes = [
        _constants(shared, names, specification),
        _first_values(shared, names, specification),
        _start_scope(shared, names),
    ]
    for init in specification.inits:
        write(scopes[-1], init.body)
    if len(specification.inits) > 1:
        raise SpecificationError.at(specification.inits[1].position, "`init` occurs twice")
    functions = tuple(shared.symbols.fresh("i") for _ in scopes)
    for scope, function in zip(scopes, functions, strict=True):
        shared.define(scope.function(function, ()))
    return functions


def _start_scope(shared: CompilationContext, names: SpecificationNames) -> FunctionScope:
    scope = FunctionScope(shared, names, "init")
    scope.handled.drop_refused = "there is no message yet"
    return scope


def _constants(
    shared: CompilationContext, names: SpecificationNames, specification: tree.Specification
) -> FunctionScope:
    scope = _start_scope(shared, names)
    for parameter in names.parameters.values():
        scope.effects.written.add(parameter.code)
        scope.evaluate(nodes.Assign(parameter.type, parameter.code, nodes.Zero(parameter.type)))
    for assignment in first_facts(names):
        scope.effects.written.add(assignment.name)
        scope.evaluate(assignment)
    for declaration in specification.declarations:
        for declarator in declaration.declarators:
            variable = names.variables.get(declarator.name)
            if variable is not None:
                scope.effects.written.add(variable.code)
                value = _constant(scope, declarator)
                first: nodes.Expression = nodes.Zero(variable.type)
                if value is not None and value_types.convertible(value.type, variable.type):
                    first = convert(scope, value, variable.type)
                scope.evaluate(nodes.Assign(variable.type, variable.code, first))
    return scope


def _constant(scope: FunctionScope, declarator: tree.Declarator) -> Value | None:
    if declarator.is_array or declarator.value is None or isinstance(declarator.value, tree.InitializerList):
        return None
    try:
        value = scope.value_of(declarator.value)
    except SpecificationError:
        return None
    return value if value.constant is not None else None


def _first_values(
    shared: CompilationContext, names: SpecificationNames, specification: tree.Specification
) -> FunctionScope:
    scope = _start_scope(shared, names)
    scope.below = set(names.variables)
    for declaration in specification.declarations:
        for declarator in declaration.declarators:
            variable = names.variables.get(declarator.name)
            scope.below.discard(declarator.name)
            if variable is None:
                continue
            try:
                _first_value(scope, declaration, declarator, variable)
            except SpecificationError as error:
                shared.findings += error.findings
    return scope


def _first_value(
    scope: FunctionScope, declaration: tree.Declaration, declarator: tree.Declarator, variable: Variable
) -> None:
    with scope.at(declarator):
        _, value = initial(scope, declaration.type, declarator)
        scope.effects.written.add(variable.code)
        scope.evaluate(nodes.Assign(variable.type, variable.code, value))


def declare_functions(
    shared: CompilationContext, names: SpecificationNames, specification: tree.Specification
) -> None:
    for node in specification.functions:
        try:
            names.functions[node.name] = _signature(shared, names, node)
        except SpecificationError as error:
            shared.findings += error.findings
            names.misdeclared.add(node.name)
    called = _calls(names)
    for name, function in names.functions.items():
        reached = _reachable(called[name], called)
        function.recursive = name in reached
        if function.references:
            function.names = frozenset().union(
                *(_free_names(names.functions[callee].node) for callee in {name, *reached})
            )


def _calls(names: SpecificationNames) -> dict[str, set[str]]:
    known = names.functions
    return {name: {*_called_names(function.node.body)} & known.keys() for name, function in known.items()}


def topics_of(names: SpecificationNames, function: str) -> list[str]:
    reached = _reachable({function}, _calls(names))
    found = (node for name in reached for node in tree.walk(names.functions[name].node.body))
    return sorted({node.topic for node in found if isinstance(node, tree.PublishStatement)})


def _signature(
    shared: CompilationContext, names: SpecificationNames, node: tree.FunctionDefinition
) -> HelperFunction:
    if node.name in names.functions or node.name in _TAKEN:
        raise SpecificationError.at(node.position, f"the function {quote(node.name)} is declared twice")
    result = value_types.VOID if node.type is None else resolve(node.type, shared.messages)
    parameters = []
    references = []
    for parameter in node.parameters:
        kind = resolve(parameter.type, shared.messages)
        variable = Variable(
            parameter.name,
            kind,
            shared.symbols.fresh("v"),
            parameter.position,
            constant=parameter.type.constant and parameter.type.reference,
            copied=(kind == value_types.CHARACTERS and not parameter.type.reference)
            or parameter.type.name == ("[]",),
        )
        parameters.append(variable)
        if parameter.type.reference and not parameter.type.constant:
            references.append(variable)
    return HelperFunction(
        node.name, shared.symbols.fresh("h"), result, tuple(parameters), tuple(references), node
    )


def _reachable(first: Set[str], called: Mapping[str, Set[str]]) -> set[str]:
    seen = set(first)
    waiting = list(first)
    while waiting:
        further = called[waiting.pop()] - seen
        seen |= further
        waiting += further
    return seen


def _called_names(node: tree.SyntaxNode) -> Iterable[str]:
    for inner in tree.walk(node):
        if isinstance(inner, tree.CallExpression) and isinstance(inner.callee, tree.Name):
            yield inner.callee.parts[-1]


def _free_names(function: tree.FunctionDefinition) -> set[str]:
    inside = list(tree.walk(function.body))
    own = {inner.name for inner in inside if isinstance(inner, tree.Declarator | tree.RangeForStatement)}
    own |= {parameter.name for parameter in function.parameters}
    return {
        inner.parts[0] for inner in inside if isinstance(inner, tree.Name) and len(inner.parts) == 1
    } - own


def compile_library(shared: CompilationContext, names: SpecificationNames) -> None:
    inside = SpecificationNames(names.name, names.context, instances=names.instances, is_library=True)
    written = 0
    while written < len(names.instances):
        function = [*names.instances.values()][written]
        compile_function(shared, inside, function)
        written += 1


def compile_function(shared: CompilationContext, names: SpecificationNames, function: HelperFunction) -> None:
    scope = FunctionScope(shared, names, "function")
    scope.notes = scope.notes and not names.is_library
    scope.handled.drop_refused = "a function has no message; return a `bool` and drop in the action"
    scope.result, scope.references, scope.recursive = function.result, function.references, function.recursive
    for variable in function.parameters:
        scope.declare(variable)
    with scope.at(function.node):
        if not (names.is_library and function.name in FREE):
            charge(scope, function.node.body)
        if function.recursive:
            scope.add(nodes.LimitDepth(scope.lines.site, function.name))
        write(scope, function.node.body)
        nothing = nodes.Literal(value_types.VOID, None)
        value = nothing if isinstance(function.result, value_types.VoidType) else nodes.Zero(function.result)
        handed = tuple(variable.code for variable in function.references)
        scope.add(nodes.Return(scope.lines.site, value, handed))
    function.changes, function.calls = frozenset(scope.effects.shared), frozenset(scope.effects.calls)
    parameters = [variable.code for variable in function.parameters] + ["n"] * function.recursive
    same_as = f"h_{function.name}" if names.is_library and function.name in ELEMENTARY else ""
    shared.define(scope.function(function.code, tuple(parameters), same_as=same_as))


def compile_handler(
    shared: CompilationContext, names: SpecificationNames, handler: tree.Handler, drop_refused: str | None
) -> str:
    scope = FunctionScope(shared, names, "handler")
    scope.handled.drop_refused = drop_refused
    write(scope, handler.body)
    function = shared.symbols.fresh("j")
    shared.define(scope.function(function, ("m",)))
    return function
