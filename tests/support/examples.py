"""Run a sixth of a property's examples each time, and all in `make nightly`.

With `CI=true` Hypothesis derives the seed from the test; otherwise each run has a new seed.
"""

import os
from collections.abc import Iterable, Iterator, Sequence
from typing import TypeVar

T = TypeVar("T")
ALL = os.environ.get("TESTS_EXAMPLES") == "all"


def examples(many: int) -> int:
    return many if ALL else many // 6


def sample(cases: Iterable[T], step: int = 6, first: int = 0) -> Sequence[T]:
    """Return every `step`-th case from the `first` on, or all in `make nightly`."""
    return [*cases] if ALL else [*cases][first % step :: step]


def covering(rows: Iterable[tuple[str, ...]]) -> Iterator[tuple[str, ...]]:
    """Yield rows so that each value of each column is in one of them, or all rows in `make nightly`."""
    seen: set[tuple[int, str]] = set()
    for row in rows:
        if ALL or not seen.issuperset(enumerate(row)):
            seen.update(enumerate(row))
            yield row
