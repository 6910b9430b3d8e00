"""Return unused memory of control to the system.

Large values are read and written in threads, and glibc keeps up to 64 MiB of freed memory per thread. If every large
block had its own mapping, its memory would be returned at once. But this takes twice as long, because the kernel
allocates the pages again for each copy. So control returns the memory a little later.
"""

import asyncio
import ctypes
import resource
from collections.abc import Callable
from pathlib import Path

_LOOK_SECONDS = 3.0
MUCH = 32 << 20


def resident() -> int:
    """Return the resident memory of this process in bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def give_back() -> None:
    """Return the allocator's free memory to the system. Other Python threads run in the meantime."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc only; other C libraries keep less memory
    if trim is not None:
        trim(0)


class SpareMemory:
    """Return free memory while the process has over `MUCH` bytes more than its minimum.

    This repeats even if the memory is in use, because the allocator keeps memory that is freed later.
    """

    def __init__(
        self, *, size: Callable[[], int] = resident, give_back: Callable[[], None] = give_back
    ) -> None:
        self._size = size
        self._give_back = give_back
        self._least = size()

    async def watch(self) -> None:
        """Check every few seconds; runs until cancelled."""
        while True:
            await asyncio.sleep(_LOOK_SECONDS)
            await self.look()

    async def look(self) -> None:
        """Return free memory if there may be more than `MUCH` bytes of free memory."""
        size = self._size()
        self._least = min(self._least, size)
        if size > self._least + MUCH:
            await asyncio.to_thread(self._give_back)
