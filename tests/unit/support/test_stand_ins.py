import ast
import re
from collections.abc import Iterator

from distribution.fact_cache import nodes
from tests.support.sources import ROOT, files_of_tests

# Names with an underscore that are part of a published interface.
PUBLISHED = {
    "_asdict": "of a named tuple",
    "_fields": "of a named tuple",
    "_replace": "of a named tuple",
    "_exit": "of os: a process that ends as if it were killed",
    "_set_running_loop": "of asyncio: for authors of event loops",
    "_create_unverified_context": "of ssl: a browser's user who clicks the warning away",
    "_buff": "of rospy.AnyMsg: the bytes of a message",
    "_connection_header": "of rospy: how a node learns who sent a message",
    "_marshaled_dispatch": "of xmlrpc.server: what its own request handler calls",
    "_run": "of asyncio.Handle: what an event loop calls",
    "_context": "of asyncio.Handle: the context of its callback, by which a loop finds its owner",
    "_scheduled": "of asyncio.TimerHandle: what an event loop sets",
    "_log_destroy_pending": "of asyncio.Task: not set for a task that another keeps",
}


def test_private_attributes_are_not_read() -> None:
    assert [file for file, tree in trees(r"(?<!\bself)(?<!\bcls)\._(?!_)") if any(private(tree))] == []


def test_stand_ins_accept_only_known_calls() -> None:
    assert [file for file, tree in trees("__getattr|mock|Mock") if any(answers_anything(tree))] == []


def test_the_rule_finds_what_it_forbids() -> None:
    for text in ("x._y", "x.y._z()", "x._y = 1", "f()._y"):
        assert list(private(ast.parse(text))), text
    for text in ("self._y", "x.y", "x.__dict__", "t._replace(a=1)"):
        assert not list(private(ast.parse(text))), text
    for text in (
        "def __getattr__(self, name): ...",
        "from unittest.mock import Mock",
        "x = mock.MagicMock()",
    ):
        assert list(answers_anything(ast.parse(text))), text
    assert not list(answers_anything(ast.parse("from unittest import mock\nmock.patch('a.b', 1)")))


def trees(words: str) -> Iterator[tuple[str, ast.Module]]:
    for path in files_of_tests():
        text = path.read_text(encoding="utf-8")
        if re.search(words, text):
            yield str(path.relative_to(ROOT)), ast.parse(text)


def private(tree: ast.Module) -> Iterator[str]:
    for node in nodes(tree):
        if not isinstance(node, ast.Attribute) or node.attr in PUBLISHED:
            continue
        own = isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")
        if node.attr.startswith("_") and not node.attr.startswith("__") and not own:
            yield ast.unparse(node)


def answers_anything(tree: ast.Module) -> Iterator[str]:
    for node in nodes(tree):
        match node:
            case ast.FunctionDef(name="__getattr__" | "__getattribute__"):
                yield node.name
            case ast.ImportFrom(module="unittest.mock"):
                yield "unittest.mock"
            case ast.Attribute(attr=name) | ast.Name(id=name) if name.endswith("Mock"):
                yield name
