"""What the signer remembers of the audit checkpoints it signed, so that no second past can be signed.

Invariants:
1. For each log the hashes of its signed checkpoints stand in `<log>.signed`, by number, and the moments of signing in
   `<log>.times`, by the clock of ages (`ages.py`); they only ever grow.
2. A checkpoint is approved if it follows the last one (number and hash), or if it is exactly the one approved
   under its number before (control lost the answer). A log that is not known yet may begin with any number.
3. A checkpoint says how many records are removed before it; it is approved if the signer approved that removal
   (`<log>.removed`, see `removals.py`), or if it is the first that says so, of a log that was begun before they did.
   After it none that does not say so is approved.
4. At most `MOST_LOGS` logs are remembered; a further one is refused, so control cannot fill the signer's disk
   with names.
"""

import hashlib
import os
from collections.abc import Callable
from pathlib import Path

from appliance.base.atomic_files import write_whole
from appliance.signing.signed_statements import Checkpoint, parse_checkpoint

MOST_LOGS = 64
_HASH = 32
_NUMBER = 8


class CheckpointRefusedError(Exception):
    """A checkpoint that must not be signed; the message says why."""


def read_checkpoint(text: bytes) -> Checkpoint:
    """Raises `CheckpointRefusedError` for anything that is not exactly one."""
    try:
        return parse_checkpoint(text)
    except ValueError:
        raise CheckpointRefusedError("what was to be signed is not an audit checkpoint") from None


def newest_signing(directory: Path) -> int | None:
    """When a checkpoint of any log was signed last; None where none was."""
    times = (path.read_bytes() for path in directory.glob("*.times"))
    return max(
        (int.from_bytes(kept[-_NUMBER:], "big") for kept in times if len(kept) > _NUMBER), default=None
    )


class SignedCheckpoints:
    """The memory of one signer, in its directory; `clock` gives nanoseconds since the epoch."""

    def __init__(self, directory: Path, clock: Callable[[], int]) -> None:
        self._directory = directory
        self._clock = clock

    def approve(self, text: bytes) -> None:
        """Remember a checkpoint as signed. Raises `CheckpointRefusedError`; `OSError` from the disk."""
        wanted = read_checkpoint(text)
        path = self._path(wanted.log, "signed")
        if not path.exists():
            self._room_for_another()
            self._may_be_removed(wanted)
            number, now = wanted.number.to_bytes(_NUMBER, "big"), self._clock().to_bytes(_NUMBER, "big")
            write_whole(self._path(wanted.log, "times"), number + now, 0o600)
            write_whole(path, number + _digest(wanted), 0o600)
            return
        descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        try:
            first, count = _extent(descriptor)
            if not _is_known(descriptor, wanted, first, count):
                self._may_be_removed(wanted)
                self._note_time(wanted, first)
                os.pwrite(descriptor, _digest(wanted), _NUMBER + count * _HASH)
                os.fsync(descriptor)
        finally:
            os.close(descriptor)

    def signed_at(self, checkpoint: Checkpoint) -> int | None:
        """When this checkpoint was signed; None if it was not. Before times were kept: what it says itself."""
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
        """Up to which record of a log removals were approved; None where it never said how many are removed."""
        path = self._path(log, "removed")
        return int.from_bytes(path.read_bytes(), "big") if path.exists() else None

    def remember_removed(self, log: str, sequence: int) -> None:
        """The removal of the records up to this one was approved."""
        write_whole(self._path(log, "removed"), sequence.to_bytes(_NUMBER, "big"), 0o600)

    def _may_be_removed(self, wanted: Checkpoint) -> None:
        approved = self.removed(wanted.log)
        if wanted.removed is None:
            if approved is not None:
                raise CheckpointRefusedError(
                    f"checkpoint {wanted.number} does not say how many records are removed"
                )
            return
        if approved is None and wanted.number > 1:
            self.remember_removed(wanted.log, wanted.removed)
        elif wanted.removed > (approved or 0):
            raise CheckpointRefusedError(
                f"checkpoint {wanted.number} says that records up to {wanted.removed} are removed; approved was the"
                f" removal up to {approved or 0}"
            )
        elif approved is None:
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
                    f"{path} does not go with {path.stem}.signed; restore both from one backup, or remove it"
                )
            os.pwrite(descriptor, self._clock().to_bytes(_NUMBER, "big"), place)
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

    def _room_for_another(self) -> None:
        if len(list(self._directory.glob("*.signed"))) >= MOST_LOGS:
            raise CheckpointRefusedError(
                f"{MOST_LOGS} logs were signed before; remove .signed files of old ones in {self._directory}"
            )

    def _path(self, log: str, what: str) -> Path:
        return self._directory / f"{log}.{what}"


def _digest(checkpoint: Checkpoint) -> bytes:
    return hashlib.sha256(checkpoint.text()).digest()


def _extent(descriptor: int) -> tuple[int, int]:
    """The number of the first checkpoint remembered, and how many there are."""
    first = int.from_bytes(os.pread(descriptor, _NUMBER, 0), "big")
    # A hash cut short by a crash was not approved.
    return first, (os.fstat(descriptor).st_size - _NUMBER) // _HASH


def _is_known(descriptor: int, wanted: Checkpoint, first: int, count: int) -> bool:
    """Whether exactly this one was approved before; raises if it does not follow the last."""
    index = wanted.number - first
    if index < 0 or index > count:
        raise CheckpointRefusedError(f"checkpoint {wanted.number} does not follow number {first + count - 1}")
    if index < count:
        if os.pread(descriptor, _HASH, _NUMBER + index * _HASH) != _digest(wanted):
            raise CheckpointRefusedError(f"another checkpoint {wanted.number} of this log was signed before")
        return True
    if os.pread(descriptor, _HASH, _NUMBER + (count - 1) * _HASH) != bytes.fromhex(wanted.previous):
        raise CheckpointRefusedError(
            f"checkpoint {wanted.number} does not carry the hash of the one signed before it"
        )
    return False
