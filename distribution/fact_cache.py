"""Walk the syntax of source files, and keep their facts in `build/facts`, so that a check parses only changed files."""

import ast
import contextlib
import gc
import hashlib
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from distribution.checkout import ROOT

Function = ast.FunctionDef | ast.AsyncFunctionDef
_BLOCKS = ("body", "orelse", "finalbody", "handlers", "cases")
_Facts = TypeVar("_Facts")


def name_of(path: Path) -> str:
    return str(path.relative_to(ROOT))


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


def facts_of_files(
    kind: type[_Facts],
    find: Callable[[Path], _Facts],
    paths: Iterable[Path],
    *,
    code: Iterable[str],
    context: Iterable[str] = (),
    root: Path = ROOT,
) -> dict[str, _Facts]:
    """Return `find(path)` of each file, by its name in the checkout `root`.

    The facts of an earlier run are used if the file's content is the same, and the Python, the files `code` that find
    the facts, and `context`, all else that they depend on.
    """
    used = [Path(each) for each in code]
    version = _digest(sys.version.encode(), *(each.read_bytes() for each in used), *map(str.encode, context))
    store = root / "build" / "facts" / f"{used[0].stem}.msgpack"
    known = _read(store, version, kind)
    rows: dict[str, tuple[bytes, _Facts]] = {}
    with no_collector():
        for path in paths:
            name, content = path.relative_to(root).as_posix(), _digest(path.read_bytes())
            row = known.get(name)
            rows[name] = row if row and row[0] == content else (content, find(path))
    if rows != known:
        _write(store, version, rows)
    return {name: facts for name, (_content, facts) in rows.items()}


def _digest(*parts: bytes) -> bytes:
    lengths = b",".join(b"%d" % len(part) for part in parts)
    return hashlib.sha256(b"\0".join((lengths, *parts))).digest()


def _read(store: Path, version: bytes, kind: type[_Facts]) -> dict[str, tuple[bytes, _Facts]]:
    try:
        written, _, rows = store.read_bytes().partition(b"\n")
        known = written == version.hex().encode()
        kinds: Any = dict[str, tuple[bytes, kind]]  # type: ignore[valid-type]  # made at run time
        facts: dict[str, tuple[bytes, _Facts]] = msgspec.msgpack.decode(rows, type=kinds) if known else {}
        return facts
    except (OSError, ValueError):  # there is none yet, or a killed run wrote it
        return {}


def _write(store: Path, version: bytes, rows: object) -> None:
    new = store.with_suffix(f".{os.getpid()}")
    with contextlib.suppress(OSError):  # a checkout that cannot be written has no cache
        store.parent.mkdir(parents=True, exist_ok=True)
        new.write_bytes(b"\n".join((version.hex().encode(), msgspec.msgpack.encode(rows))))
        new.replace(store)
