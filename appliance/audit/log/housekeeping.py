"""Run the background work of a log: checkpoints and their signatures, the full-text index, retention.

A failed step is repeated later. Only a failure to write records counts as a failure of the log.
"""

import asyncio
import contextlib
import itertools
import re
import sqlite3
from collections.abc import Callable, Iterable
from typing import NamedTuple

import msgspec

from appliance.audit.log.log_database import LogUnreadableError
from appliance.audit.log.log_writer import ChainWriter
from appliance.audit.log.record import AuditRecord, MakeRecord, Severity
from appliance.audit.log.retention import RemovedRange, Retention, worth_keeping
from appliance.audit.log.signatures import RemovalSigner, Signatures
from appliance.signing.log_proof import Checkpoint, parse_checkpoint

# Remove old records step by step. A refused removal is tried again later.
#
# Records of a signed log are removed only with the signer's signature over exactly these records.

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


WRITE_ERRORS = (sqlite3.Error, OSError, LogUnreadableError)
_TEXT_BACKLOG = 20_000
_TEXT_STEP = 256
_LARGEST_SLICE = 2048
_IDLE_SECONDS = 1.0
_HOUSE_SECONDS = 10.0
_ASK_AGAIN_SECONDS = 30.0

Waiter = asyncio.Future[str | None]
"""Gets None once the records are on disk or sealed, or the reason why they are not."""


def answer(waiting: Iterable[Waiter], result: str | None) -> None:
    for loop, group in itertools.groupby(waiting, Waiter.get_loop):
        # A closed loop raises RuntimeError; its coroutines no longer wait.
        with contextlib.suppress(RuntimeError):
            loop.call_soon_threadsafe(_settle, list(group), result)


def _settle(futures: list[Waiter], result: str | None) -> None:
    for future in futures:
        if not future.done():
            future.set_result(result)


class _SealAfter(NamedTuple):
    """A checkpoint is due after this number of records, or when the first one is this old in seconds."""

    records: int
    seconds: float


class Housekeeping:
    """The background work of one log; `writer` returns None while the database is closed.

    A checkpoint is due after `records` records or `seconds` seconds, whichever is first.
    """

    def __init__(
        self,
        signatures: Signatures,
        remover: Remover,
        *,
        records: int,
        seconds: float,
        writer: Callable[[], ChainWriter | None],
        clock: Callable[[], int],
        now: Callable[[], float],
        make: MakeRecord,
        hold: Callable[[AuditRecord], None],
    ) -> None:
        self._signatures = signatures
        self.remover = remover
        self._seal_after = _SealAfter(records, seconds)
        self._writer = writer
        self._clock = clock
        self._now = now
        self._make = make
        self._hold = hold
        self._paused_until = self._asked_at = 0.0  # monotonic seconds
        self._sealed_at = now()
        self._failing: str | None = None
        self._waiting: list[Waiter] = []  # waiters for a seal of the records written so far
        self.unsigned: list[tuple[int, Waiter]] = []  # waiters for this checkpoint's signature
        # Until a signature is kept: the reason for the oldest checkpoint, and the kinds of reasons that have a record.
        self._refusal: tuple[int, str] | None = None
        self._recorded: set[str] = set()

    @property
    def degraded(self) -> str | None:
        unsigned = f"checkpoints are not signed: {self._refusal[1]}" if self._refusal else None
        return self._failing or unsigned or self.remover.unremoved

    def attempt(self, step: Callable[[ChainWriter], None]) -> None:
        """Run a step if the database is open. After a failure, skip all steps for a while."""
        writer = self._writer()
        if writer is None or self._now() < self._paused_until:
            return
        try:
            step(writer)
        except Exception as error:  # noqa: BLE001  a defect of a step must not stop the writing of records
            known = isinstance(error, WRITE_ERRORS)
            self._failing = f"{writer.path}: {error if known else f'{type(error).__name__}: {error}'}"
            self._paused_until = self._now() + _HOUSE_SECONDS
        else:
            self._failing = None

    def next_due(self, now: float) -> float | None:
        if now < self._paused_until:
            return None
        writer, due = self._writer(), self.remover.due
        return min(due, self._sealed_at + self._seal_after.seconds) if writer and writer.unsealed else due

    # --- between two batches of records -----------------------------------------------------------------------

    def after_batch(self, *, written: bool, rest: bool, quiet_since: float, busy: Callable[[], bool]) -> None:
        """Do the work that is due; `rest`: no further batch is due at once."""
        if written:
            self.attempt(self._seal_if_due)
        self.attempt(lambda writer: self._index(writer, quiet_since, busy))
        if rest and self._now() >= self.remover.due:
            self.attempt(self.remover.step)

    # --- checkpoints ------------------------------------------------------------------------------------------

    def _seal_if_due(self, writer: ChainWriter) -> None:
        waited = self._now() - self._sealed_at >= self._seal_after.seconds or bool(self._waiting)
        if writer.unsealed >= self._seal_after.records or (writer.unsealed and waited):
            self.seal(writer)
        if self._waiting:
            number = writer.checkpoint_number
            pending = [*self.unsigned, *((number, waiter) for waiter in self._waiting)]
            self.unsigned, self._waiting = [one for one in pending if not one[1].done()], []
            if (newest := writer.newest_signed()) and parse_checkpoint(newest).number >= number:
                self._answer(lambda awaited: awaited <= number, None)

    def seal_now(self, waiter: Waiter) -> None:
        self._waiting = [pending for pending in self._waiting if not pending.done()] + [waiter]

    def _answer(self, which: Callable[[int], bool], result: str | None) -> None:
        answer([waiter for number, waiter in self.unsigned if which(number)], result)
        self.unsigned = [(number, waiter) for number, waiter in self.unsigned if not which(number)]

    def seal(self, writer: ChainWriter) -> None:
        self._sealed_at = self._now()
        writer.seal(self._clock(), self._report)
        self.remover.due = 0.0  # now the previous checkpoint may be removed
        # Answers may be lost; repeated requests are harmless.
        again = self._sealed_at - self._asked_at > _ASK_AGAIN_SECONDS
        if again and self._signatures.awaited and self._refusal is None:
            self._refusal = writer.checkpoint_number, "the signer does not answer"
        self.ask_signatures(writer, again=again)

    def _report(self, sealed: Checkpoint) -> AuditRecord:
        detail = {"number": sealed.number, "sequence": sealed.sequence, "hash": sealed.hash}
        return self._make("checkpoint", Severity.DEBUG, "", detail)

    def ask_signatures(self, writer: ChainWriter, *, again: bool = True) -> None:
        self._asked_at = self._now() if again else self._asked_at
        self._signatures.ask(writer, again=again)

    def keep_signature(self, writer: ChainWriter, number: int, signature: bytes, public_key: bytes) -> None:
        refusal = self._signatures.keep(writer, number, signature, public_key)
        if refusal is not None:
            self.refused(number, refusal)
        else:
            self._refusal = None
            self._recorded.clear()
            self._answer(lambda awaited: awaited <= number, None)

    def refused(self, number: int, reason: str) -> None:
        kind = re.sub(r"\d", "", reason)
        if kind not in self._recorded:  # each request is repeated every minute
            self._recorded.add(kind)
            self._hold(self._make("signature refused", Severity.ALARM, reason, {"number": number}))
        if self._refusal is None or number <= self._refusal[0]:
            self._refusal = number, reason
        self._answer(lambda awaited: awaited >= number, reason)

    # --- the full-text index ----------------------------------------------------------------------------------

    def _index(self, writer: ChainWriter, quiet_since: float, busy: Callable[[], bool]) -> None:
        if writer.text_lag > _TEXT_BACKLOG:
            writer.index_text(_LARGEST_SLICE)  # every search reads the records that are not indexed
        # Committing the index for a single record is too expensive: wait for more records or for a quiet period.
        quiet = self._now() - quiet_since >= _IDLE_SECONDS / 2
        if quiet or writer.text_lag >= _TEXT_STEP:
            while not busy() and writer.index_text():
                pass
