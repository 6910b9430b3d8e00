from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

from distribution.fact_cache import facts_of_files


class Words(NamedTuple):
    number: int
    first: frozenset[str]


class CountedChecks:
    """A check of a checkout with two files. `read` has the names of the files that were read in the last run."""

    def __init__(self, root: Path) -> None:
        self.root, self.read = root, list[str]()
        self.files = [root / "a.py", root / "b.py"]
        self.code = root / "rules.code"
        for path in (*self.files, self.code):
            path.write_text(f"{path.name} is a file")

    def facts(self, context: str = "") -> dict[str, Words]:
        self.read.clear()
        return facts_of_files(
            Words, self._find, self.files, code=[str(self.code)], context=[context], root=self.root
        )

    def _find(self, path: Path) -> Words:
        self.read.append(path.name)
        words = path.read_text().split()
        return Words(len(words), frozenset(words[:1]))

    @property
    def store(self) -> Path:
        return self.root / "build/facts/rules.msgpack"


@pytest.fixture
def checks(tmp_path: Path) -> CountedChecks:
    checks = CountedChecks(tmp_path)
    assert checks.facts() == {name: Words(4, frozenset({name})) for name in ("a.py", "b.py")}
    assert checks.read == ["a.py", "b.py"]
    return checks


def test_unchanged_files_are_not_read_again(checks: CountedChecks) -> None:
    assert checks.facts() == {name: Words(4, frozenset({name})) for name in ("a.py", "b.py")}
    assert checks.read == []


def test_only_a_changed_file_is_read_again(checks: CountedChecks) -> None:
    checks.files[1].write_text("changed")
    assert checks.facts()["b.py"] == Words(1, frozenset({"changed"}))
    assert checks.read == ["b.py"]


def test_a_file_that_was_removed_has_no_facts(checks: CountedChecks) -> None:
    del checks.files[0]
    assert [*checks.facts()] == ["b.py"]


@pytest.mark.parametrize(
    "change",
    [
        lambda checks: checks.code.write_text("another rule"),
        lambda checks: checks.store.write_bytes(checks.store.read_bytes()[:-3]),
        lambda checks: checks.store.write_bytes(b""),
        lambda checks: checks.store.unlink(),
    ],
    ids=["another rule", "cut off", "empty", "removed"],
)
def test_facts_that_are_not_current_are_found_again(
    checks: CountedChecks, change: Callable[[CountedChecks], object]
) -> None:
    change(checks)
    assert [*checks.facts()] == checks.read == ["a.py", "b.py"]


def test_facts_depend_on_their_context(checks: CountedChecks) -> None:
    checks.facts("a module")
    assert checks.read == ["a.py", "b.py"]
    checks.facts("a module")
    assert checks.read == []
