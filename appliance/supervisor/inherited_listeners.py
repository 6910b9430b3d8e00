"""The listening sockets that outlive control.

Control opens the ports that nodes know and gives each to the supervisor under a name; when control dies
the ports stay open here, connections wait in the kernel's queue, and the next control gets every one
back. Nothing is ever accepted or read here. Names are control's; they are checked and counted so that a
control gone wrong cannot grow the supervisor.
"""

import os
import re
import socket
from collections.abc import Iterator

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.:/\[\]-]{0,199}")


class RefusedSocketError(ValueError):
    """A socket that is not kept; the message says why."""


class KeptSockets:
    """Listening sockets by name. Owns the descriptors it holds."""

    def __init__(self, *, limit: int = 10_000) -> None:
        self._limit = limit
        self._sockets: dict[str, int] = {}

    def __len__(self) -> int:
        return len(self._sockets)

    def __iter__(self) -> Iterator[tuple[str, int]]:
        return iter(list(self._sockets.items()))

    def keep(self, name: str, descriptor: int) -> None:
        """Keep `descriptor` (now owned here, also when it is refused) under `name`; replaces an earlier one.

        Raises `RefusedSocketError` for a bad name, something that does not listen, or one too many.
        """
        try:
            self._check(name, descriptor)
        except RefusedSocketError:
            os.close(descriptor)
            raise
        self.drop(name)
        self._sockets[name] = descriptor

    def drop(self, name: str) -> None:
        """Close a kept socket; a name that is not known is nothing to do."""
        descriptor = self._sockets.pop(name, None)
        if descriptor is not None:
            os.close(descriptor)

    def close(self) -> None:
        """Close all of them."""
        for name in list(self._sockets):
            self.drop(name)

    def _check(self, name: str, descriptor: int) -> None:
        if not _NAME.fullmatch(name):
            raise RefusedSocketError(f"{name[:80]!r} is not a name for a kept socket")
        if name not in self._sockets and len(self._sockets) >= self._limit:
            raise RefusedSocketError(
                f"{self._limit} sockets are kept already; {name!r} would be one too many"
            )
        try:
            with socket.socket(fileno=os.dup(descriptor)) as sock:
                listens = sock.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN) == 1
        except OSError as error:
            raise RefusedSocketError(f"{name!r} is not a socket: {error.strerror}") from error
        if not listens:
            raise RefusedSocketError(f"{name!r} does not listen")
