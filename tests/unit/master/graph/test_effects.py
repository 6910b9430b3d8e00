import ast
import inspect
from collections.abc import Iterator
from pathlib import Path

import appliance
from appliance.master.graph.grants import Grants
from appliance.master.graph.graph import RosGraph
from appliance.master.graph.registry import Registry
from appliance.master.graph.revocation import Revocation

ROOT = Path(appliance.__file__).parent
_EFFECTS = {"Effects", "list[Durable]"}


def verbs() -> set[tuple[str, str]]:
    return {
        (part.__name__.removeprefix("Ros").lower(), node.name)
        for part in (RosGraph, Registry, Grants, Revocation)
        for node in ast.walk(ast.parse(inspect.getsource(part)))
        if isinstance(node, ast.FunctionDef)
        and node.returns is not None
        and ast.unparse(node.returns) in _EFFECTS
    }


def dropped(tree: ast.Module, known: set[tuple[str, str]]) -> Iterator[str]:
    for node in ast.walk(tree):
        match node:
            case ast.Expr(value=ast.Call(func=ast.Attribute(value=part, attr=verb))):
                name = ast.unparse(part).rpartition(".")[2].lstrip("_")
                if (name, verb) in known:
                    yield ast.unparse(node)


def test_no_effect_is_dropped() -> None:
    files = [*(ROOT / "master").rglob("*.py"), *(ROOT / "control").rglob("*.py")]
    known = verbs()
    assert [
        call for file in files for call in dropped(ast.parse(file.read_text(encoding="utf-8")), known)
    ] == []


def test_the_rule_finds_what_it_forbids() -> None:
    assert {
        ("graph", "registered"),
        ("registry", "add"),
        ("grants", "give"),
        ("revocation", "expel"),
    } <= verbs()
    assert list(dropped(ast.parse("self._graph.registered(a)"), verbs()))
    assert not list(dropped(ast.parse("self._enactor.carry_out(self._graph.registered(a))"), verbs()))
