"""Writes of parameters that touch each other are carried out one after the other.

A write is decided by what is there: a value that stands where it needs a namespace is written, too. Between the
decision and ROSMaster's answer another write could put such a value there, which nobody would have asked about. And
two writes of one key that travel on two connections could reach ROSMaster in another order than the mirror. So
whoever writes a key waits for those who came before and write it, something above it or something below it; a
decision is made when it is the writer's turn.
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Collection
from typing import NamedTuple


class _Turn(NamedTuple):
    keys: tuple[
        str, ...
    ]  # each with a slash at its end: a key is above another if it is how the other begins
    done: asyncio.Event


class WriteTurns:
    """The writes that are under way or wait, in the order they came."""

    def __init__(self) -> None:
        self._turns: dict[int, _Turn] = {}
        self._number = 0

    def __len__(self) -> int:
        return len(self._turns)

    @contextlib.asynccontextmanager
    async def alone(self, keys: Collection[str]) -> AsyncIterator[None]:
        """Be the only one who writes these keys (canonical), what is above and what is below them."""
        mine = tuple({key if key == "/" else f"{key}/" for key in keys})
        before = [turn.done for turn in self._turns.values() if _touch(turn.keys, mine)]
        self._number = number = self._number + 1
        self._turns[number] = turn = _Turn(mine, asyncio.Event())
        try:
            for done in before:
                await done.wait()
            yield
        finally:
            del self._turns[number]
            turn.done.set()


def _touch(some: tuple[str, ...], others: tuple[str, ...]) -> bool:
    """Whether a key of one side is, or is above, one of the other side."""
    return any(one.startswith(others) for one in some) or any(one.startswith(some) for one in others)
