import ast
import re
from functools import cache
from pathlib import Path

from appliance.supervisor.roles import ROLES

TESTS = Path(__file__).parents[1]


def test_every_test_that_is_named_exists() -> None:
    text = (TESTS.parent / "docs/reference/threat-model.md").read_text()
    assert len(named(text)) > 100
    assert missing(text, TESTS) == []


def test_every_process_has_what_an_attacker_in_it_can_do() -> None:
    text = (TESTS.parent / "docs/reference/threat-model.md").read_text()
    rows = re.findall(r"^\| is in ([^|]+) \|", text, re.MULTILINE)
    named = [name for row in rows for name in re.findall("`([a-z]+)`", row)]
    assert sorted(named) == sorted(role.name for role in ROLES)


def test_a_test_that_was_removed_is_missed(tmp_path: Path) -> None:
    (tmp_path / "unit").mkdir()
    (tmp_path / "unit/test_a.py").write_text(
        "def test_there(): ...\n@pytest.mark.skip('later')\ndef test_off(): ...\n"
        "@pytest.mark.xfail\nasync def test_fails(): ...\n"
    )
    (tmp_path / "unit/b.txt").write_text("# A promise\n> kept\n")
    there = "`unit/test_a.py` `unit/test_a.py::test_there` `unit/b.txt: A promise`"
    gone = [
        "unit/test_a.py::test_gone", "unit/test_a.py::test_off", "unit/test_a.py::test_fails", "unit/test_b.py",
        "proofs/test_c.py::test_there", "unit/test_a.py::test_there[one]", "test_there",
        "unit/b.txt: Another promise",
    ]  # fmt: skip
    assert missing(" | ".join([there, *(f"`{one}`" for one in gone)]), tmp_path) == gone


def named(text: str) -> list[str]:
    return re.findall(r"`([^`\s]*test_[^`\s]*|[^`\s]+\.txt: [^`]+)`", text)


def missing(text: str, tests: Path) -> list[str]:
    return [one for one in named(text) if not _runs(tests, *one.partition("::")[::2])]


def _runs(tests: Path, path: str, name: str) -> bool:
    path, _, title = path.partition(": ")
    if title:
        return f"\n# {title}\n" in f"\n{(tests / path).read_text()}"
    file = tests.parent / path if path.startswith("rosmop/") else tests / path
    if not path.endswith(".py") or not file.is_file():
        return False
    marks = _marks(file).get(name)
    return not name or (marks is not None and not re.search(r"\b(skip|xfail)\b", marks))


@cache
def _marks(file: Path) -> dict[str, str]:
    """Return the decorators of each function."""
    return {
        node.name: " ".join(map(ast.unparse, node.decorator_list))
        for node in ast.parse(file.read_text()).body
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    }
