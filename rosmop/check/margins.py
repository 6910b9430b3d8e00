"""Note how close comparisons of numbers came: both sides when they were nearest, while true and while false.

The noting expression has the same value, compares the sides in the same type, and charges nothing.
Comparisons in `when`, first values and `init` are not noted, nor are loop conditions, whose distance from the
end means nothing.
"""

from dataclasses import replace

import msgspec

from rosmop.check.assignables import Value
from rosmop.check.conversion import number
from rosmop.check.scope import FunctionScope
from rosmop.form import nodes
from rosmop.form.compiled import Comparison
from rosmop.text import tree
from rosmop.types import value_types

MOST_NOTED = 32

_COMPARED = frozenset({"<", "<=", ">", ">="})
_TRUE, _FALSE = (nodes.Literal(value_types.BOOL, truth) for truth in (True, False))


def noted(
    scope: FunctionScope, node: tree.BinaryExpression, left: Value, right: Value, value: Value
) -> Value:
    compare = value.form
    if (
        not scope.notes
        or node.operator not in _COMPARED
        or not isinstance(compare, nodes.Compare)
        or not value_types.is_number(compare.left.type)
    ):
        return value
    known = scope.names.comparisons
    if node not in known:
        if len(known) >= MOST_NOTED:
            return value
        variables = [(scope.symbols.fresh("g"), scope.symbols.fresh("g")) for _truth in range(2)]
        constant = (side for side, operand in enumerate((left, right)) if operand.constant is not None)
        known[node] = Comparison(node.position, next(constant, None), *variables)
    comparison = known[node]
    scope.effects.written.update(comparison.variables)
    kind = compare.left.type
    sides = [nodes.Read(kind, scope.temporary()) for _side in range(2)]
    kept = (
        nodes.Assign(kind, side.name, operand)
        for side, operand in zip(sides, (compare.left, compare.right), strict=True)
    )
    now = [number(side, value_types.DOUBLE) for side in sides]
    answer = nodes.Conditional(
        value_types.BOOL,
        msgspec.structs.replace(compare, left=sides[0], right=sides[1]),
        nodes.Sequence(value_types.BOOL, (_note(now, comparison.when_true), _TRUE), -1),
        nodes.Sequence(value_types.BOOL, (_note(now, comparison.when_false), _FALSE), -1),
    )
    return replace(value, form=nodes.Sequence(value_types.BOOL, (*kept, answer), -1))


def _note(now: list[nodes.Expression], variables: tuple[str, str]) -> nodes.Expression:
    before = [nodes.Read(value_types.DOUBLE, name) for name in variables]
    nearer = nodes.Compare("<", _distance(*now), _distance(*before), -1)
    kept = (nodes.Assign(value_types.DOUBLE, name, side) for name, side in zip(variables, now, strict=True))
    return nodes.Logical("and", nearer, nodes.Sequence(value_types.BOOL, (*kept, _TRUE), -1))


def _distance(left: nodes.Expression, right: nodes.Expression) -> nodes.Expression:
    return nodes.Unary(value_types.DOUBLE, "abs", nodes.Arithmetic(value_types.DOUBLE, "-", left, right, -1))
