"""List the Python files that rules of the project apply to."""

from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
LANGUAGE_TESTS = ROOT / "rosmop" / "tests"


def product_files() -> Iterator[Path]:
    """Yield every file of the appliance, the language and the wire format, without their tests."""
    for package in ("appliance", "rosmop", "roswire"):
        for path in sorted((ROOT / package).rglob("*.py")):
            if not path.is_relative_to(LANGUAGE_TESTS):
                yield path


def files_of_tests() -> Iterator[Path]:
    for folder in (ROOT / "tests", LANGUAGE_TESTS):
        yield from sorted(folder.rglob("*.py"))
