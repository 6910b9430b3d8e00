"""Serialise overlapping calls: registrations of the same name, and writes of overlapping parameter keys.

A registering call may wait after its decision: for its record, for its ports, for earlier changes that the ROS master
gets. If two hosts registered a free name at the same time, both would be allowed, and the later host would take the
name away. So registering calls of a name wait for each other, and are decided in their turn. A call that need not wait
enters without a switch of tasks, so its decision is still valid.

The decision on a write depends on the present tree, because the write may overwrite a plain value above its key.
Another write could set such a value after the decision and before the ROS master's answer. Also, two writes of one key
could reach the ROS master and the mirror in different orders. So a write waits for earlier writes of its key, and of
keys above or below it, and is decided in its turn.
"""

import asyncio
from collections.abc import Collection


class KeyTurns:
    """The turns of running and waiting calls, in order of arrival."""

    def __init__(self) -> None:
        self._turns: dict[KeyTurn, None] = {}

    def __len__(self) -> int:
        return len(self._turns)

    def alone(self, keys: Collection[str]) -> "KeyTurn":
        """Return a context manager that waits for earlier calls with equal or overlapping keys (canonical)."""
        return KeyTurn(self._turns, _ended(keys))

    def of_name(self, name: str) -> "KeyTurn":
        """Return a context manager that waits for earlier calls with exactly this name."""
        return self.alone([name.replace("/", ".")])


class KeyTurn:
    """The turn of a call, an async context manager that is entered when earlier overlapping calls are done."""

    __slots__ = ("_done", "_keys", "_turns")

    def __init__(self, turns: "dict[KeyTurn, None]", keys: tuple[str, ...]) -> None:
        self._turns = turns
        self._keys = keys
        self._done: asyncio.Event | None = None  # made when another call waits for this call

    async def __aenter__(self) -> bool:
        """Wait for the turn; return whether there was another call to wait for."""
        before = [turn for turn in self._turns if self._touches(turn)]
        self._turns[self] = None
        try:
            for turn in before:
                await turn.done().wait()
        except BaseException:
            self._end()
            raise
        return bool(before)

    async def __aexit__(self, *_error: object) -> None:
        self._end()

    def done(self) -> asyncio.Event:
        if self._done is None:
            self._done = asyncio.Event()
            if self not in self._turns:
                self._done.set()
        return self._done

    def _end(self) -> None:
        del self._turns[self]
        if self._done is not None:
            self._done.set()

    def _touches(self, other: "KeyTurn") -> bool:
        return _meet(self._keys, other._keys)


def touch(keys: Collection[str], others: Collection[str]) -> bool:
    return _meet(_ended(keys), _ended(others))


def _ended(keys: Collection[str]) -> tuple[str, ...]:
    return tuple({key if key == "/" else f"{key}/" for key in keys})


def _meet(mine: tuple[str, ...], others: tuple[str, ...]) -> bool:
    return any(key.startswith(others) for key in mine) or any(other.startswith(mine) for other in others)
