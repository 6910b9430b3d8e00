"""Which generated code may run on trial: it can be given up at any point, and nothing has happened.

The functions that take a whole batch of messages (`compile/batch.py`) run an event's code before it is certain that
the message needs nothing but that. When something unusual comes (output, a fault, a verdict that is handled), they
take back what they did to this message, and it goes its usual way. That is only right for code whose effects are
known: it reads what it likes, and gives new values to local variables and to shared ones that are named here.

Invariants:
- What is not known to be harmless is not (an allow list of Python's nodes and of the functions generated code calls).
- Values that change in place (vectors, messages) are never changed by harmless code.
"""

import ast

from appliance.rosmop.compile.module import Module
from appliance.rosmop.runtime.numbers import MATH

FUNCTIONS = frozenset({f"h_{name}{suffix}" for name in MATH for suffix in ("", "f")}) | {
    "c_f32", "c_f32_integer", "c_float", "c_terminated", "c_truncate",
    "h_abs", "h_compare", "h_isfinite", "h_isinf", "h_isnan", "h_len", "h_max", "h_min",
    "l_element", "l_len", "m_duration", "m_nanoseconds", "m_time",
    "o_charged", "o_divide", "o_duration", "o_ratio", "o_remainder", "o_scaled", "o_time", "o_weighed",
    "t_bytes", "t_compare", "t_float", "t_member",
    "w_count", "w_len", "w_skip", "w_skip_inner", "w_text", "w_text_end",
}  # fmt: skip
"""Functions without any effect but on the budget, whose time does not depend on what a message says (or only on its
length)."""

_PLAIN = (
    ast.Constant, ast.Name, ast.BinOp, ast.UnaryOp, ast.BoolOp, ast.Compare, ast.IfExp, ast.Tuple,
    ast.operator, ast.unaryop, ast.boolop, ast.cmpop, ast.expr_context,
)  # fmt: skip


class Harmless:
    """Looks at the code of one module."""

    def __init__(self, module: Module) -> None:
        self._module = module
        self._known: dict[str, bool] = {}
        self._structs = {
            name for name, (_, method) in module.structs.items() if method in ("pack", "unpack_from")
        }

    def expression(self, node: ast.expr) -> bool:
        """Whether computing it has no effect but on the variables it names (`:=`)."""
        return all(self._node(part) for part in _parts(node))

    def assignment(self, node: ast.stmt) -> bool:
        """Whether a statement does nothing but to give values to variables."""
        if isinstance(node, ast.Expr):
            return self.expression(node.value)
        if not isinstance(node, ast.Assign) or not all(_names_only(target) for target in node.targets):
            return False
        empty = isinstance(node.value, ast.List) and not node.value.elts
        return empty or self.expression(node.value)

    def _node(self, node: ast.AST) -> bool:
        if isinstance(node, ast.Call):
            return isinstance(node.func, ast.Name) and not node.keywords and self._function(node.func.id)
        if isinstance(node, ast.NamedExpr):
            return isinstance(node.target, ast.Name)
        if isinstance(node, ast.Subscript):
            return isinstance(node.ctx, ast.Load)
        if isinstance(node, ast.Attribute):
            return _is_now(node)
        return isinstance(node, _PLAIN)

    def _function(self, name: str) -> bool:
        if name in FUNCTIONS or name in self._structs:
            return True
        if name not in self._known:
            self._known[name] = False  # one that calls itself is not looked into
            self._known[name] = self._helper(name)
        return self._known[name]

    def _helper(self, name: str) -> bool:
        """A function of the specification, or one that walks through a message.

        What it takes of the budget it takes: should nothing be left, it faults, and the message goes its usual way.
        """
        source = self._module.function(name)
        if source is None:
            return False
        function = ast.parse(source).body[0]
        return isinstance(function, ast.FunctionDef) and self._block(function.body)

    def _block(self, statements: list[ast.stmt]) -> bool:
        return all(self._statement(statement) for statement in statements)

    def _statement(self, node: ast.stmt) -> bool:
        if isinstance(node, ast.Return):
            return node.value is None or self.expression(node.value)
        if isinstance(node, ast.If):
            if charge_of(node):
                return True
            return self.expression(node.test) and self._block(node.body) and self._block(node.orelse)
        return isinstance(node, ast.Pass) or charge_of(node) or self.assignment(node)


def charge_of(node: ast.stmt) -> bool:
    """Whether this is half of what `loops.charge` writes: `c.budget -= n`, and what comes when nothing is left."""
    if isinstance(node, ast.AugAssign):
        return isinstance(node.target, ast.Attribute) and node.target.attr == "budget"
    if isinstance(node, ast.If) and isinstance(node.test, ast.Compare) and not node.orelse:
        return isinstance(node.test.left, ast.Attribute) and node.test.left.attr == "budget"
    return False


def stored(nodes: list[ast.stmt]) -> set[str]:
    """The names that statements give values to."""
    return {
        part.id
        for node in nodes
        for part in ast.walk(node)
        if isinstance(part, ast.Name) and isinstance(part.ctx, ast.Store)
    }


def _names_only(target: ast.expr) -> bool:
    return isinstance(target, ast.Name) or (
        isinstance(target, ast.Tuple) and all(isinstance(element, ast.Name) for element in target.elts)
    )


def _parts(node: ast.expr) -> list[ast.AST]:
    """All nodes of an expression; `c.turn.now` is one."""
    found: list[ast.AST] = []
    waiting: list[ast.AST] = [node]
    while waiting:
        current = waiting.pop()
        found.append(current)
        if isinstance(current, ast.Attribute) and _is_now(current):
            continue
        if isinstance(current, ast.Call):
            waiting += current.args  # the function's name is looked at with the call
            waiting += current.keywords
            continue
        waiting += ast.iter_child_nodes(current)
    return found


def _is_now(node: ast.Attribute) -> bool:
    owner = node.value
    return (
        node.attr == "now"
        and isinstance(owner, ast.Attribute)
        and owner.attr == "turn"
        and isinstance(owner.value, ast.Name)
    )
