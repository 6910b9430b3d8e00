"""The tests that are tried a second time: few, each there, each with its reason; no other test is."""

import ast
import os
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
    (tmp_path / "tests/long.txt").write_text("tests/test_product.py\n")
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
    assert done.stdout.index("tests/test_product.py") < done.stdout.index(listed.partition("::")[0]), (
        "long first"
    )


def test_every_file_that_takes_long_is_there() -> None:
    """One that was renamed is named anew in tests/long.txt."""
    names = (TESTS / "long.txt").read_text(encoding="utf-8").splitlines()
    assert [name for name in names if not name.startswith("#") and not (ROOT / name).is_file()] == []


def _exists(path: str, name: str) -> bool:
    file = ROOT / path
    return file.exists() and any(
        isinstance(node, ast.FunctionDef) and node.name == name for node in ast.parse(file.read_text()).body
    )


def test_what_fails_beside_others_is_named_by_ci(tmp_path: Path) -> None:
    """CI runs it once more by itself, and says so; what fails twice, many failures, and a broken file fail the run."""
    for path, target in ((".venv", ROOT / ".venv"), ("ci", ROOT / ".ci")):
        (tmp_path / path).symlink_to(target)
    once = tmp_path / "test_once.py"
    once.write_text(FAILS_ONCE.format(name="test_race", tried=str(tmp_path / "race")))
    told = "unsteady: test_once.py::test_race failed beside other tests and passed by itself"
    done = by_ci(tmp_path)
    assert (done.returncode, told in done.stdout.splitlines()) == (0, True), done.stdout + done.stderr

    (tmp_path / "race").unlink()
    always = tmp_path / "test_always.py"
    always.write_text("def test_defect():\n    assert 0\n")
    done = by_ci(tmp_path)
    assert (done.returncode, told in done.stdout) == (1, False), done.stdout + done.stderr

    (tmp_path / "race").unlink()
    always.write_text("import nothing_of_that_name\n")
    assert by_ci(tmp_path).returncode in (1, 2)

    always.unlink()
    many = "".join(FAILS_ONCE.format(name=f"test_{n}", tried=str(tmp_path / str(n))) for n in range(6))
    once.write_text(many)
    assert by_ci(tmp_path).returncode == 1
    assert (tmp_path / "0").read_text() == "x", "none was run again"


def by_ci(folder: Path) -> "subprocess.CompletedProcess[str]":
    """What CI makes of the tests there."""
    command = ["ci/pytest", "-p", "xdist", "-n2", "--dist=loadfile", "--import-mode=importlib", "."]
    environment = os.environ | {
        "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"
    }  # each would cost each process a second
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
