from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
LANGUAGE_TESTS = ROOT / "rosmop" / "tests"


def files_of_tests() -> Iterator[Path]:
    for folder in (ROOT / "tests", LANGUAGE_TESTS, ROOT / "lab"):
        yield from sorted(folder.rglob("*.py"))
