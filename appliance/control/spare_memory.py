"""Memory that control has no use for any more goes back to the system.

A large value is read and written in threads, and glibc keeps what it freed there for the thread that had it: up to
64 MiB of each. Having every large block mapped by itself would give it back at once, but twice as slow: each page would
be made anew for each copy. So it is given back a little later.
"""

import asyncio
import ctypes
import resource
from collections.abc import Callable
from pathlib import Path

_LOOK_SECONDS = 3.0
MUCH = 32 << 20


def resident() -> int:
    """Bytes of memory that this process has."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def give_back() -> None:
    """Give the system what the allocator keeps; other threads of Python run meanwhile."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc's; another C library keeps less
    if trim is not None:
        trim(0)


class SpareMemory:
    """Gives memory back while the process has `MUCH` more than the least it has had.

    So it goes on where that much is in use: what comes free of it later is kept by the allocator until it is asked.
    """

    def __init__(
        self, *, size: Callable[[], int] = resident, give_back: Callable[[], None] = give_back
    ) -> None:
        self._size = size
        self._give_back = give_back
        self._least = size()

    async def watch(self) -> None:
        """Look every few seconds; runs until cancelled."""
        while True:
            await asyncio.sleep(_LOOK_SECONDS)
            await self.look()

    async def look(self) -> None:
        """Give back what is spare, if it may be much."""
        size = self._size()
        self._least = min(self._least, size)
        if size > self._least + MUCH:
            await asyncio.to_thread(self._give_back)
