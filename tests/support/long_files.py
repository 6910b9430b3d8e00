"""The files of tests/long.txt, and which of them `make check` leaves to `make test`."""

from functools import cache
from pathlib import Path

from tests.support.sources import ROOT

LONG = tuple(
    line
    for line in (ROOT / "tests" / "long.txt").read_text(encoding="utf-8").splitlines()
    if not line.startswith("#")
)
_RULES = ("tests/unit/test_", "tests/unit/support/")
"""Rules on the source do not wait: a word in a comment fails `make check`, not only CI."""


@cache
def waits(file: str) -> bool:
    """Whether `make check` leaves out the file's tests, except those marked `complete`."""
    return file in LONG and not file.startswith(_RULES)


def is_left_out(path: Path) -> bool:
    """Whether none of the file's tests runs with `make check`, so that it is not imported."""
    return (
        path.suffix == ".py"
        and waits(path.relative_to(ROOT).as_posix())
        and "mark.complete" not in path.read_text(encoding="utf-8")
    )
