"""Remove old records step by step. A refused removal is tried again later.

Records of a signed log are removed only with the signer's signature over exactly these records.
"""

import re
from collections.abc import Callable
from typing import NamedTuple

import msgspec

from appliance.audit.log.log_writer import ChainWriter
from appliance.audit.log.record import AuditRecord
from appliance.audit.log.retention import RemovedRange, Retention, worth_keeping
from appliance.audit.log.signatures import RemovalSigner, Signatures

_AT_ONCE = 512
_LOOK_SECONDS = 5.0
_AGE_SECONDS = 3600.0
_ANSWER_SECONDS = 30.0
_REFUSED_SECONDS = 600.0
_LIMIT = re.compile(rb"\nlimit ([0-9][0-9.e+-]{0,31}+ (?:days|bytes))\n\Z")


class _Wanted(NamedTuple):
    gone: RemovedRange
    reason: str
    by_size: bool


class Remover:
    """Applies a log's retention; `approve` requests a signature, and `now` returns the time of the turn."""

    def __init__(
        self,
        retention: Retention,
        signatures: Signatures,
        approve: RemovalSigner | None,
        *,
        clock: Callable[[], int],
        now: Callable[[], float],
        report: Callable[[str, dict[str, object]], AuditRecord],
    ) -> None:
        self._retention = retention
        self._signatures = signatures
        self._approve = approve
        self._clock = clock
        self._now = now
        self._report = report
        self._wanted: _Wanted | None = None
        self._asked = self._aged = self._refused = 0.0
        self.due = 0.0
        self.unremoved: str | None = None

    def step(self, writer: ChainWriter) -> bool:
        now = self._now()
        self.due = now + _LOOK_SECONDS
        if now < self._refused or (self._wanted is not None and now - self._asked < _ANSWER_SECONDS):
            return False
        wanted = self._find(writer, now)
        if wanted is None:
            return False
        if not self._signatures.has_signer:
            self._remove(writer, wanted, {})
            return True
        if self._approve is None:
            self.unremoved = "old records are not removed: no process signs their removal"
            return False
        checkpoint = writer.checkpoint_text(wanted.gone.last_checkpoint)
        if checkpoint is not None:
            self._wanted, self._asked = wanted, now
            self._approve(wanted.gone.last_checkpoint, checkpoint, writer.newest_signed())
        return False

    def ask_again(self) -> None:
        """Forget earlier requests, because a new signer may not have got them."""
        self._wanted, self._aged, self._refused, self.due = None, 0.0, 0.0, 0.0

    def sealed(self) -> None:
        """Search for old records again, because after a new checkpoint the previous one may be removed."""
        self._aged = self.due = 0.0

    def approved(self, writer: ChainWriter, number: int, text: bytes, signature: bytes, key: bytes) -> bool:
        wanted, self._wanted = self._wanted, None
        if wanted is None or wanted.gone.last_checkpoint != number:
            return False
        what = f"the removal up to checkpoint {number}"
        wrong = self._signatures.wrong(what, text, signature, key)
        gone = wanted.gone
        limit = "" if wrong is not None else _limit(text)
        if wrong is not None or gone.statement(writer.log_id, limit) != text:
            self.unremoved = f"old records are not removed: {wrong or f'{what} is not what was signed'}"
            return False
        self._remove(writer, wanted, {"limit": limit, "signature": signature.hex(), "key": key.hex()})
        return True

    def refused(self, number: int, reason: str, *, early: bool = False) -> None:
        """Request this removal again later. `early`: the records are too young by the signer's clock, as is normal."""
        wanted = self._wanted
        if wanted is not None and wanted.gone.last_checkpoint == number:
            self._wanted = None
            self._refused = self._now() + _REFUSED_SECONDS
            waits = early and not wanted.by_size
            self.unremoved = None if waits else f"old records are not removed: the signer refuses: {reason}"

    def _find(self, writer: ChainWriter, now: float) -> _Wanted | None:
        signed = self._signatures.has_signer
        reason = self._retention.excess(writer.size())
        if reason is not None:
            gone = writer.removable(_AT_ONCE, signed=signed)
            return None if gone is None else _Wanted(gone, reason, by_size=True)
        if self._retention.days is None or now < self._aged:
            return None
        present = self._clock()
        gone = writer.removable(
            _AT_ONCE, signed=signed, between=(self._retention.oldest_kept(present), present)
        )
        if gone is None or gone.last_sequence > self._retention.collected():
            self._aged = now + _AGE_SECONDS
            return None
        return _Wanted(gone, f"older than {self._retention.days} days", by_size=False)

    def _remove(self, writer: ChainWriter, wanted: _Wanted, proof: dict[str, object]) -> None:
        gone = wanted.gone
        count = gone.last_sequence - gone.first_sequence + 1
        kept = worth_keeping(writer.evidence(gone), count) if wanted.by_size else []
        detail = msgspec.to_builtins(gone) | {"count": count, "kept": len(kept)} | proof
        writer.remove(gone, self._report(wanted.reason, detail), kept)
        self.due, self.unremoved = 0.0, None


def _limit(text: bytes) -> str:
    match = _LIMIT.search(text)
    if match is None:
        raise ValueError("not the text of a removal")
    return match[1].decode()
