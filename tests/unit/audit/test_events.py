"""Tests of the registry of events against the program."""

import ast
from pathlib import Path

import appliance
from appliance.audit.events import EVENTS


def recorded_names() -> dict[str, str]:
    """Names of events that the program records (literals only), and where."""
    found: dict[str, str] = {}
    root = Path(appliance.__file__).parent
    for path in root.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Call):
                continue
            called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            candidates = [one.value for one in node.keywords if called == "Record" and one.arg == "event"]
            candidates += node.args[:1] if called in ("happened", "_own") else []
            for one in candidates:
                if isinstance(one, ast.Constant) and isinstance(one.value, str):
                    found[one.value] = f"{path.relative_to(root)}:{one.lineno}"
    return found


def test_whatever_is_recorded_is_in_the_registry() -> None:
    """Every event that some part of the program records has its name and description in the registry."""
    found = recorded_names()
    assert "checkpoint" in found
    assert {name: where for name, where in found.items() if name not in EVENTS} == {}
