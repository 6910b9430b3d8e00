"""Run the background work of a log: checkpoints and their signatures, the full-text index, retention.

A failed step is repeated later. Only a failure to write records counts as a failure of the log.
"""

import asyncio
import contextlib
import itertools
import sqlite3
from collections.abc import Callable, Iterable
from typing import NamedTuple

from appliance.audit.log.log_database import LogUnreadableError
from appliance.audit.log.log_writer import ChainWriter
from appliance.audit.log.record import AuditRecord, MakeRecord, Severity
from appliance.audit.log.removal import Remover
from appliance.audit.log.signatures import Signatures
from appliance.signing.log_proof import Checkpoint, parse_checkpoint

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

    @property
    def degraded(self) -> str | None:
        return self._failing or self.remover.unremoved

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
        self.ask_signatures(writer, again=self._sealed_at - self._asked_at > _ASK_AGAIN_SECONDS)

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
            self._answer(lambda awaited: awaited <= number, None)

    def refused(self, number: int, reason: str) -> None:
        self._hold(self._make("signature refused", Severity.ALARM, reason, {"number": number}))
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
