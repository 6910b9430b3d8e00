"""Keep results of finished jobs: in a journal, with which an interrupted command continues, or in a temporary file.

The key of a result is the hash of its job, which has the specifications, the options, the version, and the
recording's name, size and time of change. Each line has a checksum: a job with a damaged result runs again,
and a line that a crash cut off is removed.
"""

import base64
import binascii
import fcntl
import hashlib
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from mmap import ACCESS_READ, mmap
from pathlib import Path
from tempfile import TemporaryFile, gettempdir
from types import TracebackType
from typing import Self

_HEAD = b"rosmop results 1\n"
_DIGEST = 64  # characters


class JournalError(Exception):
    """The journal cannot be used."""


class ResumeJournal:
    """An open journal, locked against other commands. Raises `JournalError`."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._places: dict[bytes, tuple[int, int]] = {}
        try:
            # O_NONBLOCK: a named pipe is rejected, and not waited for.
            flags = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC | os.O_NONBLOCK
            self._file = os.fdopen(os.open(path, flags, 0o600), "r+b", buffering=0)
        except OSError as error:
            raise JournalError(f"cannot open {path}: {error.strerror}") from error
        try:
            if not stat.S_ISREG(os.fstat(self._file.fileno()).st_mode):
                raise JournalError(f"cannot open {path}: not a regular file")
            fcntl.flock(self._file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._read()
        except BlockingIOError as error:
            self._file.close()
            raise JournalError(f"{path} is in use by another command") from error
        except OSError as error:
            self._file.close()
            raise JournalError(f"cannot use {path}: {error.strerror}") from error
        except JournalError:
            self._file.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def result(self, job: bytes) -> bytes | None:
        place = self._places.get(_digest(job))
        if place is None:
            return None
        _key, checksum, text = os.pread(self._file.fileno(), place[1], place[0]).split(b" ", 2)
        try:
            result = base64.b64decode(text, validate=True)
        except binascii.Error:
            return None
        return result if checksum == _digest(job + result) else None

    def add(self, job: bytes, result: bytes) -> None:
        line = b"%b %b %b\n" % (_digest(job), _digest(job + result), base64.b64encode(result))
        try:
            self._places[_digest(job)] = os.lseek(self._file.fileno(), 0, os.SEEK_END), len(line) - 1
            append(self._file.fileno(), line)
            os.fdatasync(self._file.fileno())
        except OSError as error:
            raise JournalError(f"cannot write {self._path}: {error.strerror}") from error

    def _read(self) -> None:
        with os.fdopen(os.dup(self._file.fileno()), "rb") as file:
            head = file.readline(len(_HEAD))
            if not _HEAD.startswith(head):
                raise JournalError(f"{self._path} is not a journal of this version; give a new file")
            if head != _HEAD:  # it is new, or the first write was cut off
                os.ftruncate(self._file.fileno(), 0)
                append(self._file.fileno(), _HEAD)
                return
            place = len(_HEAD)
            for line in file:
                if not line.endswith(b"\n"):
                    os.ftruncate(self._file.fileno(), place)
                    break
                if line.count(b" ") == 2:  # otherwise it is damaged
                    self._places[line[:_DIGEST]] = place, len(line) - 1
                place += len(line)


def append(descriptor: int, data: bytes) -> None:
    left = memoryview(data)
    while left:
        left = left[os.write(descriptor, left) :]


class TemporaryStore:
    """A file without a name in the temporary folder (`TMPDIR`). Raises `JournalError`."""

    def __init__(self) -> None:
        with self._errors():
            self._file = TemporaryFile(buffering=0)  # noqa: SIM115  closed by __exit__
        self.size = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def append(self, data: bytes) -> tuple[int, int]:
        with self._errors():
            append(self._file.fileno(), data)
        self.size += len(data)
        return self.size - len(data), len(data)

    def read(self, place: tuple[int, int]) -> bytes:
        with self._errors():
            return os.pread(self._file.fileno(), place[1], place[0])

    def whole(self) -> bytes | mmap:
        return mmap(self._file.fileno(), self.size, access=ACCESS_READ) if self.size else b""

    @staticmethod
    @contextmanager
    def _errors() -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise JournalError(f"cannot use a temporary file in {gettempdir()}: {error.strerror}") from error


def _digest(data: bytes) -> bytes:
    return hashlib.sha256(data).hexdigest().encode("ascii")
