"""Serve on a Unix socket that outlives its server."""

import sys
from typing import TypedDict


class _Option(TypedDict, total=False):
    cleanup_socket: bool


# From Python 3.13 on, asyncio deletes the path of a socket when its server closes, even if the caller made the socket.
KEEP_PATH: _Option = {"cleanup_socket": False} if sys.version_info >= (3, 13) else {}
