"""tests/outside.toml: the tests that may fail for a reason outside the product, and are tried a second time then."""

import tomllib
from pathlib import Path

TESTS = Path(__file__).parents[1]


def outside() -> dict[str, str]:
    """The reason for each test that is listed, by its id (`tests/system/….py::test_…`)."""
    groups = tomllib.loads((TESTS / "outside.toml").read_text(encoding="utf-8")).values()
    return {test: str(group["reason"]).strip() for group in groups for test in group["tests"]}
