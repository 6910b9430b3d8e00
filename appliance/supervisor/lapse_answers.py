"""Answer operators while a lapse of the lease stops control.

Requests on the admin socket would otherwise wait until control goes on or starts again, up to `LONGEST_LAPSE` seconds.
The supervisor reads each request up to its line end without parsing it, and gives every request the same answer. Most
lapses are shorter than `_PATIENCE_SECONDS`: control itself answers after these.
"""

import asyncio
import contextlib
import socket
from collections.abc import Callable

import msgspec

from appliance.supervisor.lease_watch import LONGEST_LAPSE

PAUSED = (
    "the appliance is paused: its lease has lapsed, and it answers and relays nothing until the lease is renewed; after"
    f" {LONGEST_LAPSE:g} s it becomes the standby. Check its load, and its network to the robot and the other appliance"
)
_ANSWER = msgspec.json.encode({"ok": False, "error": PAUSED, "trouble": "failed"}) + b"\n"
_PATIENCE_SECONDS = 1.0
_REQUEST_SECONDS = 1.0
_LONGEST_REQUEST = 16 << 20  # bytes, as in `control/admin_socket.py`


async def answer_paused(listener: Callable[[], socket.socket]) -> None:
    """Answer on the listening admin socket until cancelled, from `_PATIENCE_SECONDS` on; `listener()` makes a copy."""
    await asyncio.sleep(_PATIENCE_SECONDS)
    async with await asyncio.start_unix_server(_answer, sock=listener(), limit=_LONGEST_REQUEST) as server:
        await server.serve_forever()


async def _answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with contextlib.suppress(OSError, ValueError, TimeoutError):
        async with asyncio.timeout(_REQUEST_SECONDS):
            await reader.readline()
            writer.write(_ANSWER)
            await writer.drain()
    writer.close()
