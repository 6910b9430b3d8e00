"""Compile initial and assigned values: converted expressions, or `{a, b, c}` for a vector."""

from rosmop.check.conversion import convert
from rosmop.check.scope import FunctionScope
from rosmop.form import nodes
from rosmop.form.findings import SpecificationError
from rosmop.text import tree
from rosmop.types import value_types
from rosmop.types.value_types import Type
from roswire.counted import counted


def converted(scope: FunctionScope, node: tree.Expression, target: Type) -> nodes.Expression:
    if isinstance(node, tree.InitializerList):
        return elements(scope, node, target)
    return convert(scope, scope.value_of(node), target, scope.site(node))


def elements(scope: FunctionScope, node: tree.InitializerList, target: Type) -> nodes.Expression:
    if not isinstance(target, value_types.VectorType):
        if len(node.items) == 1:
            return converted(scope, node.items[0], target)
        if not node.items:
            return nodes.Zero(target)
        raise SpecificationError.at(
            node.position, f"`{{…}}` makes a vector, not a {target}; set its parts one by one"
        )
    if target.length is not None and len(node.items) > target.length:
        raise SpecificationError.at(
            node.items[target.length].position,
            f"more than the {counted(target.length, 'element')} of the array",
        )
    items = tuple(converted(scope, item, target.element) for item in node.items)
    return nodes.Vector(target, items, 0 if target.length is None else target.length - len(items))
