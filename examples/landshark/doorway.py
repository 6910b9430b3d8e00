"""Forward a loopback port to a host of a lab for the demonstration's console: a lab has no link to this machine.

Clients are not authenticated here, because the console requires a token.
"""

import contextlib
import socket
import threading
from types import TracebackType
from typing import Self

from examples.landshark.lab import Host

CONNECTIONS = 64  # a browser needs a few; further connections wait in the kernel's queue
CONNECT_SECONDS = 5.0
_PIECE = 65536


class Doorway:
    """A port on 127.0.0.1 of this machine, forwarded to `target`, an address on `host`."""

    def __init__(self, host: Host, target: tuple[str, int]) -> None:
        self._host, self._target = host, target
        self._free = threading.Semaphore(CONNECTIONS)
        self._lock = threading.Lock()
        self._open: set[socket.socket] = set()
        self._closed = False
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._thread = threading.Thread(target=self._serve, name="doorway", daemon=True)
        self._thread.start()

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)  # wakes `accept`
        self._listener.close()
        self._free.release()  # wakes `_serve` if all connections are in use
        with self._lock:
            self._closed = True
            for end in self._open:
                with contextlib.suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)
        self._thread.join(CONNECT_SECONDS)

    def _serve(self) -> None:
        while True:
            self._free.acquire()
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            threading.Thread(target=self._carry, args=(near,), name="doorway connection", daemon=True).start()

    def _carry(self, near: socket.socket) -> None:
        try:
            with near:
                far = self._host.run(lambda: socket.create_connection(self._target, CONNECT_SECONDS))
                with far:
                    far.settimeout(None)
                    self._both_ways(near, far)
        except OSError:
            pass  # the target does not answer, or one side closed: both connections end
        finally:
            self._free.release()

    def _both_ways(self, near: socket.socket, far: socket.socket) -> None:
        with self._lock:
            if self._closed:
                return
            self._open |= {near, far}
        try:
            back = threading.Thread(target=_pass_on, args=(far, near), name="doorway back", daemon=True)
            back.start()
            _pass_on(near, far)
            back.join()
        finally:
            with self._lock:
                self._open -= {near, far}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _pass_on(source: socket.socket, sink: socket.socket) -> None:
    with contextlib.suppress(OSError):
        while piece := source.recv(_PIECE):
            sink.sendall(piece)
    for end, way in ((sink, socket.SHUT_WR), (source, socket.SHUT_RD)):
        with contextlib.suppress(OSError):
            end.shutdown(way)
