"""Ends for tests, and the rows of the table of all kinds of ends (`tests/unit/store/test_ends.py`).

A file `ending.py` of the folder that tests the owner of a kind has its row, in `ENDINGS`.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from appliance.base.age_clock import AgeClock
from appliance.store.ends import EndKind, EndTable
from appliance.store.state_file import StateStore
from tests.support.engines import InlineDatabase

WALL = 1_790_000_000.0
"""The system time at which things begin."""


def ends_of(store: StateStore, folder: Path, **role: Any) -> EndTable:
    return EndTable(store, AgeClock(folder / "age"), **role)


def ends_in(folder: Path) -> EndTable:
    """Return ends over a new state."""
    return ends_of(StateStore(folder, failed=pytest.fail, kind=InlineDatabase), folder)


class Ending(NamedTuple):
    """A thing of the owner of a kind. `begin(seconds)` may return an awaitable."""

    begin: Callable[[float], object]
    lasts: Callable[[], bool]


Endings = Mapping[EndKind, Callable[[StateStore, EndTable], Ending]]
"""By kind, how its owner is made at each start over the same state."""
