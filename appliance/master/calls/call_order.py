"""Serialise overlapping calls: registrations with the same name, writes of overlapping parameter keys.

The registry gets a registration only after the ROS master's answer. Two hosts that register a free name at the same
time would both be allowed, and the later one would take the name from the other. So registering calls of a name wait
for each other, and are decided in their turn. A call that need not wait enters without a switch of tasks, so its
decision is still valid.

The decision on a write depends on the present tree: a plain value in place of a namespace that the key needs is
overwritten too. Until the ROS master's answer, another write could set such a value, which the decision did not cover.
Two writes of one key could also reach the ROS master and the mirror in different orders. So a write waits for earlier
writes of its key or of keys above or below it, and is decided in its turn.
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
        """Return an `async with` that waits for earlier calls with these canonical keys, or with overlapping ones."""
        return KeyTurn(self._turns, _ended(keys))

    def of_name(self, name: str) -> "KeyTurn":
        """Return an `async with` that waits for earlier calls with exactly this name."""
        return self.alone([name.replace("/", ".")])


class KeyTurn:
    """The turn of a call: entered when earlier overlapping calls are done."""

    __slots__ = ("_done", "_keys", "_turns")

    def __init__(self, turns: "dict[KeyTurn, None]", keys: tuple[str, ...]) -> None:
        self._turns = turns
        self._keys = keys
        self._done: asyncio.Event | None = None  # made for calls that wait for this one

    async def __aenter__(self) -> bool:
        """Wait for the turn; return whether there was a call to wait for."""
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
        """Return an event that is set when this call has ended."""
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
    """Whether a key of one side equals, or is above, a key of the other side."""
    return _meet(_ended(keys), _ended(others))


def _ended(keys: Collection[str]) -> tuple[str, ...]:
    """Return the keys with a slash at the end, so that a key above another is a prefix of it."""
    return tuple({key if key == "/" else f"{key}/" for key in keys})


def _meet(mine: tuple[str, ...], others: tuple[str, ...]) -> bool:
    return any(key.startswith(others) for key in mine) or any(other.startswith(mine) for other in others)
