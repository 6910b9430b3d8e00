"""No regular expression blocks the interpreter for long, whatever its input.

No other thread runs during a match. So a pattern that backtracks over text from a peer stops the appliance for all
hosts, even if its time is linear: 8 MB of spaces took a second.
"""

import ast
import importlib
import re
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from distribution.fact_cache import nodes
from roswire import names
from roswire.errors import InvalidNameError, PeerError
from roswire.xmlrpc import XmlRpcLimits
from roswire.xmlrpc.xmlrpc_reader import XmlRpcDocument
from tests.support.pattern_cost import steps
from tests.support.sources import LANGUAGE_TESTS, ROOT

UNLIMITED = 64 << 20
"""The number of characters for a text without a limit: the largest message of ROS, and more than any request."""

MAX_STEPS = 200_000  # ten milliseconds or less

LIMITED = {
    "appliance.audit.proof.copies:_ELEMENT": "65,536 characters, `_LONGEST_LINE`; an operator's own file",
    "appliance.audit.proof.copies:_PARAMETER": "as `_ELEMENT`",
    "appliance.audit.log.record_format:_BOUND": "a record's reason; each word is scanned once, as another follows",
    "appliance.api.console.console:_ADDRESS": "the console's files, at the start",
    "appliance.api.console.console:_GZIP": "a header of 16 KiB; each `gzip` is followed by its own scan",
    "appliance.base.timestamps:_IN_UTC": "a record's reason, or a sentence of the appliance",
    "appliance.base.varying_numbers:_NUMBER": "a record's reason; time is linear, see the comment there",
    "appliance.configuration.inventory:_COMMON": "the licence files of the installation",
    "appliance.configuration.inventory:_LICENCE": "the licence files of the installation",
    "appliance.ipsec.leftovers:_ENCAPSULATED": "the output of `ip xfrm`",
    "appliance.ipsec.leftovers:_POLICY": "the output of `ip xfrm`",
    "appliance.signing.log_proof:_CHECKPOINT": "a newline ends each number, so no shorter one matches; for Python 3.8",
    "appliance.master.calls.request_peek:_METHOD": "4096 bytes, `_BEGINNING`",
    "roswire.xmlrpc.common_documents:_CALL": "32 KiB, `_LONGEST`",
    "roswire.xmlrpc.common_documents:_CALL_IN": "32 KiB, `_LONGEST`",
    "roswire.xmlrpc.common_documents:_ANSWER": "32 KiB, `_LONGEST`",
    "roswire.xmlrpc.common_documents:_ANSWER_IN": "32 KiB, `_LONGEST`",
    "roswire.xmlrpc.common_documents:_VALUE": "finds one value behind the other, in what another pattern has matched",
    "rosmop.form.switch_words:_STATEMENT": "an operator's file; each part is possessive, so a character is read once",
}
"""The value is the limit of the text or the reason why the bound is too high."""

LOCAL = {
    "appliance/api/console/console_bundle.py": "the console's own files, at the start",
    "appliance/base/validation_messages.py": "sentences of our libraries about settings and bodies",
    "appliance/cli/": "a process of the operator",
    "appliance/features/monitor_tools/load_verb.py": "a process of the operator",
    "appliance/features/policy_tools/": "a process of the operator",
    "appliance/features/selftest/": "a process of the operator",
    "appliance/features/topics/": "a process of the operator",
    "appliance/features/guards/": "a process of the operator",
    "rosmop/certify/": "a process of the compiler, whose processor time is limited (`DRY_RUNS`)",
    "rosmop/check/": "a process of the compiler, whose processor time is limited (`DRY_RUNS`)",
    "rosmop/learn/": "a process of the operator",
    "rosmop/text/": "a process of the compiler, whose processor time is limited (`DRY_RUNS`)",
    "fleet/src/rosrv_fleet/bundles/commands.py": "a process of the operator",
    "fleet/src/rosrv_fleet/bundles/repository.py": "names of files in a folder of the operator",
    "fleet/src/rosrv_fleet/bundles/publication.py": "names of files in a folder of the operator",
}
"""Code whose patterns delay only the process that runs it."""

_FUNCTIONS = {"match", "fullmatch", "search", "sub", "subn", "split", "findall", "finditer"}
_AT_ITS_PLACE = {"match", "fullmatch"}


class Pattern(NamedTuple):
    name: str
    pattern: str | bytes
    flags: int
    anywhere: bool


def files() -> Iterator[Path]:
    for folder in ("appliance", "rosmop", "roswire", "fleet/src/rosrv_fleet"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            local = str(path.relative_to(ROOT)).startswith(tuple(LOCAL))
            if not (local or path.is_relative_to(LANGUAGE_TESTS)):
                yield path


def patterns_of(path: Path) -> Iterator[Pattern]:
    text = path.read_text(encoding="utf-8")
    if "re." not in text and "pattern=" not in text:
        return
    tree = ast.parse(text)
    module = ".".join(path.relative_to(ROOT).with_suffix("").parts).removeprefix("fleet.src.")
    within = nodes(tree)
    used = _methods(within)
    for name, pattern, flags in _constants(tree, _calls(within, "re"), module):
        yield Pattern(f"{module}:{name}", pattern, flags, not (used.get(name) or used[""]) <= _AT_ITS_PLACE)
    for call in _calls(within, "re"):
        if (function := _function(call)) in _FUNCTIONS:
            assert isinstance(call.args[0], ast.Constant), (
                f"{module}:{call.lineno}: make this pattern a constant"
            )
            yield Pattern(f"{module}:{call.lineno}", _text(call.args[0]), 0, function not in _AT_ITS_PLACE)
    for call in _calls(within, "msgspec"):
        for keyword in call.keywords:
            if keyword.arg == "pattern" and isinstance(keyword.value, ast.Constant):
                yield Pattern(f"{module}:{call.lineno}", _text(keyword.value), 0, anywhere=False)


def _constants(
    tree: ast.Module, calls: Sequence[ast.Call], module: str
) -> Iterator[tuple[str, str | bytes, int]]:
    compiled = [call for call in calls if _function(call) == "compile"]
    plain: dict[ast.expr, str] = {
        node.value: node.targets[0].id
        for node in tree.body
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name)
    }
    if all(call in plain and isinstance(call.args[0], ast.Constant) for call in compiled):
        for call in compiled:
            flags = [getattr(re, node.attr) for node in ast.walk(call) if isinstance(node, ast.Attribute)]
            yield plain[call], _text(call.args[0]), sum(one for one in flags if isinstance(one, re.RegexFlag))
        return
    waiting: list[tuple[str, Any]] = [*vars(importlib.import_module(module)).items()]
    while waiting:
        name, one = waiting.pop()
        if isinstance(one, re.Pattern):
            yield name, one.pattern, one.flags
        elif type(one) in (list, tuple, dict):
            waiting += [(name, part) for part in (one.values() if isinstance(one, dict) else one)]


def _calls(within: Sequence[ast.AST], module: str) -> list[ast.Call]:
    return [
        node
        for node in within
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and isinstance(node.func.value, ast.Name)
        and node.func.value.id == module
    ]


def _text(constant: ast.expr) -> str | bytes:
    assert isinstance(constant, ast.Constant)
    assert isinstance(constant.value, str | bytes)
    return constant.value


def _function(call: ast.Call) -> str:
    return call.func.attr if isinstance(call.func, ast.Attribute) else ""


def _methods(within: Sequence[ast.AST]) -> dict[str, set[str]]:
    found: dict[str, set[str]] = {}
    for node in within:
        if isinstance(node, ast.Attribute) and node.attr in _FUNCTIONS - {"split"}:
            name = node.value
            while isinstance(name, ast.Subscript):
                name = name.value
            found.setdefault(name.id if isinstance(name, ast.Name) else "", set()).add(node.attr)
    found[""] = {
        method for name, methods in found.items() if name[:1] != "_" and name != "re" for method in methods
    }
    return found


def test_no_pattern_has_many_steps() -> None:
    found = {
        one.name: (steps(one.pattern, one.flags, UNLIMITED, anywhere=one.anywhere), one.pattern)
        for path in files()
        for one in patterns_of(path)
    }
    costly = {name: what for name, what in found.items() if what[0] > MAX_STEPS}
    assert {name: what for name, what in costly.items() if name not in LIMITED} == {}
    assert [name for name in LIMITED if name not in costly] == []
    assert len(found) > 100


@pytest.mark.parametrize(
    "pattern",
    [
        r"[ ]*x",
        r"[a-z]*\Z",
        r"(?:/[a-z]+)+\Z",
        r"(a*)*b",
        r"(?:a|aa)+\Z",
        r"\s+$",
        r"a.*b.*c",
        r"(?:ab|cd)*+c",
    ],
)
def test_backtracking_is_found(pattern: str) -> None:
    """Python 3.11 matches some possessive repeats wrongly."""
    assert steps(pattern, 0, UNLIMITED, anywhere=False) > MAX_STEPS


def test_a_scan_costs_nothing_except_in_a_search() -> None:
    assert steps(r"\s*+x", 0, UNLIMITED, anywhere=False) < 10
    assert steps(r"\s*+x", 0, UNLIMITED, anywhere=True) > MAX_STEPS
    assert steps(r"[^\s,]++", 0, UNLIMITED, anywhere=True) < 10


@pytest.mark.parametrize("tag", ["i4", "boolean", "double", "dateTime.iso8601", "nil"])
def test_a_scalar_is_short(tag: str) -> None:
    """A number of megabytes is rejected by its length, before its digits are read."""
    value = f"<value><{tag}>{' ' * 4097}</{tag}></value>"
    body = f"<methodCall><methodName>a</methodName><params><param>{value}</param></params></methodCall>"
    with pytest.raises(PeerError, match=rf"<{tag}> with 4097 characters; at most 4096 are allowed"):
        XmlRpcDocument(body.encode(), XmlRpcLimits(), "methodCall")


@pytest.mark.parametrize(
    "check",
    [
        names.canonical_caller_id,
        names.canonical_tool_id,
        partial(names.resolve, caller_id="/a"),
        partial(names.resolve_parameter, caller_id="/a"),
    ],
)
def test_a_name_is_measured_before_it_is_matched(
    check: Callable[[str], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for pattern in ("_NAME", "_CANONICAL", "_TOOL", "_PARAMETER"):
        monkeypatch.setattr(names, pattern, None)
    with pytest.raises(InvalidNameError, match="1024"):
        check("/a" * names.MAX_NAME_LENGTH)
