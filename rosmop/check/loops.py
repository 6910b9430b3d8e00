"""Compile loops and `switch`. Every iteration is charged, so the budget ends every loop."""

from collections.abc import Callable, Sequence

from rosmop.check.assignables import Value, Variable
from rosmop.check.conversion import condition, convert, number
from rosmop.check.order import settle
from rosmop.check.scope import FunctionScope, LoopScope
from rosmop.check.vector_members import element_value
from rosmop.form import nodes
from rosmop.form.findings import Position, SpecificationError
from rosmop.runtime.numbers import wrap
from rosmop.text import tree
from rosmop.types import value_types
from rosmop.types.resolve import resolve
from rosmop.types.value_types import Type

Write = Callable[[FunctionScope, tree.Statement], None]
"""Writes a statement. Loops take it as a parameter because statements and loops contain each other."""

MAX_NESTED = 15
"""The most loops within each other."""


def charge(scope: FunctionScope, node: tree.SyntaxNode) -> None:
    scope.add(nodes.Charge(scope.lines.site, weight(node)))


def weight(node: tree.SyntaxNode) -> int:
    total = 1
    waiting: list[object] = tree.fields_of(node)
    while waiting:
        current = waiting.pop()
        if isinstance(current, tuple):
            waiting += current
        elif isinstance(current, tree.Statement | tree.SwitchCase):
            total += not isinstance(current, tree.Block)
            waiting += tree.fields_of(current)
    return total


def write_while(scope: FunctionScope, node: tree.WhileStatement, write: Write) -> None:
    _enter(scope, node, LoopScope((lambda: _leave_unless(scope, node.condition)) if node.at_end else None))
    with scope.nested() as statements:
        charge(scope, node)
        if not node.at_end:
            _leave_unless(scope, node.condition)
        _block(scope, [node.body], write)
        if node.at_end:
            _leave_unless(scope, node.condition)
    scope.add(nodes.Loop(scope.lines.site, tuple(statements)))
    scope.loops.pop()


def write_for(scope: FunctionScope, node: tree.ForStatement, write: Write) -> None:
    with scope.block():
        if node.start is not None:
            write(scope, node.start)
        step = tree.ExpressionStatement(node.step.position, node.step) if node.step is not None else None
        _enter(scope, node, LoopScope((lambda: write(scope, step)) if step is not None else None))
        with scope.nested() as statements:
            charge(scope, node)
            if node.condition is not None:
                _leave_unless(scope, node.condition)
            _block(scope, [node.body], write)
            if step is not None:
                write(scope, step)
        scope.add(nodes.Loop(scope.lines.site, tuple(statements)))
        scope.loops.pop()


def write_range_for(scope: FunctionScope, node: tree.RangeForStatement, write: Write) -> None:
    values = scope.value_of(node.values)
    by_value = not node.type.reference or node.type.constant
    if not by_value:
        first, values = settle(scope, values)
        for each in first:
            scope.evaluate(each)
    if not isinstance(values.type, value_types.VectorType | value_types.StringType):
        raise SpecificationError.at(values.position, f"{values.type} has no elements to iterate over")
    element = values.type.element if isinstance(values.type, value_types.VectorType) else value_types.CHAR
    kind = element if node.type.name == ("auto",) else resolve(node.type, scope.messages)
    _enter(scope, node, LoopScope(None))
    item = scope.temporary() if by_value else None
    index = "" if item is not None else _first_index(scope, node, values, kind)
    with scope.block(), scope.nested() as statements:
        if item is None:
            _by_reference(scope, node, values, kind, index)
        else:
            _by_value(scope, node, element, kind, item)
        _block(scope, [node.body], write)
    site = scope.lines.site
    scope.add(
        nodes.Loop(site, tuple(statements))
        if item is None
        else nodes.ForEach(site, item, values.form, tuple(statements))
    )
    scope.loops.pop()


def _by_value(
    scope: FunctionScope, node: tree.RangeForStatement, element: Type, kind: Type, item: str
) -> None:
    charge(scope, node)
    read: nodes.Expression = nodes.Read(element, item)
    if element == value_types.CHAR:  # a character of a string; elements of a vector are already signed
        read = nodes.Convert(value_types.CHAR, nodes.Read(value_types.UINT8, item))
    value = Value(read, node.position, owned=node.type.reference)
    variable = scope.local(node.name, kind, node.position, constant=node.type.constant)
    scope.evaluate(nodes.Assign(kind, variable.code, convert(scope, value, kind)))


def _first_index(scope: FunctionScope, node: tree.RangeForStatement, values: Value, kind: Type) -> str:
    if not isinstance(values.type, value_types.VectorType) or values.place is None:
        raise SpecificationError.at(
            node.values.position, "a reference needs a vector variable to iterate over; leave out the `&`"
        )
    if values.type.element != kind:
        raise SpecificationError.at(node.type.position, f"the elements are {values.type.element}, not {kind}")
    index = scope.temporary("i")
    scope.evaluate(nodes.Assign(value_types.LONG, index, nodes.Literal(value_types.LONG, -1)))
    return index


def _by_reference(
    scope: FunctionScope, node: tree.RangeForStatement, values: Value, kind: Type, index: str
) -> None:
    charge(scope, node)
    site, at = scope.lines.site, nodes.Read(value_types.LONG, index)
    one = nodes.Literal(value_types.LONG, 1)
    scope.evaluate(
        nodes.Assign(value_types.LONG, index, nodes.Arithmetic(value_types.LONG, "+", at, one, site))
    )
    length = nodes.Call(value_types.LONG, "l_len", (values.form,))
    scope.add(nodes.If(site, nodes.Compare(">=", at, length, site), (nodes.Break(site),), ()))
    alias = element_value(values, Value(at, node.position), node.position, site)
    scope.declare(Variable(node.name, kind, index, node.position, alias=alias))


def write_switch(scope: FunctionScope, node: tree.SwitchStatement, write: Write) -> None:
    value = scope.value_of(node.value)
    kind = value_types.promote(value.type)
    if not isinstance(kind, value_types.IntegerType):
        raise SpecificationError.at(value.position, f"`switch` needs an integer; this is {value.type}")
    start, flag = scope.temporary(), scope.temporary("k")
    table, default = _cases(scope, node, kind)
    site = scope.lines.site
    nothing = nodes.Literal(value_types.BOOL, False)
    scope.evaluate(nodes.Assign(value_types.BOOL, flag, nothing))
    scope.add(nodes.Select(site, start, number(value.form, kind), table, default))
    _enter(scope, node, LoopScope(None, flag=flag))
    with scope.block() as names, scope.nested() as statements:
        for index, case in enumerate(node.cases):
            if case.statements:
                with scope.nested() as inner:
                    _statements(scope, case.statements, write)
                reached = nodes.Compare(
                    "<=", nodes.Read(value_types.INT, start), nodes.Literal(value_types.INT, index), site
                )
                scope.add(nodes.If(site, reached, tuple(inner), ()))
        scope.add(nodes.Break(site))
    for variable in names.values():  # a case may jump past the declaration
        scope.evaluate(nodes.Assign(variable.type, variable.code, nodes.Zero(variable.type)))
    scope.add(nodes.Loop(site, tuple(statements)))
    loop = scope.loops.pop()
    if loop.continued:
        with scope.nested() as going_on:
            write_continue(scope, node.position)
        scope.add(nodes.If(site, nodes.Read(value_types.BOOL, flag), tuple(going_on), ()))


def _cases(
    scope: FunctionScope, node: tree.SwitchStatement, kind: value_types.IntegerType
) -> tuple[tuple[tuple[int, int], ...], int]:
    table: dict[int, int] = {}
    default = len(node.cases)
    for index, case in enumerate(node.cases):
        if case.value is None:
            default = index
            continue
        value = scope.value_of(case.value)
        constant = value.constant
        if not isinstance(constant, int):
            raise SpecificationError.at(
                case.value.position, "a case needs a constant: a number or a character"
            )
        if not -(1 << kind.bits - 1) <= constant < 1 << kind.bits:
            raise SpecificationError.at(
                case.value.position,
                f"case {int(constant)} can never match: {kind} holds {kind.least} to {kind.most}",
            )
        wanted = wrap(int(constant), kind.bits, kind.signed)
        if wanted in table:
            raise SpecificationError.at(case.value.position, f"case {wanted} occurs twice")
        table[wanted] = index
    return tuple(table.items()), default


def write_continue(scope: FunctionScope, position: Position) -> None:
    if all(loop.flag is not None for loop in scope.loops):
        raise SpecificationError.at(position, "`continue` is only allowed in a loop")
    loop = scope.loops[-1]
    if loop.flag is not None:
        loop.continued = True
        scope.evaluate(nodes.Assign(value_types.BOOL, loop.flag, nodes.Literal(value_types.BOOL, True)))
        scope.add(nodes.Break(scope.lines.site))
        return
    if loop.step is not None:
        with scope.around(loop):
            loop.step()
    scope.add(nodes.Continue(scope.lines.site))


def _enter(scope: FunctionScope, node: tree.SyntaxNode, loop: LoopScope) -> None:
    if len(scope.loops) >= MAX_NESTED:
        raise SpecificationError.at(
            node.position, f"more than {MAX_NESTED} nested loops; use helper functions"
        )
    scope.enter(loop)


def _leave_unless(scope: FunctionScope, node: tree.Expression) -> None:
    with scope.at(node):
        site = scope.lines.site
        with scope.looking():
            left = nodes.Not(condition(scope.value_of(node)))
        scope.add(nodes.If(site, left, (nodes.Break(site),), ()))


def body(
    scope: FunctionScope, statements: Sequence[tree.Statement], write: Write
) -> tuple[nodes.Statement, ...]:
    with scope.nested() as found:
        _block(scope, statements, write)
    return tuple(found)


def _block(scope: FunctionScope, statements: Sequence[tree.Statement], write: Write) -> None:
    with scope.block():
        _statements(scope, statements, write)


def _statements(scope: FunctionScope, statements: Sequence[tree.Statement], write: Write) -> None:
    for statement in statements:
        write(scope, statement)
