"""What a variable is initialised or assigned with: an expression that converts, or `{a, b, c}` for a vector."""

from appliance.rosmop.compile.conversion import convert
from appliance.rosmop.compile.scope import Scope
from appliance.rosmop.ir import form
from appliance.rosmop.syntax import tree
from appliance.rosmop.syntax.errors import SpecificationError
from appliance.rosmop.types import kinds
from appliance.rosmop.types.kinds import Type


def converted(scope: Scope, node: tree.Expression, target: Type) -> form.Expression:
    """An expression as a value of the target type; `{…}` makes a vector."""
    if isinstance(node, tree.Elements):
        return elements(scope, node, target)
    return convert(scope, scope.value_of(node), target, scope.site(node))


def elements(scope: Scope, node: tree.Elements, target: Type) -> form.Expression:
    """`{a, b, c}` as a vector."""
    if not isinstance(target, kinds.Vector):
        if len(node.items) == 1:
            return converted(scope, node.items[0], target)
        if not node.items:
            return form.Zero(target)
        raise SpecificationError.at(
            node.position, f"`{{…}}` makes a vector, not a {target}; set its parts one by one"
        )
    if target.length is not None and len(node.items) > target.length:
        raise SpecificationError.at(
            node.items[target.length].position, f"more than the {target.length} elements of the array"
        )
    items = tuple(converted(scope, item, target.element) for item in node.items)
    return form.Vector(target, items, 0 if target.length is None else target.length - len(items))
