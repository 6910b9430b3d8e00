from collections.abc import Collection
from types import UnionType
from typing import get_args

import pytest

from rosmop.check.sources import compiled_from
from rosmop.fast import codegen
from rosmop.fast.slow_paths import slow_paths
from rosmop.form import nodes
from rosmop.prove import form_terms
from rosmop.run import interpreter
from roswire.standard import standard_definitions

GRID = {
    "interpreter, statements": (interpreter.STATEMENTS, nodes.Statement),
    "interpreter, expressions": (interpreter.EXPRESSIONS, nodes.Expression),
    "WebAssembly, statements": (codegen.STATEMENTS, nodes.Statement),
    "WebAssembly, expressions": (codegen.EXPRESSIONS, nodes.Expression),
    "z3, statements": (form_terms.STATEMENTS, nodes.Statement),
    "z3, expressions": (form_terms.EXPRESSIONS, nodes.Expression),
}
"""The certifier (`rosmop/certify`) reads tables of properties, and no statements or expressions."""


@pytest.mark.parametrize("row", GRID)
def test_each_back_end_has_a_row_for_each_kind_of_node(row: str) -> None:
    rows, kinds = GRID[row]
    assert _names(get_args(kinds)) == _names(rows)


def test_each_kind_of_node_is_in_the_grid() -> None:
    parts = {
        "Spot",
        "Skipper",
        "Function",
        "Write",
        "PropertyClock",
        "HandledCategory",
        "Advance",
        "Event",
        "Component",
        "SafeMessage",
    }
    kinds: UnionType = nodes.Expression | nodes.Statement
    assert _names(nodes.FormNode.__subclasses__()) == _names(get_args(kinds)) | parts


def _names(kinds: Collection[type]) -> set[str]:
    return {kind.__name__ for kind in kinds}


HEAD = "s() { int n = 0; geometry_msgs::Twist twist; "
EVENT = "event e(int x) /t std_msgs/Int32 '{data:x}'"
SLOW = {
    "nothing": (f"{EVENT} {{ if (x > 3) {{ return; }} n = x; }}", []),
    "a whole topic": (f"{EVENT} {{\n n = exp(x); }}", [("/t", "", 2, "calls exp")]),
    "a branch": (
        f"{EVENT} {{ if (x > 3) {{\n PUBLISH(/told, geometry_msgs/Twist, twist); }} }}",
        [("/t", "event s.e", 2, "publishes a message")],
    ),
    "a stop": (
        f"safe std_msgs/Int32 {{}} on /other every 1s; event o() /other std_msgs/Int32 '{{}}' {{ }} {EVENT} {{"
        " if (x > 3) {\n STOP; } }",
        [("/t", "event s.e", 2, "publishes safe messages")],
    ),
    "a helper function": (
        f"int f(int x) {{ if (x > 3) {{\n return exp(x); }} return x; }} {EVENT} {{ n = f(x); }}",
        [("/t", "event s.e", 2, "calls exp")],
    ),
    "a handler": (
        f"{EVENT} {{ }} fsm : idle [ e -> idle ] @idle {{\n n = exp(n); }}",
        [("/t", "handler @idle of s", 2, "calls exp")],
    ),
    "time bounds": (
        f"{EVENT} {{ }}\n pattern: globally: no e within 1ms @violation {{ n = 1; }}",
        [("/t", "pattern property of s", 2, "runs a handler of a property with time bounds")],
    ),
    "no automaton": (
        f"{EVENT} {{ }} {EVENT.replace('e(', 'f(').replace('/t', '/u')} {{ }} cfg: S -> e S f | epsilon @fail {{ }}",
        [
            ("/t", "", 1, "reaches a verdict with each message"),
            ("/u", "", 1, "reaches a verdict with each message"),
        ],
    ),
}


@pytest.mark.parametrize("name", SLOW)
def test_slow_paths_have_places_and_reasons(name: str) -> None:
    body, expected = SLOW[name]
    compiled = compiled_from({"s.rv": f"{HEAD}{body} }}"}, standard_definitions())
    paths = slow_paths(compiled)
    assert [(path.topic, path.code, path.position.line, path.reason) for path in paths] == expected


def test_parametric_specifications_are_slow_paths() -> None:
    text = f"p(int x) {{ {EVENT} {{ }} }}"
    (found,) = slow_paths(compiled_from({"p.rv": text}, standard_definitions()))
    assert (found.topic, found.reason) == ("/t", "has a parametric specification")
