"""Keep listening sockets open while control restarts, so that connections wait in the kernel's queue.

Names are checked and counted, so a faulty control cannot fill the memory.
"""

import os
import re
import socket
from collections.abc import Iterator

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.:/\[\]-]{0,199}")


class ListenerRejectedError(ValueError):
    """A socket is not kept."""


class ListenerStore:
    """The kept sockets. It owns their descriptors."""

    def __init__(self, *, limit: int = 10_000) -> None:
        self._limit = limit
        self._sockets: dict[str, int] = {}

    def __len__(self) -> int:
        return len(self._sockets)

    def __iter__(self) -> Iterator[tuple[str, int]]:
        return iter(list(self._sockets.items()))

    def keep(self, name: str, descriptor: int) -> None:
        """Keep a socket in place of the earlier one of its name. Raises `ListenerRejectedError`, and then closes it."""
        try:
            self._check(name, descriptor)
        except ListenerRejectedError:
            os.close(descriptor)
            raise
        self.drop(name)
        self._sockets[name] = descriptor

    def drop(self, name: str) -> None:
        descriptor = self._sockets.pop(name, None)
        if descriptor is not None:
            os.close(descriptor)

    def copy_of(self, name: str) -> socket.socket:
        return socket.socket(fileno=os.dup(self._sockets[name]))

    def close(self) -> None:
        for name in list(self._sockets):
            self.drop(name)

    def _check(self, name: str, descriptor: int) -> None:
        if not _NAME.fullmatch(name):
            raise ListenerRejectedError(f"{name[:80]!r} is not a valid name for a kept socket")
        if name not in self._sockets and len(self._sockets) >= self._limit:
            raise ListenerRejectedError(f"{self._limit} sockets are kept already; {name!r} exceeds the limit")
        try:
            with socket.socket(fileno=os.dup(descriptor)) as sock:
                listens = sock.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN) == 1
        except OSError as error:
            raise ListenerRejectedError(f"{name!r} is not a socket: {error.strerror}") from error
        if not listens:
            raise ListenerRejectedError(f"{name!r} does not listen")
