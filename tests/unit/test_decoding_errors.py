"""Handlers of malformed data handle all of it: `msgspec` raises `UnicodeDecodeError` for text that is not UTF-8."""

import ast

from tests.support.sources import ROOT, product_files

TOO_NARROW = {"MsgspecError", "DecodeError"}


def too_narrow(source: str) -> list[int]:
    """Return the lines that name an error of `msgspec` other than to raise it; `ValueError` includes these errors."""
    tree = ast.parse(source)
    raised = {id(part) for node in ast.walk(tree) if isinstance(node, ast.Raise) for part in ast.walk(node)}
    return [
        node.lineno
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and node.attr in TOO_NARROW and id(node) not in raised
    ]


def test_no_handler_is_too_narrow() -> None:
    """One damaged byte must not end a process, nor one client's text cause a fault."""
    files = [*product_files(), *sorted((ROOT / "fleet").rglob("*.py"))]
    found = [f"{path.relative_to(ROOT)}:{line}" for path in files for line in too_narrow(path.read_text())]
    assert found == []
    assert too_narrow("try: pass\nexcept (OSError, msgspec.DecodeError): raise msgspec.DecodeError") == [2]
