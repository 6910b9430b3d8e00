"""Count the code of tests that is not a test: `python -m distribution.doubles`, and `… NAME` for one count's members.

A test should read as a few sentences on real parts. `tests/unit/test_interfaces.py` fails if a count exceeds its limit.
"""

import ast
import re
import sys
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

from distribution import counts
from distribution.checkout import ROOT
from distribution.counts import Count, classes, functions, length, main, name_of, nodes, parsed, python_files
from distribution.fact_cache import facts_of_files

_LONG_HELPER = 40  # lines
_CALL = re.compile(r"(?<!def )\b(\w+)\(")


class _File(NamedTuple):
    """The facts of a file in the folders of tests."""

    name: str
    lines: int
    classes: tuple[str, ...]
    helpers: tuple[tuple[str, int], ...]
    """Functions that are not tests, with their lines."""
    in_tests: int
    """Lines of the test functions."""
    named: frozenset[str]
    """The words before a parenthesis in a test function: those that it calls, and others in its texts."""
    calls: tuple[str, ...]
    """All calls of the file, by name, once for each call."""
    given_trails: int
    """Objects that are made with a function `happened`."""
    is_nightly: bool


@cache
def _files() -> tuple[_File, ...]:
    paths = python_files(("tests", "rosmop/tests"))
    return tuple(facts_of_files(_File, _facts, paths, code=(__file__, counts.__file__)).values())


def _facts(path: Path) -> _File:
    tree, text = parsed(path), path.read_text(encoding="utf-8")
    lines = text.splitlines()
    tests = [node for node in functions(tree) if node.name.startswith("test_")]
    bodies = "\n".join(line for node in tests for line in lines[node.lineno - 1 : node.end_lineno])
    return _File(
        name_of(path),
        len(lines),
        tuple(node.name for node in classes(tree)),
        tuple(
            (node.name, (node.end_lineno or node.lineno) - node.lineno + 1)
            for node in functions(tree)
            if not node.name.startswith("test_")
        ),
        sum(map(length, tests)),
        frozenset(_CALL.findall(bodies)),
        tuple(_CALL.findall(text)),
        text.count("(happened=") + text.count(" happened=lambda"),
        any(map(_marks_nightly, tree.body)),
    )


def _marks_nightly(node: ast.stmt) -> bool:
    return (
        isinstance(node, ast.Assign)
        and "nightly" in ast.unparse(node.value)
        and any(getattr(target, "id", "") == "pytestmark" for target in node.targets)
    )


def classes_in_tests() -> list[str]:
    return [f"{file.name}: {name}" for file in _files() for name in file.classes]


def doubles_of_the_trail() -> list[str]:
    """Return the definitions of `happened`, which the trail of control has, and the objects that are given one."""
    defined = [file.name for file in _files() for name, _lines in file.helpers if name == "happened"]
    return defined + [file.name for file in _files() for _double in range(file.given_trails)]


def calls_in_tests(*names: str) -> list[str]:
    return [file.name for file in _files() for name in file.calls if name in names]


def lines_outside_of_tests() -> int:
    """Return how many of 100 lines are not in a test function."""
    lines = sum(file.lines for file in _files())
    return round(100 * (1 - sum(file.in_tests for file in _files()) / lines))


def lines_of_nightly_unit_files() -> list[str]:
    """Return the name of each unit file that is nightly as a whole, once for each of its lines."""
    return [
        file.name
        for file in _files()
        if file.is_nightly and file.name.startswith("tests/unit/")
        for _line in range(file.lines)
    ]


def long_helpers() -> list[str]:
    """Return the functions of more than 40 lines that a test's body calls, as `file: function lines`."""
    long: dict[str, list[tuple[str, int]]] = defaultdict(list)
    for file in _files():
        for name, lines in file.helpers:
            if lines > _LONG_HELPER:
                long[name].append((file.name, lines))
    return sorted({member for file in _files() for member in _long_helpers_of(file, long)})


def _called(file: str) -> set[str]:
    """Return the functions that the test functions of a file call."""
    tests = (node for node in functions(parsed(ROOT / file)) if node.name.startswith("test_"))
    calls = (node.func for test in tests for node in nodes(test) if isinstance(node, ast.Call))
    return {getattr(call, "id", getattr(call, "attr", "")) for call in calls}


def _long_helpers_of(file: _File, long: dict[str, list[tuple[str, int]]]) -> Iterator[str]:
    folder = file.name.rsplit("/", 1)[0]
    for name in _called(file.name) & long.keys() if file.named & long.keys() else ():
        own = [row for row in long[name] if row[0] == file.name]
        shared = [row for row in long[name] if "/support/" in row[0] or row[0].rsplit("/", 1)[0] == folder]
        for path, lines in own or shared:
            yield f"{path}: {name} {lines}"


COUNTS = (
    Count("helpers", "helpers of more than 40 lines that a test's body calls", 0, 0, long_helpers),
    Count("classes", "classes in tests", 572, 200, classes_in_tests),
    Count("happened", "doubles of the audit trail in tests", 1, 0, doubles_of_the_trail),
    Count("namespaces", "calls of `SimpleNamespace` in tests", 21, 0, lambda: calls_in_tests("SimpleNamespace")),
    Count("casts", "calls of `cast` in tests", 11, 0, lambda: calls_in_tests("cast")),
    Count("outside", "lines of 100 that are outside of test functions", 58, 40, lines_outside_of_tests),
    Count("nightly", "lines of unit files that are nightly as a whole", 3739, 3500, lines_of_nightly_unit_files),
)  # fmt: skip


if __name__ == "__main__":
    sys.exit(main("doubles", COUNTS, sys.argv[1:]))
