"""docs/troubleshooting.md quotes only messages that the program can print."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]


def texts() -> str:
    """Return all strings of the appliance; an f-string has a gap for each value."""
    found = []
    for path in (ROOT / "appliance").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(node.value)
            elif isinstance(node, ast.JoinedStr):
                found.append(
                    "\0".join(str(one.value) for one in node.values if isinstance(one, ast.Constant))
                )
    return "\n".join(found)


def test_quoted_messages_are_in_the_program() -> None:
    """Each message in the first column of a table occurs in a string of the program."""
    page = (ROOT / "docs/troubleshooting.md").read_text()
    cells = re.findall(r"^\| ([^|]*`[^|]*) \|", page, re.MULTILINE)
    quoted = [piece for cell in cells for piece in re.findall(r"`([^`(]+)`", cell) if " " in piece]
    assert len(quoted) > 25
    program = texts()
    assert [one for one in quoted if one not in program] == []
