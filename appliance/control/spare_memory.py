"""Return unused memory of control to the system.

glibc keeps up to 64 MiB of freed memory for each thread that reads or writes large values. Mapping every large block
separately would return it at once, but take twice as long.
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
    """Return free memory while the process has over `MUCH` bytes more than its minimum.

    This repeats even if the memory is in use, because the allocator keeps memory that is freed later.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc only; other C libraries keep less memory
    least = resident()
    while True:
        await asyncio.sleep(seconds)
        least = min(least, size := resident())
        if trim is not None and size > least + MUCH:
            await asyncio.to_thread(trim, 0)
