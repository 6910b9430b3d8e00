"""No cell of the table of passages without a test or a reason, and no new cell that only a double tests."""

import ast
from functools import cache
from pathlib import Path

import pytest

from tests.support.passages import CELLS, COLUMNS, named_tests, only_doubles

TESTS = Path(__file__).parents[1]
MOST_DOUBLES = 21
"""Lower it with each deployed test of such a cell."""


@cache
def _functions(file: str) -> frozenset[str]:
    tree = ast.parse((TESTS / file).read_text(encoding="utf-8"))
    return frozenset(
        one.name for one in ast.walk(tree) if isinstance(one, ast.FunctionDef | ast.AsyncFunctionDef)
    )


@pytest.mark.complete
@pytest.mark.parametrize("row", CELLS)
def test_each_moment_of_each_thing_has_its_test_or_reason(row: str) -> None:
    assert CELLS[row].keys() == COLUMNS.keys()
    for column, cell in CELLS[row].items():
        assert cell.startswith("- ") or named_tests(cell), f"{row}, {column}: no test and no reason"
        for test in named_tests(cell):
            file, _colons, name = test.partition("::")
            assert (TESTS / file).exists(), f"{row}, {column}: {file} does not exist"
            assert name in _functions(file), f"{row}, {column}: {file} has no {name}"


def test_no_further_cell_has_a_double_only() -> None:
    found = only_doubles()
    assert len(found) == MOST_DOUBLES, "\n".join(found)
