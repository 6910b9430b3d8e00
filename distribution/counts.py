"""Counts of the source that may only fall: their limits, their tables, and the parsed files that they read."""

import ast
import contextlib
import gc
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from distribution.checkout import ROOT

Function = ast.FunctionDef | ast.AsyncFunctionDef
_BLOCKS = ("body", "orelse", "finalbody", "handlers", "cases")


class Count(NamedTuple):
    """A count, with the most that it may be, and its goal."""

    name: str
    what: str
    limit: int
    goal: int
    members: Callable[[], Sequence[str] | int]
    """Return the members, or the number of a count that has none."""

    @property
    def number(self) -> int:
        members = self.members()
        return members if isinstance(members, int) else len(members)


def name_of(path: Path) -> str:
    return str(path.relative_to(ROOT))


def python_files(folders: Iterable[str], *, without: str = "no folder") -> Iterator[Path]:
    for folder in folders:
        for path in sorted((ROOT / folder).rglob("*.py")):
            if not path.is_relative_to(ROOT / without):
                yield path


@contextlib.contextmanager
def no_collector() -> Iterator[None]:
    """Stop the garbage collector, which scans millions of syntax nodes again and again. They have no cycles."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


def nodes(tree: ast.AST) -> list[ast.AST]:
    """Return the node and all nodes below it, level by level, in half the time of `ast.walk`."""
    found = [tree]
    for node in found:
        for value in node.__dict__.values():
            if isinstance(value, list):
                found += [each for each in value if isinstance(each, ast.AST)]
            elif isinstance(value, ast.AST):
                found.append(value)
    return found


def statements(tree: ast.AST) -> list[ast.AST]:
    """Return the node and all statements below it, without the expressions, which are most of a file's nodes."""
    found = [tree]
    for node in found:
        for block in _BLOCKS:
            found += getattr(node, block, ()) if not isinstance(node, ast.expr) else ()
    return found


def functions(tree: ast.AST) -> Iterator[Function]:
    return (node for node in statements(tree) if isinstance(node, Function))


def classes(tree: ast.AST) -> Iterator[ast.ClassDef]:
    return (node for node in statements(tree) if isinstance(node, ast.ClassDef))


def length(node: Function | ast.ClassDef) -> int:
    """Return the number of lines, with those of the decorators."""
    first = min([node.lineno, *(each.lineno for each in node.decorator_list)])
    return (node.end_lineno or node.lineno) - first + 1


def over_their_limits(program: str, counts: Iterable[Count]) -> list[str]:
    """Return a line for each count that exceeds its limit, or counts nothing although its goal is more."""
    with no_collector():
        numbers = {count: count.number for count in counts}
    return [
        f"{count.name}: {number}, and the limit is {count.limit}: {count.what}. Have fewer:"
        f" python -m {program} {count.name} lists them"
        for count, number in numbers.items()
        if number > count.limit or (count.goal and not number)
    ]


def main(program: str, counts: Sequence[Count], arguments: Sequence[str]) -> int:
    """Print the counts, or the members of the counts that the arguments name."""
    known = {count.name: count for count in counts}
    for name in arguments:
        if name not in known:
            sys.stderr.write(f"{program}: {name!r} is not a count; use one of: {', '.join(known)}\n")
            return 2
        members = known[name].members()
        for member, number in Counter([str(members)] if isinstance(members, int) else members).items():
            sys.stdout.write(f"{member}{f' ({number})' if number > 1 else ''}\n")
    if not arguments:
        sys.stdout.write(f"{'name':<14}{'now':>7}{'limit':>7}{'goal':>7}  count\n")
        for count in counts:
            row = f"{count.name:<14}{count.number:>7}{count.limit:>7}{count.goal:>7}  {count.what}\n"
            sys.stdout.write(row)
    return 0
