"""Registering calls under one name are carried out one after the other.

Between the decision on a registration and ROSMaster's answer the registry does not know of it yet. Two hosts that
register a free name at the same moment would both be told that it is free, and the later one would take it from the
other. So the calls that make a node part of the graph wait for each other, name by name; a decision is made when it
is the caller's turn.
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from dataclasses import dataclass, field


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
    async def alone(self, name: str) -> AsyncIterator[None]:
        """Be the only one who registers under this name, first come, first served."""
        claim = self._claims.setdefault(name, _Claim())
        claim.users += 1
        try:
            async with claim.lock:
                yield
        finally:
            claim.users -= 1
            if not claim.users:
                del self._claims[name]
