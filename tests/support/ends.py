"""Ends for tests, and the rows of the table of all kinds of ends (`tests/unit/store/test_ends.py`).

A kind has its row in a file `ending.py` of the folder that tests its owner.
"""

import asyncio
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, ClassVar

import pytest

from appliance.base.age_clock import AgeClock
from appliance.store.ends import EndKind, EndTable
from appliance.store.state_file import StateStore
from tests.support.engines import InlineDatabase


def ends_of(store: StateStore, folder: Path, **role: Any) -> EndTable:
    return EndTable(store, AgeClock(folder / "age"), **role)


def ends_in(folder: Path) -> EndTable:
    """Return ends over a new state."""
    return ends_of(StateStore(folder, failed=pytest.fail, kind=InlineDatabase), folder)


class Ending(ABC):
    """The owner of one kind, made again at each start over the same state."""

    kind: ClassVar[EndKind]

    def __init__(self, store: StateStore, ends: EndTable) -> None:
        self.store = store
        self.ends = ends

    @abstractmethod
    async def begin(self, seconds: float) -> None:
        """Let the owner begin a thing that ends after this time."""

    @abstractmethod
    def lasts(self) -> bool:
        """Return whether the owner treats the thing as not ended."""

    async def still_lasts(self) -> bool:
        self.ends.look()
        for _ in range(3):  # an owner may end it in a task
            await asyncio.sleep(0)
        return self.lasts()
