"""Remember the audit checkpoints that the signer signed, so that it never signs a second history.

1. `<log>.signed` has the hashes of a log's signed checkpoints by number, and `<log>.times` the times of signing
   by the age clock. Both files only grow.
2. A checkpoint is approved if it follows the last one, or equals the one signed under its number (control lost
   the answer). An unknown log may begin with any number.
3. The signer must have approved the removal that a checkpoint contains (`<log>.removed`). The first checkpoint
   with this field in a log from an older version is trusted.
4. At most `MAX_LOGS` logs are remembered that no operator set aside, so control cannot fill the signer's disk.
5. Every answer names the other logs that were signed: a log that took the place of another one cannot hide it.
"""

import errno
import hashlib
import os
from collections.abc import Callable
from pathlib import Path

from appliance.base.atomic_files import write_whole
from appliance.signing.log_proof import Checkpoint, parse_checkpoint
from appliance.signing.signed_logs import OtherLog, others, remembered_logs, sync_index

MAX_LOGS = 64
_HASH = 32
_NUMBER = 8


class CheckpointRefusedError(Exception):
    """A checkpoint must not be signed."""


def read_checkpoint(text: bytes) -> Checkpoint:
    """Return the parsed checkpoint. Raises `CheckpointRefusedError`."""
    try:
        return parse_checkpoint(text)
    except ValueError:
        raise CheckpointRefusedError("the data to sign is not an audit checkpoint") from None


def newest_signing(directory: Path) -> int | None:
    """Return the time of the last signature (nanoseconds since the epoch), or None."""
    times = (path.read_bytes() for path in directory.glob("*.times"))
    return max(
        (int.from_bytes(kept[-_NUMBER:], "big") for kept in times if len(kept) > _NUMBER), default=None
    )


class CheckpointMemory:
    """The memory in a folder; `clock` returns nanoseconds since the epoch."""

    def __init__(self, directory: Path, clock: Callable[[], int]) -> None:
        self._directory = directory
        self._clock = clock

    def accept(self, text: bytes) -> None:
        """Remember a checkpoint that may be signed. Raises `CheckpointRefusedError`, `OSError`."""
        wanted = read_checkpoint(text)
        path = self._path(wanted.log, "signed")
        if not path.exists() or path.stat().st_size < _NUMBER + _HASH:  # as in a backup of a log without one
            self._room_for_another(wanted.log)
            self._may_be_removed(wanted)
            number, now = wanted.number.to_bytes(_NUMBER, "big"), self._clock().to_bytes(_NUMBER, "big")
            write_whole(self._path(wanted.log, "times"), number + now, 0o600)
            write_whole(path, number + _digest(wanted), 0o600)
            sync_index(self._directory)
            return
        descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        try:
            first, count = _extent(descriptor)
            if not _is_known(descriptor, wanted, first, count):
                self._may_be_removed(wanted)
                self._note_time(wanted, first)
                _keep(path, descriptor, _digest(wanted), _NUMBER + count * _HASH)
        finally:
            os.close(descriptor)

    def others(self, text: bytes) -> list[OtherLog]:
        """Return the logs that were signed besides that of a checkpoint. Raises `OSError`, `ValueError`."""
        return others(remembered_logs(self._directory), read_checkpoint(text).log)

    def signed_at(self, checkpoint: Checkpoint) -> int | None:
        path = self._path(checkpoint.log, "signed")
        if not path.exists():
            return None
        memory = path.read_bytes()
        place = _NUMBER + (checkpoint.number - int.from_bytes(memory[:_NUMBER], "big")) * _HASH
        if place < _NUMBER or memory[place : place + _HASH] != _digest(checkpoint):
            return None
        times = self._path(checkpoint.log, "times")
        kept = times.read_bytes() if times.exists() else b""
        place = _NUMBER + (checkpoint.number - int.from_bytes(kept[:_NUMBER], "big")) * _NUMBER
        moment = kept[place : place + _NUMBER] if place >= _NUMBER else b""
        return int.from_bytes(moment, "big") if len(moment) == _NUMBER else checkpoint.time

    def removed(self, log: str) -> int | None:
        path = self._path(log, "removed")
        return int.from_bytes(path.read_bytes(), "big") if path.exists() else None

    def remember_removed(self, log: str, sequence: int) -> None:
        write_whole(self._path(log, "removed"), sequence.to_bytes(_NUMBER, "big"), 0o600)

    def _may_be_removed(self, wanted: Checkpoint) -> None:
        accepted = self.removed(wanted.log)
        if wanted.removed is None:
            if accepted is not None:
                raise CheckpointRefusedError(
                    f"checkpoint {wanted.number} does not state how many records are removed"
                )
            return
        if accepted is None and wanted.number > 1:
            self.remember_removed(wanted.log, wanted.removed)
        elif wanted.removed > (accepted or 0):
            raise CheckpointRefusedError(
                f"checkpoint {wanted.number} states that records up to {wanted.removed} are removed; only removal"
                f" up to {accepted or 0} was approved"
            )
        elif accepted is None:
            self.remember_removed(wanted.log, 0)

    def _note_time(self, wanted: Checkpoint, first: int) -> None:
        path = self._path(wanted.log, "times")
        if not path.exists():
            write_whole(path, wanted.number.to_bytes(_NUMBER, "big"), 0o600)
        descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        try:
            begun = int.from_bytes(os.pread(descriptor, _NUMBER, 0), "big")
            place = _NUMBER + (wanted.number - begun) * _NUMBER
            if begun < first or place < _NUMBER or place > os.fstat(descriptor).st_size:
                raise CheckpointRefusedError(
                    f"{path} does not match {path.stem}.signed; restore both from one backup, or remove it"
                )
            _keep(path, descriptor, self._clock().to_bytes(_NUMBER, "big"), place)
        finally:
            os.close(descriptor)

    def _room_for_another(self, wanted: str) -> None:
        others = (log for log in remembered_logs(self._directory) if log.log != wanted)
        kept = [log for log in others if not log.is_set_aside]
        if len(kept) >= MAX_LOGS:
            raise CheckpointRefusedError(
                f"{MAX_LOGS} logs were signed before; set old ones aside: rosrv audit acknowledge"
            )

    def _path(self, log: str, what: str) -> Path:
        return self._directory / f"{log}.{what}"


def _digest(checkpoint: Checkpoint) -> bytes:
    return hashlib.sha256(checkpoint.text()).digest()


def _keep(path: Path, descriptor: int, data: bytes, place: int) -> None:
    """Write data durably and whole, or raise `OSError`: at a block's end, a full disk takes the first bytes only."""
    try:
        written = os.pwrite(descriptor, data, place)
        os.fsync(descriptor)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    if written < len(data):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


def _extent(descriptor: int) -> tuple[int, int]:
    first = int.from_bytes(os.pread(descriptor, _NUMBER, 0), "big")
    # A partial hash from a crash was not approved.
    return first, (os.fstat(descriptor).st_size - _NUMBER) // _HASH


def _is_known(descriptor: int, wanted: Checkpoint, first: int, count: int) -> bool:
    """Return whether the checkpoint was signed before. Raises `CheckpointRefusedError` unless it follows."""
    index = wanted.number - first
    if index < 0 or index > count:
        raise CheckpointRefusedError(f"checkpoint {wanted.number} does not follow number {first + count - 1}")
    if index < count:
        if os.pread(descriptor, _HASH, _NUMBER + index * _HASH) != _digest(wanted):
            raise CheckpointRefusedError(f"another checkpoint {wanted.number} of this log was signed before")
        return True
    if os.pread(descriptor, _HASH, _NUMBER + (count - 1) * _HASH) != bytes.fromhex(wanted.previous):
        raise CheckpointRefusedError(
            f"checkpoint {wanted.number} does not contain the hash of the previous signed one"
        )
    return False
