"""Read and write which audit logs a signer has signed, and which of them an operator set aside.

The folder of the signer has for each log

- an entry in `logs`: its id, and the number of its first signed checkpoint. Entries stay if the memory is removed;
- `<log>.signed`, the memory: that number, and the hashes of all signed checkpoints;
- `<log>.acknowledged`, if an operator set the log aside: the state of the memory at that time.

Only the signer and root can write there: no process that can replace a log can acknowledge that.
"""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import msgspec

from appliance.base.atomic_files import write_whole

INDEX = "logs"
HASH_BYTES, HEADER_BYTES = 32, 8
_LARGEST = 1 << 20

Open = Callable[[Path], int]
"""Opens a file or folder, and returns its descriptor."""


class Acknowledgement(msgspec.Struct, frozen=True):
    """An operator's statement that a log, or the memory of it, is missing for a known reason."""

    first: int
    last: int
    time: int
    by: int


class IndexedLog(msgspec.Struct, frozen=True):
    """An entry of the index."""

    log: str
    first: int


class RememberedLog(msgspec.Struct, frozen=True):
    """A log that the signer has signed.

    `begun` is the number of its first signed checkpoint. The memory has those from `first` to `last`, whose hash is
    `hash`; without a memory, they are 0 and "".
    """

    log: str
    begun: int
    first: int = 0
    last: int = 0
    hash: str = ""
    acknowledgement: Acknowledgement | None = None

    @property
    def is_set_aside(self) -> bool:
        """Return whether an operator acknowledged that this is no longer the present log."""
        known = self.acknowledgement
        return known is not None and known.last == self.last

    @property
    def lacks_memory(self) -> bool:
        """Return whether the beginning of the memory, or all of it, was removed and no operator acknowledged that."""
        known = self.acknowledgement
        return self.first != self.begun and (known is None or known.first != self.first)

    def needs_acknowledgement(self, present: str) -> bool:
        """Return whether an operator must acknowledge it, if `present` is the id of the present log."""
        return self.lacks_memory if self.log == present else not self.is_set_aside

    def state(self, present: str) -> str:
        return "present" if self.log == present else "set aside" if self.is_set_aside else "missing"

    def as_object(self, present: str) -> dict[str, str | int | bool]:
        return {
            "log": self.log,
            "state": self.state(present),
            "first": self.first,
            "last": self.last,
            "hash": self.hash,
            "needs_acknowledgement": self.needs_acknowledgement(present),
        }


class OtherLog(msgspec.Struct, frozen=True):
    """A log that the signer signed besides the present one, up to checkpoint `last` with the hash `hash`."""

    log: Annotated[str, msgspec.Meta(description="the id of the log")]
    last: Annotated[int, msgspec.Meta(description="its last signed checkpoint")]
    hash: Annotated[str, msgspec.Meta(description="the hash of that checkpoint's text")]
    set_aside: Annotated[
        int | None,
        msgspec.Meta(description="when an operator set it aside, in nanoseconds since the epoch, or null"),
    ] = None


def plainly(path: Path) -> int:
    return os.open(path, os.O_RDONLY | os.O_CLOEXEC)


def remembered_logs(folder: Path, opened: Open = plainly) -> list[RememberedLog]:
    """Return all logs that the signer signed, in order. Raises `OSError`, and `ValueError` for a damaged file."""
    there = opened(folder)
    try:
        names = os.listdir(there)  # noqa: PTH208  a folder that perhaps only its owner can open
    finally:
        os.close(there)
    stems = sorted(name.removesuffix(".signed") for name in names if name.endswith(".signed"))
    index = read_index(folder, opened)
    known = {entry.log for entry in index}
    unlisted = [
        IndexedLog(log, 0) for log in stems if log not in known
    ]  # by an earlier version, or before a crash
    return [_remember(folder, entry, opened) for entry in [*index, *unlisted]]


def read_index(folder: Path, opened: Open = plainly) -> list[IndexedLog]:
    content = _read(folder / INDEX, opened, _LARGEST)
    return [] if content is None else msgspec.json.decode(content, type=list[IndexedLog])


def sync_index(folder: Path) -> None:
    """List logs that an earlier version signed, or the last one before a crash. Raises `OSError`, `ValueError`."""
    index = [IndexedLog(log.log, log.begun) for log in remembered_logs(folder)]
    if index != read_index(folder):
        write_whole(folder / INDEX, msgspec.json.encode(index), 0o600)


def acknowledge(folder: Path, remembered_log: RememberedLog, time: int, by: int) -> None:
    """Write that an operator set the log aside, as it is in the memory now. Raises `OSError`."""
    content = msgspec.json.encode(Acknowledgement(remembered_log.first, remembered_log.last, time, by))
    write_whole(folder / f"{remembered_log.log}.acknowledged", content, 0o600)


def others(logs: list[RememberedLog], present: str) -> list[OtherLog]:
    return [
        OtherLog(
            log.log,
            log.last,
            log.hash,
            log.acknowledgement.time if log.is_set_aside and log.acknowledgement else None,
        )
        for log in logs
        if log.log != present
    ]


def _remember(folder: Path, entry: IndexedLog, opened: Open) -> RememberedLog:
    first, last, digest = _memory(folder / f"{entry.log}.signed", opened)
    content = _read(folder / f"{entry.log}.acknowledged", opened, _LARGEST)
    known = None if content is None else msgspec.json.decode(content, type=Acknowledgement)
    return RememberedLog(entry.log, entry.first or first, first, last, digest, known)


def _memory(path: Path, opened: Open) -> tuple[int, int, str]:
    try:
        descriptor = opened(path)
    except FileNotFoundError:
        return 0, 0, ""
    try:
        count = (os.fstat(descriptor).st_size - HEADER_BYTES) // HASH_BYTES
        first = int.from_bytes(os.pread(descriptor, HEADER_BYTES, 0), "big")
        if count < 1:
            return 0, 0, ""
        place = HEADER_BYTES + (count - 1) * HASH_BYTES
        return first, first + count - 1, os.pread(descriptor, HASH_BYTES, place).hex()
    finally:
        os.close(descriptor)


def _read(path: Path, opened: Open, largest: int) -> bytes | None:
    try:
        descriptor = opened(path)
    except FileNotFoundError:
        return None
    with os.fdopen(descriptor, "rb") as file:
        return file.read(largest)
