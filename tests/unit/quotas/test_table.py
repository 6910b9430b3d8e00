"""The table of shares, and the page that is made from it."""

import ast
from pathlib import Path

from appliance.quotas.table import SHARES
from distribution.shares_page import page

_FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
ROOT = Path(__file__).parents[3]
_FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


def test_the_page_is_the_tables() -> None:
    """docs/shares.md is what `python -m distribution.shares_page` writes."""
    assert (ROOT / "docs/shares.md").read_text() == page()


def test_each_row_is_attacked_by_a_test_that_exists() -> None:
    """A row without a test, or with one that is not there, is a claim that nobody checks."""
    for row in SHARES:
        assert row.shown_by, row.thing
        for place in row.shown_by:
            file, _, name = place.partition("::")
            folder = ROOT if file.startswith("rosmop/") else ROOT / "tests"
            tree = ast.parse((folder / file).read_text())
            assert name in {node.name for node in ast.walk(tree) if isinstance(node, _FUNCTIONS)}, place
