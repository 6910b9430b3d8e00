"""Which removals of old audit records the signer signs: those that follow from the settings, by what it signed itself.

Who can write the log could otherwise take out what happened a moment ago and have the log say that it was old. So the
signer, which has the settings and its own memory, looks at neither the log nor what control says of it:

1. Records are removed up to a checkpoint that the signer signed, no further.
2. By age (`retention_days`): it signed that checkpoint so long ago, by the clock of ages (`ages.py`).
3. By size (`retention_bytes`): so many records were sealed since that a log of them can have that size, at
   `LARGEST_RECORD` bytes each. The signer does not see how large they are, so this is a bound, not the size.
"""

from collections.abc import Callable
from dataclasses import dataclass

from appliance.ipsec.signed_checkpoints import SignedCheckpoints, read_checkpoint
from appliance.signing.signed_statements import Checkpoint, Removal, checkpoint_hash

LARGEST_RECORD = 64 << 10
"""Bytes of a record with the longest details; no log has larger ones on average."""

_DAY = 86_400_000_000_000


class RemovalRefusedError(Exception):
    """A removal that does not follow from the settings; the message says why. `early`: it will, as time passes."""

    def __init__(self, reason: str, *, early: bool = False) -> None:
        super().__init__(reason)
        self.early = early


@dataclass(frozen=True)
class Kept:
    """How long records are kept, as configured; None: for ever, and whatever the size."""

    days: float | None = None
    size: int | None = None


class Removals:
    """Approves removals from logs, by the memory `signed` and the settings `kept`."""

    def __init__(self, signed: SignedCheckpoints, kept: Kept, clock: Callable[[], int]) -> None:
        self._signed = signed
        self._kept = kept
        self._clock = clock

    def approve(self, checkpoint: bytes, newest: bytes) -> bytes:
        """What is signed for the removal of all records up to a checkpoint; `newest` is the last signed one.

        Both are texts of checkpoints. Raises `RemovalRefusedError`, `CheckpointRefusedError`, `OSError`.
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
        old = days is not None and self._clock() - signed_at >= int(days * _DAY)
        return f"{days} days" if old else ""

    def _by_size(self, upto: Checkpoint, last: Checkpoint) -> str:
        size = self._kept.size
        if size is None or last.log != upto.log or self._signed.signed_at(last) is None:
            return ""
        return f"{size} bytes" if (last.sequence - upto.sequence) * LARGEST_RECORD >= size else ""

    def _words(self, upto: Checkpoint) -> str:
        if self._kept.days is None and self._kept.size is None:
            return "records are kept for ever: neither audit.retention_days nor audit.retention_bytes is set"
        return (
            f"records up to {upto.sequence} are not old enough for audit.retention_days, and too few came after them"
            " for audit.retention_bytes"
        )
