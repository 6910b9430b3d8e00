"""Text from outside is never turned into Python code."""

import ast

from tests.support.sources import ROOT, product_files

MAKE_CODE = {"eval", "exec", "compile", "__import__"}


def made_of_text(source: str) -> list[int]:
    """Return the lines where a source turns text into code."""
    return [
        node.lineno
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in MAKE_CODE
    ]


def test_nothing_makes_code_of_text() -> None:
    """Specifications are interpreted, or become WebAssembly; policies and formulas are data."""
    found = [
        f"{path.relative_to(ROOT)}:{line}"
        for path in product_files()
        for line in made_of_text(path.read_text(encoding="utf-8"))
    ]
    assert found == []
    assert made_of_text("x = 1\nexec(compile('y = 2', '', 'exec'))") == [2, 2]
