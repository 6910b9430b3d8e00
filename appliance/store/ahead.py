"""Statements that are on their way to the database, kept in a file so that a killed process loses none.

A statement is appended (one small write to the page cache, microseconds, no waiting for a disk) before anything is
answered because of it. When the database has taken all of them the file is emptied. After a crash the statements that
are still in it are carried out again: each is idempotent, and their order is kept.

What that wins over a commit of each statement (`python -m benchmarks.state_writes`): the thread that answers everybody
is held up for half as long by a registration (20 µs, not 45), and never by SQLite's one writer, which keeps a tree of
parameters of 16 MiB for a third of a second. Beside any tree one registration in a hundred would wait 3 to 17 ms, where
both cores are busy; ahead of it, 0.06 ms.

What this outlasts is the death of the process, and after `sync` that of the machine's power, as the database's own WAL.
"""

import errno
import os
import struct
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec

Parameter = str | int | float | bytes | None
Parameters = Sequence[Parameter]
Statement = tuple[str, Parameters]

_LENGTH = struct.Struct(">I")


class WriteAheadClosedError(OSError):
    """The file was used after `close`."""


class WriteAhead:
    """The file at `path`. Raises `OSError` when it cannot be opened.

    Any thread may use it. The number of its descriptor is read under the lock alone: `close` waits for a write that is
    under way, and every later use raises `WriteAheadClosedError`. So nothing is written to a file that gets the number.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._open_descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o600)
        self._encoder = msgspec.msgpack.Encoder()
        self._lock = threading.Lock()
        self._waiting = 0  # statements in the file that the database does not have

    @contextmanager
    def _descriptor(self) -> Iterator[int]:
        with self._lock:
            if self._open_descriptor < 0:
                raise WriteAheadClosedError(errno.EBADF, "the state is closed already", str(self._path))
            yield self._open_descriptor

    def left(self) -> list[Statement]:
        """What an earlier process could not bring to the database; a torn last statement was never answered for."""
        with self._descriptor() as descriptor:
            data = os.pread(descriptor, os.fstat(descriptor).st_size, 0)
        decoder = msgspec.msgpack.Decoder(tuple[str, list[Any]])
        statements: list[Statement] = []
        position = 0
        while position + _LENGTH.size <= len(data):
            (length,) = _LENGTH.unpack_from(data, position)
            body = data[position + _LENGTH.size : position + _LENGTH.size + length]
            if len(body) < length:
                break
            statements.append(decoder.decode(body))
            position += _LENGTH.size + length
        return statements

    def append(self, statements: Sequence[Statement]) -> None:
        """Keep statements, by one write. Raises `OSError` when the disk is full."""
        bodies = [self._encoder.encode(statement) for statement in statements]
        data = b"".join([_LENGTH.pack(len(body)) + body for body in bodies])
        with self._descriptor() as descriptor:
            self._waiting += len(statements)
            written = os.write(descriptor, data)
            if written < len(data):
                os.ftruncate(descriptor, os.fstat(descriptor).st_size - written)
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def taken(self, count: int) -> None:
        """The database has the `count` oldest statements; the file is emptied when those were all."""
        with self._descriptor() as descriptor:
            self._waiting -= count
            if not self._waiting:
                os.ftruncate(descriptor, 0)

    def clear(self) -> None:
        """The database has everything."""
        with self._descriptor() as descriptor:
            os.ftruncate(descriptor, 0)

    def sync(self) -> None:
        """Flush the file to the disk; others may append meanwhile. Raises `OSError`."""
        with self._descriptor() as descriptor:
            own = os.dup(descriptor)
        try:
            os.fsync(own)
        finally:
            os.close(own)

    def close(self) -> None:
        """Close the file once nothing uses it; closing it again does nothing."""
        with self._lock:
            if self._open_descriptor >= 0:
                os.close(self._open_descriptor)
                self._open_descriptor = -1
