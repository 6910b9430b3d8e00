"""Remove old records step by step. A refused removal is tried again later.

Records of a signed log are removed only with the signer's signature over exactly these records.
"""

from collections.abc import Callable
from typing import NamedTuple

import msgspec

from appliance.audit.log.log_writer import ChainWriter
from appliance.audit.log.record import MakeRecord, Severity
from appliance.audit.log.retention import RemovedRange, Retention, worth_keeping
from appliance.audit.log.signatures import RemovalSigner, Signatures

_AT_ONCE = 512
_LOOK_SECONDS = 5.0
_ANSWER_SECONDS = 30.0
_REFUSED_SECONDS = 600.0


class _Wanted(NamedTuple):
    gone: RemovedRange
    reason: str
    by_size: bool


class Remover:
    """Applies a log's retention; `sign` requests a signature, and `now` returns the time of the turn."""

    def __init__(
        self,
        retention: Retention,
        signatures: Signatures,
        sign: RemovalSigner | None,
        *,
        clock: Callable[[], int],
        now: Callable[[], float],
        make: MakeRecord,
    ) -> None:
        self._retention = retention
        self._signatures = signatures
        self._sign = sign
        self._clock = clock
        self._now = now
        self._make = make
        self._wanted: _Wanted | None = None
        self._asked_until = 0.0
        """No removal is requested before this time: the signer may still answer, or has refused."""
        self.due = 0.0
        self.unremoved: str | None = None

    def step(self, writer: ChainWriter) -> None:
        now = self._now()
        self.due = now + _LOOK_SECONDS
        wanted = self._find(writer) if now >= self._asked_until else None
        if wanted is None:
            return
        if not self._signatures.has_signer:
            self._remove(writer, wanted, {})
        elif self._sign is None:
            self.unremoved = "old records are not removed: no process signs their removal"
        elif (checkpoint := writer.checkpoint_text(wanted.gone.last_checkpoint)) is not None:
            self._wanted, self._asked_until = wanted, now + _ANSWER_SECONDS
            self._sign(wanted.gone.last_checkpoint, checkpoint, writer.newest_signed())

    def ask_again(self) -> None:
        """Forget earlier requests, because a new signer may not have got them."""
        self._wanted, self._asked_until, self.due = None, 0.0, 0.0

    def signed(self, writer: ChainWriter, number: int, text: bytes, signature: bytes, key: bytes) -> None:
        wanted, self._wanted = self._wanted, None
        if wanted is None or wanted.gone.last_checkpoint != number:
            return
        what = f"the removal up to checkpoint {number}"
        limit = text.decode("ascii", "replace").rpartition("\nlimit ")[2].removesuffix("\n")
        wrong = self._signatures.wrong(what, text, signature, key)
        if wrong is None and wanted.gone.statement(writer.log_id, limit) != text:
            wrong = f"{what} is not what was signed"
        self._asked_until = 0.0
        if wrong is not None:
            self.unremoved = f"old records are not removed: {wrong}"
        else:
            self._remove(writer, wanted, {"limit": limit, "signature": signature.hex(), "key": key.hex()})

    def refused(self, number: int, reason: str, *, early: bool = False) -> None:
        """Request this removal again later. `early`: the records are too young by the signer's clock, as is normal."""
        wanted = self._wanted
        if wanted is not None and wanted.gone.last_checkpoint == number:
            self._wanted = None
            self._asked_until = self._now() + _REFUSED_SECONDS
            waits = early and not wanted.by_size
            self.unremoved = None if waits else f"old records are not removed: the signer refuses: {reason}"

    def _find(self, writer: ChainWriter) -> _Wanted | None:
        signed, retention, now = self._signatures.has_signer, self._retention, self._clock()
        reason = retention.excess(writer.size())
        if reason is not None:
            gone = writer.removable(_AT_ONCE, signed=signed)
            return None if gone is None else _Wanted(gone, reason, by_size=True)
        gone = writer.removable(_AT_ONCE, signed=signed, before=retention.oldest_kept(now), now=now)
        if gone is None or gone.last_sequence > retention.collected():
            return None
        return _Wanted(gone, f"older than {retention.days} days", by_size=False)

    def _remove(self, writer: ChainWriter, wanted: _Wanted, proof: dict[str, object]) -> None:
        gone = wanted.gone
        count = gone.last_sequence - gone.first_sequence + 1
        kept = worth_keeping(writer.evidence(gone), count) if wanted.by_size else []
        detail = msgspec.to_builtins(gone) | {"count": count, "kept": len(kept)} | proof
        report = self._make("records removed", Severity.NOTICE, wanted.reason, detail)
        writer.remove(gone, report, kept)
        self.due, self.unremoved = 0.0, None
