import re
from pathlib import Path

import pytest

from tests.support.requirements import needs

ROOT = Path(__file__).parents[3]


def test_a_met_requirement_lets_the_test_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CI", "true")
    needs(True, "nothing")


def test_an_unmet_requirement_skips_on_a_laptop(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CI", raising=False)
    with pytest.raises(pytest.skip.Exception, match="needs a robot"):
        needs(False, "a robot")


def test_an_unmet_requirement_fails_in_ci(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CI", "true")
    with pytest.raises(pytest.fail.Exception, match="needs a robot"):
        needs(False, "a robot")


def test_make_test_needs_only_what_it_installs() -> None:
    lists = [(ROOT / name).read_text() for name in ("packages.txt", "packages-develop.txt")]
    installed = {line.partition("#")[0].strip() for text in lists for line in text.splitlines()}
    needed = {
        (path.relative_to(ROOT).as_posix(), package)
        for folder in ("tests/unit", "tests/integration", "rosmop/tests")
        for path in (ROOT / folder).rglob("test_*.py")
        for packages in re.findall(r'need_program\("[^"]+", "([^"]+)"\)', path.read_text())
        for package in packages.split()
    }
    assert needed
    assert {(path, package) for path, package in needed if package not in installed} == set()
