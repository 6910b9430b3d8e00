"""Large amounts of free memory that the allocator keeps are returned to the system."""

import subprocess
import sys

import pytest

from appliance.control.spare_memory import MUCH, SpareMemory

pytestmark = pytest.mark.anyio

# Pieces of a hundred megabytes are freed below the last piece, which is still in use.
_FREED = """
import asyncio
from appliance.control.spare_memory import MUCH, SpareMemory, resident

spare, before = SpareMemory(), resident()
pieces = [b"x" * 100_000 for _ in range(1000)]
last = pieces[-1]
del pieces
kept = resident() - before
asyncio.run(spare.look())
print(kept > MUCH, resident() - before < MUCH, kept >> 20, (resident() - before) >> 20)
"""


class Process:
    """A process of `size` bytes, of which only `live` are in use."""

    def __init__(self, size: int) -> None:
        self.size = self.live = size
        self.times = 0

    def give_back(self) -> None:
        """Give the unused memory back to the system."""
        self.size = self.live
        self.times += 1


async def test_freed_memory_is_returned() -> None:
    """glibc keeps much of the freed memory; one check returns it to the system."""
    done = subprocess.run([sys.executable, "-c", _FREED], capture_output=True, text=True, check=True)
    assert done.stdout.split()[:2] == ["True", "True"], done.stdout


async def test_memory_freed_later_is_returned() -> None:
    """Memory in use at one check and freed before the next is returned by the next."""
    process = Process(100 << 20)
    spare = SpareMemory(size=lambda: process.size, give_back=process.give_back)
    process.size = process.live = (100 << 20) + 2 * MUCH
    await spare.look()
    process.live = 100 << 20
    await spare.look()
    assert process.size == 100 << 20


async def test_a_little_memory_is_kept() -> None:
    """Slightly above the lowest use of the process, no memory is returned."""
    process = Process(200 << 20)
    spare = SpareMemory(size=lambda: process.size, give_back=process.give_back)
    process.size = process.live = 50 << 20
    await spare.look()
    process.size += MUCH
    await spare.look()
    assert process.times == 0
    process.size += 1
    await spare.look()
    assert process.times == 1
