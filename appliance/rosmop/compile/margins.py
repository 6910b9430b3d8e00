"""How close comparisons of numbers came: of each the sides when they were nearest, while it was true and while not.

In the place of a comparison stands an expression that notes its sides and has the same value: they are compared as the
type that C++ compares them as, and nothing is charged. Left alone are conditions of loops (how close a counter came to
its end says nothing), what `when` looks at, first values and `init`.
"""

from dataclasses import replace

import msgspec

from appliance.rosmop.compile.conversion import number
from appliance.rosmop.compile.places import Value
from appliance.rosmop.compile.scope import Scope
from appliance.rosmop.compiled import Comparison
from appliance.rosmop.ir import form
from appliance.rosmop.syntax import tree
from appliance.rosmop.types import kinds

MOST_NOTED = 32
"""Comparisons of a specification; those that are compiled after them are not noted."""

_COMPARED = frozenset({"<", "<=", ">", ">="})
_TRUE, _FALSE = (form.Literal(kinds.BOOL, truth) for truth in (True, False))


def noted(scope: Scope, node: tree.Binary, left: Value, right: Value, value: Value) -> Value:
    """The value of `left operator right`, noted if that is a comparison of numbers which are not both known."""
    compare = value.form
    if (
        not scope.notes
        or node.operator not in _COMPARED
        or not isinstance(compare, form.Compare)
        or not kinds.is_number(compare.left.type)
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
    scope.written.update(comparison.variables)
    kind = compare.left.type
    sides = [form.Read(kind, scope.temporary()) for _side in range(2)]
    kept = (
        form.Assign(kind, side.name, operand)
        for side, operand in zip(sides, (compare.left, compare.right), strict=True)
    )
    now = [number(side, kinds.DOUBLE) for side in sides]
    answer = form.Conditional(
        kinds.BOOL,
        msgspec.structs.replace(compare, left=sides[0], right=sides[1]),
        form.Sequence(kinds.BOOL, (_note(now, comparison.when_true), _TRUE), -1),
        form.Sequence(kinds.BOOL, (_note(now, comparison.when_false), _FALSE), -1),
    )
    return replace(value, form=form.Sequence(kinds.BOOL, (*kept, answer), -1))


def _note(now: list[form.Expression], variables: tuple[str, str]) -> form.Expression:
    """Keep the sides if they are nearer to each other than those that are kept."""
    before = [form.Read(kinds.DOUBLE, name) for name in variables]
    nearer = form.Compare("<", _distance(*now), _distance(*before), -1)
    kept = (form.Assign(kinds.DOUBLE, name, side) for name, side in zip(variables, now, strict=True))
    return form.Logical("and", nearer, form.Sequence(kinds.BOOL, (*kept, _TRUE), -1))


def _distance(left: form.Expression, right: form.Expression) -> form.Expression:
    return form.Unary(kinds.DOUBLE, "abs", form.Arithmetic(kinds.DOUBLE, "-", left, right, -1))
