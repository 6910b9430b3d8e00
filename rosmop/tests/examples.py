"""A property test runs a twelfth of its examples, or all of them with `TESTS_EXAMPLES=all`, as `make nightly` does.

@settings(max_examples=examples(400))
"""

import datetime
import os
from collections.abc import Iterable, Iterator, Sequence
from typing import TypeVar

T = TypeVar("T")
ALL = os.environ.get("TESTS_EXAMPLES") == "all"


def examples(many: int) -> int:
    return many if ALL else max(many // 12, 1)


def sample(cases: Iterable[T], step: int = 6) -> Sequence[T]:
    """Return every `step`-th case, or all of them."""
    return [*cases][:: 1 if ALL else step]


def covering(rows: Iterable[tuple[str, ...]]) -> Iterator[tuple[str, ...]]:
    """Yield rows so that each value of each column is in one of them, or all rows."""
    seen: set[tuple[int, str]] = set()
    for row in rows:
        if ALL or not seen.issuperset(enumerate(row)):
            seen.update(enumerate(row))
            yield row


def seeds_of_night(number: int) -> range:
    """Return seeds that no other day has, so that each night tries new cases.

    `TESTS_DAY=2026-11-28` repeats those of a day. The seeds of the gate are fixed, and below those of any night.
    """
    day = os.environ.get("TESTS_DAY") or datetime.datetime.now(datetime.UTC).date().isoformat()
    first = datetime.date.fromisoformat(day).toordinal() * number
    return range(first, first + number)
