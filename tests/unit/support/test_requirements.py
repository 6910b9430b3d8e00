import re
from pathlib import Path

import pytest

from tests.support.requirements import needs

ROOT = Path(__file__).parents[3]
_NEEDED = r'need_program\("[^"]+", "([^"]+)"\)|apt install ([\w+-]+)'


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


@pytest.mark.parametrize(
    ("lists", "folders"),
    [
        (["packages.txt", "packages-develop.txt"], ["tests/unit", "tests/integration", "rosmop/tests"]),
        ([path.name for path in ROOT.glob("packages*.txt")], ["tests", "rosmop/tests", "fleet/tests", "lab/tests"]),
    ],
    ids=["make test", "make nightly"],
)  # fmt: skip
def test_a_run_needs_only_what_its_setup_installs(lists: list[str], folders: list[str]) -> None:
    lines = ["python3", "util-linux"]  # each Debian has them
    lines += [line for name in lists for line in (ROOT / name).read_text().splitlines()]
    installed = {line.partition("#")[0].strip() for line in lines}
    needed = {
        (path.relative_to(ROOT).as_posix(), package)
        for folder in folders
        for path in (ROOT / folder).rglob("*.py")
        for packages in re.findall(_NEEDED, path.read_text())
        for package in " ".join(packages).split()
    }
    assert needed
    assert {(path, package) for path, package in needed if package not in installed} == set()
