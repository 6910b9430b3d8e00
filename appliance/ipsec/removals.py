"""Approve removals of old audit records if the settings and the signer's own memory justify them.

Without approval, a process that can write the log could remove recent records and call them old.

1. Records are removed up to a checkpoint that the signer signed.
2. By age: the signer signed that checkpoint long enough ago, by the age clock.
3. By size: the records sealed since that checkpoint would fill the size if each had `LARGEST_RECORD` bytes.
"""

from collections.abc import Callable
from dataclasses import dataclass

from appliance.ipsec.signed_checkpoints import CheckpointMemory, read_checkpoint
from appliance.signing.log_proof import Checkpoint, Removal, checkpoint_hash

LARGEST_RECORD = 64 << 10
"""The assumed bytes of a record with the largest details; the average is smaller."""

_DAY = 86_400_000_000_000


class RemovalRefusedError(Exception):
    """A removal is refused; `early`: it may be permitted later."""

    def __init__(self, reason: str, *, early: bool = False) -> None:
        super().__init__(reason)
        self.early = early


@dataclass(frozen=True)
class RetentionLimits:
    """The limits of a log: age in days, size in bytes."""

    days: float | None = None
    size: int | None = None


class RemovalJudge:
    """Approves removals by the signatures in `signed` and the limits in `kept`.

    `dated` corrects a date of `clock` from a time when a long gap did not count yet.
    """

    def __init__(
        self,
        signed: CheckpointMemory,
        kept: RetentionLimits,
        clock: Callable[[], int],
        dated: Callable[[int], int] = int,
    ) -> None:
        self._signed = signed
        self._kept = kept
        self._clock = clock
        self._dated = dated

    def accept(self, checkpoint: bytes, newest: bytes) -> bytes:
        """Return the text to sign. `newest` is the last signed checkpoint.

        Raises `RemovalRefusedError`, `CheckpointRefusedError`, `OSError`.
        """
        upto, last = read_checkpoint(checkpoint), read_checkpoint(newest)
        signed_at = self._signed.signed_at(upto)
        if signed_at is None:
            raise RemovalRefusedError(f"checkpoint {upto.number} was not signed here")
        why = self._by_age(signed_at) or self._by_size(upto, last)
        if not why:
            raise RemovalRefusedError(self._words(upto), early=self._kept.days is not None)
        self._signed.remember_removed(upto.log, max(upto.sequence, self._signed.removed(upto.log) or 0))
        sealed = checkpoint_hash(checkpoint)
        return Removal(upto.log, upto.number, upto.sequence, upto.hash, sealed, why).text()

    def _by_age(self, signed_at: int) -> str:
        days = self._kept.days
        now = self._clock()  # first: it may count a gap
        old = days is not None and now - self._dated(signed_at) >= int(days * _DAY)
        return f"{days} days" if old else ""

    def _by_size(self, upto: Checkpoint, last: Checkpoint) -> str:
        size = self._kept.size
        if size is None or last.log != upto.log or self._signed.signed_at(last) is None:
            return ""
        return f"{size} bytes" if (last.sequence - upto.sequence) * LARGEST_RECORD >= size else ""

    def _words(self, upto: Checkpoint) -> str:
        if self._kept.days is None and self._kept.size is None:
            return "records are kept forever: neither audit.retention_days nor audit.retention_bytes is set"
        return (
            f"records up to {upto.sequence} are not old enough for audit.retention_days, and too few came after them"
            " for audit.retention_bytes"
        )
