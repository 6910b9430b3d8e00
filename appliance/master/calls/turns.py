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
import contextlib
from collections.abc import AsyncIterator, Collection
from dataclasses import dataclass, field


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
    return any(one.startswith(others) for one in mine) or any(other.startswith(mine) for other in others)


@dataclass(slots=True)
class _Claim:
    lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    users: int = 0


class Claims:
    """One lock per name that is in use at the moment; nothing is kept of other names."""

    def __init__(self) -> None:
        self._claims: dict[str, _Claim] = {}

    def __len__(self) -> int:
        return len(self._claims)

    @contextlib.asynccontextmanager
    async def alone(self, name: str) -> AsyncIterator[bool]:
        """Be the only one who registers under this name, first come, first served; whether it had to wait."""
        claim = self._claims.setdefault(name, _Claim())
        claim.users += 1
        waited = claim.users > 1
        try:
            async with claim.lock:
                yield waited
        finally:
            claim.users -= 1
            if not claim.users:
                del self._claims[name]
