"""docs/threat-model.md and docs/iec-62443.md: their claims are tried by tests that are there."""

import ast
import re
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[1]


@pytest.mark.parametrize("page", ["threat-model.md", "iec-62443.md"])
def test_every_test_that_is_named_exists(page: str) -> None:
    """Each test in the tables is a function of that name in that file."""
    named = re.findall(
        r"`((?:unit|integration|system|package)/[\w/]+\.py)(?:::(\w+))?`",
        (TESTS.parent / "docs" / page).read_text(),
    )
    assert len(named) > 40
    missing = [f"{path}::{name}" for path, name in named if not _has(TESTS / path, name)]
    assert missing == []


def _has(path: Path, name: str) -> bool:
    if not path.exists():
        return False
    functions = [
        node.name
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    ]
    return not name or name in functions
