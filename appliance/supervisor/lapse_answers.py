"""Answer operators while there is no control, and while it starts again without the right to serve.

Every request gets the same answer, unparsed. For less than `_PATIENCE_SECONDS`, requests wait for control.
"""

import asyncio
import contextlib
import socket
from collections.abc import Callable
from functools import partial

import msgspec

from appliance.base.unix_sockets import KEEP_PATH

_PATIENCE_SECONDS = 1.0
_REQUEST_SECONDS = 1.0
_LONGEST_REQUEST = 16 << 20  # bytes, as in `control/admin_socket.py`


async def answer_for_control(listener: Callable[[], socket.socket], reason: str) -> None:
    """Answer all requests with `reason`; `listener()` copies the admin socket."""
    await asyncio.sleep(_PATIENCE_SECONDS)
    async with await asyncio.start_unix_server(
        partial(_answer, reason), sock=listener(), limit=_LONGEST_REQUEST, **KEEP_PATH
    ) as server:
        await server.serve_forever()


async def _answer(reason: str, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with contextlib.suppress(OSError, ValueError, TimeoutError):
        async with asyncio.timeout(_REQUEST_SECONDS):
            await reader.readline()
            writer.write(msgspec.json.encode({"ok": False, "error": reason, "trouble": "failed"}) + b"\n")
            await writer.drain()
    writer.close()
