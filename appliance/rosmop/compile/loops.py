"""Loops and `switch` as code. Every iteration is charged, so that no loop outlives its budget."""

from collections.abc import Callable, Sequence

from appliance.rosmop.compile.conversion import condition, convert, number
from appliance.rosmop.compile.expressions import value_of
from appliance.rosmop.compile.places import Value, Variable
from appliance.rosmop.compile.scope import Loop, Scope
from appliance.rosmop.compile.vector_members import element_value
from appliance.rosmop.positions import Position
from appliance.rosmop.runtime.numbers import wrap
from appliance.rosmop.syntax import tree
from appliance.rosmop.syntax.errors import SpecificationError
from appliance.rosmop.types import kinds
from appliance.rosmop.types.kinds import Type
from appliance.rosmop.types.resolve import resolve

Write = Callable[[Scope, tree.Statement], None]
"""Writes a statement; handed in, because statements contain loops and loops contain statements."""

MAX_NESTED = 15
"""Loops inside each other; Python takes no more than 20."""


def charge(scope: Scope, node: tree.Node) -> None:
    """Write the lines that charge for one iteration (or one call)."""
    context = scope.context
    scope.lines.add(f"{context}.budget -= {weight(node)}")
    scope.lines.add(f"if {context}.budget < 0: {context}.spend(0, {scope.lines.site})")


def weight(node: tree.Node) -> int:
    """How many instructions an iteration (or a call) is charged: one, and one for each statement in the body."""
    total = 1
    waiting: list[object] = [getattr(node, name) for name in node.__dataclass_fields__]
    while waiting:
        current = waiting.pop()
        if isinstance(current, tuple):
            waiting += current
        elif isinstance(current, tree.Statement | tree.Case):
            total += not isinstance(current, tree.Block)
            waiting += [getattr(current, name) for name in current.__dataclass_fields__]
    return total


def write_while(scope: Scope, node: tree.Statement, write: Write) -> None:
    """`while` and `do … while`."""
    assert isinstance(node, tree.While)  # so says the table in statements.py
    _enter(scope, node, Loop(False))
    scope.lines.add("while True:")
    with scope.indented():
        charge(scope, node)
        if node.at_end:
            scope.loops[-1].step = lambda: _leave_unless(scope, node.condition)
        else:
            _leave_unless(scope, node.condition)
    write_body(scope, [node.body], write)
    if node.at_end:
        with scope.indented():
            _leave_unless(scope, node.condition)
    scope.loops.pop()


def write_for(scope: Scope, node: tree.Statement, write: Write) -> None:
    """`for (start; condition; step)`."""
    assert isinstance(node, tree.For)
    with scope.block():
        if node.start is not None:
            write(scope, node.start)
        step = tree.Evaluate(node.step.position, node.step) if node.step is not None else None
        _enter(scope, node, Loop(False, (lambda: write(scope, step)) if step is not None else None))
        scope.lines.add("while True:")
        with scope.indented():
            charge(scope, node)
            if node.condition is not None:
                _leave_unless(scope, node.condition)
        write_body(scope, [node.body], write)
        if step is not None:
            with scope.indented():
                write(scope, step)
        scope.loops.pop()


def write_range_for(scope: Scope, node: tree.Statement, write: Write) -> None:
    """`for (type name : values)`."""
    assert isinstance(node, tree.RangeFor)
    values = value_of(scope, node.values)
    if not isinstance(values.type, kinds.Vector | kinds.String):
        raise SpecificationError.at(values.position, f"{values.type} has no elements to go through")
    element = values.type.element if isinstance(values.type, kinds.Vector) else kinds.CHAR
    kind = element if node.type.name == ("auto",) else resolve(node.type, scope.messages)
    _enter(scope, node, Loop(False))
    with scope.block():
        if node.type.reference and not node.type.constant:
            _by_reference(scope, node, values, kind)
        else:
            _by_value(scope, node, values, element, kind)
        write_body(scope, [node.body], write)
    scope.loops.pop()


def _by_value(scope: Scope, node: tree.RangeFor, values: Value, element: Type, kind: Type) -> None:
    each = scope.temporary()
    scope.lines.add(f"for {each} in {values.code}:")
    with scope.indented():
        charge(scope, node)
        code = f"(({each} + 128 & 255) - 128)" if isinstance(values.type, kinds.String) else each
        value = Value(element, code, node.position, owned=node.type.reference)
        variable = scope.local(node.name, kind, node.position, constant=node.type.constant)
        scope.lines.add(f"{variable.code} = {convert(scope, value, kind)}")


def _by_reference(scope: Scope, node: tree.RangeFor, values: Value, kind: Type) -> None:
    if not isinstance(values.type, kinds.Vector) or values.place is None or not values.pure:
        raise SpecificationError.at(
            node.values.position, "a reference goes through a vector variable; leave out the `&`"
        )
    if values.type.element != kind:
        raise SpecificationError.at(node.type.position, f"the elements are {values.type.element}, not {kind}")
    index = scope.temporary("i")
    scope.lines.add(f"{index} = -1")
    scope.lines.add("while True:")
    with scope.indented():
        charge(scope, node)
        scope.lines.add(f"{index} += 1")
        scope.lines.add(f"if {index} >= l_len({values.code}): break")
    at = Value(kinds.LONG, index, node.position)
    alias = element_value(scope, values, at, node.position, scope.lines.site)
    scope.declare(Variable(node.name, kind, index, node.position, alias=alias))


def write_switch(scope: Scope, node: tree.Statement, write: Write) -> None:
    """`switch`: the index of the first case, then every block from there on until a `break`."""
    assert isinstance(node, tree.Switch)
    value = value_of(scope, node.value)
    kind = kinds.promoted(value.type)
    if not isinstance(kind, kinds.Integer):
        raise SpecificationError.at(value.position, f"`switch` needs an integer; this is {value.type}")
    start, flag = scope.temporary(), scope.temporary("k")
    table, default = _cases(scope, node, kind)
    selected = number(value.code, value.type, kind)
    scope.lines.add(f"{flag} = False")
    scope.lines.add(f"{start} = {{{table}}}.get({selected}, {default})")
    _enter(scope, node, Loop(True, continued=flag))
    before = len(scope.lines.lines)
    scope.lines.add("while True:")
    with scope.block() as names, scope.indented():
        for index, case in enumerate(node.cases):
            if case.statements:
                scope.lines.add(f"if {start} <= {index}:")
                _statements(scope, case.statements, write)
        scope.lines.add("break")
    _write_zeros(scope, names, before)
    loop = scope.loops.pop()
    if loop.step is not None:
        scope.lines.add(f"if {flag}:")
        with scope.indented():
            write_continue(scope, node.position)


def _write_zeros(scope: Scope, names: dict[str, Variable], before: int) -> None:
    """Give the variables of a `switch` a value before it: a case may jump over the declaration."""
    lines, scope.lines.lines = scope.lines.lines, []
    for variable in names.values():
        scope.lines.add(f"{variable.code} = {scope.codecs.zero(variable.type)}")
    scope.lines.lines = [*lines[:before], *scope.lines.lines, *lines[before:]]


def _cases(scope: Scope, node: tree.Switch, kind: kinds.Integer) -> tuple[str, int]:
    table: dict[int, int] = {}
    default = len(node.cases)
    for index, case in enumerate(node.cases):
        if case.value is None:
            default = index
            continue
        value = value_of(scope, case.value)
        constant = value.constant
        if not isinstance(constant, int):
            raise SpecificationError.at(
                case.value.position, "a case needs a constant: a number or a character"
            )
        if not -(1 << kind.bits - 1) <= constant < 1 << kind.bits:
            raise SpecificationError.at(
                case.value.position,
                f"case {int(constant)} can never be: {kind} holds {kind.least} to {kind.most}",
            )
        wanted = wrap(int(constant), kind.bits, kind.signed)
        if wanted in table:
            raise SpecificationError.at(case.value.position, f"case {wanted} occurs twice")
        table[wanted] = index
    return ", ".join(f"{constant}: {index}" for constant, index in table.items()), default


def write_continue(scope: Scope, position: Position) -> None:
    """`continue`: the step of the innermost loop, then its next iteration."""
    if not any(not loop.is_switch for loop in scope.loops):
        raise SpecificationError.at(position, "`continue` stands in a loop")
    loop = scope.loops[-1]
    if loop.is_switch:
        loop.step = lambda: None
        scope.lines.add(f"{loop.continued} = True")
        scope.lines.add("break")
        return
    if loop.step is not None:
        with scope.around(loop):
            loop.step()
    scope.lines.add("continue")


def _enter(scope: Scope, node: tree.Node, loop: Loop) -> None:
    if len(scope.loops) >= MAX_NESTED:
        raise SpecificationError.at(
            node.position, f"more than {MAX_NESTED} loops inside each other; use helper functions"
        )
    scope.enter(loop)


def _leave_unless(scope: Scope, node: tree.Expression) -> None:
    with scope.at(node):
        scope.lines.add(f"if not {condition(value_of(scope, node))}: break")


def write_body(scope: Scope, statements: Sequence[tree.Statement], write: Write) -> None:
    """Write statements one step deeper, in a block of names of their own."""
    with scope.block():
        _statements(scope, statements, write)


def _statements(scope: Scope, statements: Sequence[tree.Statement], write: Write) -> None:
    """Write statements one step deeper; `pass` if nothing comes of them."""
    with scope.indented():
        before = len(scope.lines.lines)
        for statement in statements:
            write(scope, statement)
        if len(scope.lines.lines) == before:
            scope.lines.add("pass")
