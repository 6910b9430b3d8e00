"""Return unused memory of control to the system.

Large values are read and written in threads, and glibc keeps up to 64 MiB of freed memory per thread. If every large
block had its own mapping, its memory would be returned at once. But this takes twice as long, because the kernel
allocates the pages again for each copy. So control returns the memory a little later.
"""

import asyncio
import ctypes
import resource
from pathlib import Path

_LOOK_SECONDS = 3.0
MUCH = 32 << 20


def resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


async def return_spare_memory(seconds: float = _LOOK_SECONDS) -> None:
    """Return free memory while the process has over `MUCH` bytes more than its minimum; runs until cancelled.

    This repeats even if the memory is in use, because the allocator keeps memory that is freed later.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc only; other C libraries keep less memory
    least = resident()
    while True:
        await asyncio.sleep(seconds)
        least = min(least, size := resident())
        if trim is not None and size > least + MUCH:
            await asyncio.to_thread(trim, 0)
