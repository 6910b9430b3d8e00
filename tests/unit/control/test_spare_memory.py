"""What the allocator keeps of large values goes back to the system, and only then."""

import subprocess
import sys

import pytest

from appliance.control.spare_memory import MUCH, SpareMemory

pytestmark = pytest.mark.anyio

# A hundred megabytes in pieces come free below the last piece, which is still in use.
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
    """A process of some size, of which nothing is live beyond `live`."""

    def __init__(self, size: int) -> None:
        self.size = self.live = size
        self.times = 0

    def give_back(self) -> None:
        """What is not live goes."""
        self.size = self.live
        self.times += 1


async def test_what_was_freed_goes_back() -> None:
    """Of what was freed, glibc keeps more than is much; after one look it does not."""
    done = subprocess.run([sys.executable, "-c", _FREED], capture_output=True, text=True, check=True)
    assert done.stdout.split()[:2] == ["True", "True"], done.stdout


async def test_what_comes_free_late_goes_back_as_well() -> None:
    """Much is in use at one look, and free and kept at the next: that look gives it back."""
    process = Process(100 << 20)
    spare = SpareMemory(size=lambda: process.size, give_back=process.give_back)
    process.size = process.live = (100 << 20) + 2 * MUCH
    await spare.look()
    process.live = 100 << 20
    await spare.look()
    assert process.size == 100 << 20


async def test_little_is_not_worth_it() -> None:
    """Where there is little more than the least that the process has had, nothing is done."""
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
