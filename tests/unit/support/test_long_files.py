"""Tests of tests/long.txt, the list of files that run first because they take longest."""

from pathlib import Path

TESTS = Path(__file__).parents[2]


def test_every_long_file_exists() -> None:
    """If a file is renamed, the list must be changed as well."""
    names = (TESTS / "long.txt").read_text(encoding="utf-8").splitlines()
    assert [name for name in names if not name.startswith("#") and not (TESTS.parent / name).is_file()] == []
