import subprocess
import sys

import pytest

pytestmark = pytest.mark.nightly

# Pieces of a hundred megabytes are freed below the last piece, which is still in use. The child ends once most of them
# are returned; otherwise the time limit of the test ends it.
_FREED = """
import asyncio
from appliance.control.process import MUCH, resident, return_spare_memory

async def main():
    before = resident()
    watch = asyncio.create_task(return_spare_memory(0.01))
    await asyncio.sleep(0)
    pieces = [b"x" * 100_000 for _ in range(1000)]
    last = pieces[-1]
    del pieces
    assert resident() - before > MUCH, "the allocator keeps nothing"
    while resident() - before > MUCH:
        await asyncio.sleep(0.01)
    assert not watch.done()

asyncio.run(main())
"""


def test_freed_memory_is_returned() -> None:
    subprocess.run([sys.executable, "-c", _FREED], check=True, timeout=30)
