"""Regular expressions match text of hosts and users, so none may take exponential time."""

import importlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
_FEW = 3
parser: Any = importlib.import_module("re._parser")  # the library has no public parser
codes: Any = importlib.import_module("re._constants")


def nested(parts: Any, inside: bool = False) -> bool:
    """Return whether a repeat contains another, neither possessive, so that a text divides in many ways."""
    return any(_is_nested(kind, given, inside) for kind, given in parts)


def _is_nested(kind: Any, given: Any, inside: bool) -> bool:
    if kind in (codes.MAX_REPEAT, codes.MIN_REPEAT):
        least, most, body = given
        many = most > max(least, _FEW)
        return (many and inside) or nested(body, inside or many)
    if kind is codes.POSSESSIVE_REPEAT:
        return nested(given[2])
    if kind is codes.BRANCH:
        return any(nested(one, inside) for one in given[1])
    return kind is codes.SUBPATTERN and nested(given[3], inside)


def patterns() -> Iterator[tuple[str, "re.Pattern[Any]"]]:
    for package in ("appliance", "roswire", "rosmop"):
        for file in sorted((ROOT / package).rglob("*.py")):
            path = file.relative_to(ROOT)
            if "tests" in path.parts or "re.compile(" not in file.read_text(encoding="utf-8"):
                continue
            module = importlib.import_module(".".join(path.with_suffix("").parts))
            for name, value in vars(module).items():
                if isinstance(value, re.Pattern):
                    yield f"{path}: {name}", value


def test_no_repeat_is_inside_another_unless_one_is_possessive() -> None:
    found = [
        place
        for place, one in patterns()
        if nested(parser.parse(one.pattern, one.flags if isinstance(one.pattern, str) else 0))
    ]
    assert not found, f"make one repeat of these possessive (`*+`, `++`): {found}"


@pytest.mark.parametrize(
    ("text", "bad"), [("(a+)*b", True), ("(a|b+)+", True), ("(a++)*b", False), ("(a{3}b?)*", False)]
)
def test_the_rule_finds_a_nested_repeat(text: str, bad: bool) -> None:
    assert nested(parser.parse(text)) is bad
