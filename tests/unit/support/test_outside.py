"""The tests that are tried a second time: few, each there, each with its reason; no other test is."""

import ast
import subprocess
import sys
from pathlib import Path

from tests.support.outside import TESTS, outside

ROOT = TESTS.parent
MOST = 8  # a longer list is a sign that something of the product is on it
FAILS_ONCE = """
from pathlib import Path
def {name}():
    tried = Path({tried!r})
    tried.write_text(tried.read_text() + "x" if tried.exists() else "x")
    assert tried.read_text() == "xx"
"""


def test_the_list_is_short_and_every_entry_has_a_reason() -> None:
    """A reason is a sentence, not a word."""
    listed = outside()
    assert 0 < len(listed) <= MOST
    assert [test for test, reason in listed.items() if len(reason.split()) < 8] == []


def test_every_entry_is_a_test() -> None:
    """A test that was renamed is named anew here."""
    missing = [test for test in outside() if not _exists(*test.split("::"))]
    assert missing == []


def test_only_what_is_listed_is_tried_again(tmp_path: Path) -> None:
    """A test that fails the first time fails; one of the list passes, and the summary shows the retry and why."""
    listed, reason = next(iter(outside().items()))
    name = listed.partition("::")[2]
    (tmp_path / "tests/system/vm").mkdir(parents=True)
    for path in ("conftest.py", "outside.toml", "support"):
        (tmp_path / "tests" / path).symlink_to(TESTS / path)
    for function, file in (
        (name, listed.partition("::")[0]),
        ("test_of_the_product", "tests/test_product.py"),
    ):
        text = FAILS_ONCE.format(name=function, tried=str(tmp_path / function))
        (tmp_path / file).write_text(text)
    (tmp_path / "pyproject.toml").symlink_to(ROOT / "pyproject.toml")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "tests"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert "1 failed, 1 passed, 1 rerun" in done.stdout, done.stdout + done.stderr
    assert f"RERUN {listed}" in done.stdout
    assert " ".join(reason.split()) in done.stdout
    assert (tmp_path / "test_of_the_product").read_text() == "x"


def _exists(path: str, name: str) -> bool:
    file = ROOT / path
    return file.exists() and any(
        isinstance(node, ast.FunctionDef) and node.name == name for node in ast.parse(file.read_text()).body
    )
