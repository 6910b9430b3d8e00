"""No object keeps the number of a closed descriptor, because the next open file gets that number."""

import ast

from tests.support.sources import ROOT, product_files


def kept_after_closing(source: str) -> list[int]:
    """Return the lines where a function closes a descriptor in an attribute without resetting the attribute."""
    found = []
    for function in ast.walk(ast.parse(source)):
        if not isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        nodes = list(ast.walk(function))
        replaced = {
            ast.unparse(target)
            for node in nodes
            if isinstance(node, ast.Assign)
            for target in node.targets
            if isinstance(node.value, ast.UnaryOp | ast.Constant)
        }
        found += [
            node.lineno
            for node in nodes
            if isinstance(node, ast.Call)
            and ast.unparse(node.func) == "os.close"
            and isinstance(node.args[0], ast.Attribute)
            and ast.unparse(node.args[0]) not in replaced
        ]
    return found


def test_no_object_keeps_the_number_of_a_closed_descriptor() -> None:
    """A function that closes an attribute sets it to -1 or None, so that a later use fails and hits no other file."""
    found = [
        f"{path.relative_to(ROOT)}:{line}"
        for path in product_files()
        for line in kept_after_closing(path.read_text(encoding="utf-8"))
    ]
    assert found == []
    assert kept_after_closing("def close(self):\n    os.close(self._lock)") == [2]
    assert not kept_after_closing("def close(self):\n    os.close(self._lock)\n    self._lock = -1")
