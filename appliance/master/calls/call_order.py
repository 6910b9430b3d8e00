"""Calls that touch each other are carried out one after the other: registrations by name, writes of parameters by key.

Between the decision on a registration and ROSMaster's answer the registry does not know of it yet. Two hosts that
register a free name at the same moment would both be told that it is free, and the later one would take it from the
other. So the calls that make a node part of the graph wait for each other, name by name; a decision is made when it
is the caller's turn. Who finds nobody before him enters without letting anything else run in between: what was decided
just before stands.

A write is decided by what is there: a value that stands where it needs a namespace is written, too. Between the
decision and ROSMaster's answer another write could put such a value there, which nobody would have asked about. And
two writes of one key that travel on two connections could reach ROSMaster in another order than the mirror. So
whoever writes a key waits for those who came before and write it, something above it or something below it; a
decision is made when it is the writer's turn.
"""

import asyncio
from collections import deque
from collections.abc import Collection


class WriteTurns:
    """The writes that are under way or wait, in the order they came."""

    def __init__(self) -> None:
        self._turns: dict[WriteTurn, None] = {}

    def __len__(self) -> int:
        return len(self._turns)

    def alone(self, keys: Collection[str]) -> "WriteTurn":
        """To be the only one who writes these keys (canonical), what is above and what is below them: `async with`."""
        return WriteTurn(self._turns, _ended(keys))


class WriteTurn:
    """One write: entered when those before it that touch it are done."""

    __slots__ = ("_done", "_keys", "_turns")

    def __init__(self, turns: "dict[WriteTurn, None]", keys: tuple[str, ...]) -> None:
        self._turns = turns
        self._keys = keys
        self._done: asyncio.Event | None = None  # made for who waits for this one

    async def __aenter__(self) -> bool:
        """Whether it had to wait."""
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
        """Set when this one has ended."""
        if self._done is None:
            self._done = asyncio.Event()
            if self not in self._turns:
                self._done.set()
        return self._done

    def _end(self) -> None:
        del self._turns[self]
        if self._done is not None:
            self._done.set()

    def _touches(self, other: "WriteTurn") -> bool:
        return _meet(self._keys, other._keys)


def touch(keys: Collection[str], others: Collection[str]) -> bool:
    """Whether a key of one side is, or is above, one of the other side."""
    return _meet(_ended(keys), _ended(others))


def _ended(keys: Collection[str]) -> tuple[str, ...]:
    """The keys with a slash at their end: one is above another if it is how the other begins."""
    return tuple({key if key == "/" else f"{key}/" for key in keys})


def _meet(mine: tuple[str, ...], others: tuple[str, ...]) -> bool:
    return any(key.startswith(others) for key in mine) or any(other.startswith(mine) for other in others)


class Claims:
    """The names that are in use at the moment, each with those who wait for it; nothing is kept of other names."""

    def __init__(self) -> None:
        self._waiting: dict[str, deque[asyncio.Future[None]]] = {}

    def __len__(self) -> int:
        return len(self._waiting)

    def alone(self, name: str) -> "Claim":
        """To be the only one who registers under this name, first come, first served: `async with`."""
        return Claim(self._waiting, name)


class Claim:
    """One registering call: entered when those before it under its name have ended."""

    __slots__ = ("_name", "_waiting")

    def __init__(self, waiting: dict[str, deque[asyncio.Future[None]]], name: str) -> None:
        self._waiting = waiting
        self._name = name

    async def __aenter__(self) -> bool:
        """Whether it had to wait."""
        before = self._waiting.get(self._name)
        if before is None:
            self._waiting[self._name] = deque()
            return False
        turn = asyncio.get_running_loop().create_future()
        before.append(turn)
        try:
            await turn
        except asyncio.CancelledError:
            if turn.cancelled():
                before.remove(turn)
            else:  # it was its turn already
                self._end()
            raise
        return True

    async def __aexit__(self, *_error: object) -> None:
        self._end()

    def _end(self) -> None:
        """The next one is let in; one that was cancelled and has not run since is no more there."""
        waiting = self._waiting[self._name]
        turn = next((future for future in waiting if not future.done()), None)
        if turn is None:
            del self._waiting[self._name]
        else:
            waiting.remove(turn)
            turn.set_result(None)
