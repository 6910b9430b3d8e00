"""Keep the results of finished jobs in a file, so that a command that was interrupted can continue.

The key of a result is the hash of its job. A job contains the specifications, the options, the version, and the
recording's name, size and time of change: if one of them differs, the job runs again. A line that was cut off by a
crash is ignored.
"""

import base64
import fcntl
import hashlib
import os
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Self

import msgspec

_LONGEST = 256 << 20  # bytes of a line


class JournalError(Exception):
    """The journal cannot be used, with the reason."""


class _Line(msgspec.Struct):
    job: str
    result: str


class ResumeJournal:
    """An open journal, locked against other commands. Raises `JournalError`."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._file = os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600), "r+b")
        except OSError as error:
            raise JournalError(f"cannot open {path}: {error.strerror}") from error
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._places = dict(self._read())
        except JournalError:
            self._file.close()
            raise
        except OSError as error:
            self._file.close()
            raise JournalError(f"{path} is in use by another command") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def __len__(self) -> int:
        return len(self._places)

    def result(self, job: bytes) -> bytes | None:
        """Return the result of a job, or None."""
        place = self._places.get(_key(job))
        if place is None:
            return None
        self._file.seek(place)
        return base64.b64decode(msgspec.json.decode(self._file.readline(_LONGEST), type=_Line).result)

    def add(self, job: bytes, result: bytes) -> None:
        """Write a result to the disk."""
        line = _Line(_key(job), base64.b64encode(result).decode("ascii"))
        try:
            self._places[line.job] = self._file.seek(0, os.SEEK_END)
            self._file.write(msgspec.json.encode(line) + b"\n")
            self._file.flush()
            os.fdatasync(self._file.fileno())
        except OSError as error:
            raise JournalError(f"cannot write {self._path}: {error.strerror}") from error

    def _read(self) -> Iterator[tuple[str, int]]:
        """Yield the job and the position of each line, and cut off what is not a line."""
        place = 0
        while text := self._file.readline(_LONGEST):
            try:
                line = msgspec.json.decode(text, type=_Line)
            except msgspec.DecodeError as error:
                if text.endswith(b"\n"):
                    raise JournalError(
                        f"{self._path} is not a journal of this command; give a new file"
                    ) from error
                break
            if not text.endswith(b"\n"):
                break
            yield line.job, place
            place += len(text)
        self._file.truncate(place)


def _key(job: bytes) -> str:
    return hashlib.sha256(job).hexdigest()
