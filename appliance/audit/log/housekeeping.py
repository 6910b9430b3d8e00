"""Run the background work of a log: checkpoints and their signatures, the full-text index, retention.

A failed step is repeated later. Only a failure to write records counts as a failure of the log.
"""

import asyncio
import contextlib
import itertools
import sqlite3
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from appliance.audit.log.log_database import LogUnreadableError
from appliance.audit.log.log_writer import ChainWriter
from appliance.audit.log.record import AuditRecord, Severity
from appliance.audit.log.removal import Remover
from appliance.audit.log.signatures import Signatures
from appliance.signing.log_proof import parse_checkpoint

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


MakeRecord = Callable[[str, Severity, str, dict[str, Any]], AuditRecord]
"""Makes a record about the log itself from event, severity, reason and detail."""


@dataclass(frozen=True)
class CheckpointSchedule:
    """A checkpoint is due after `records` records or `seconds` seconds, whichever is first."""

    records: int = 1000
    seconds: float = 60.0


class Housekeeping:
    """The background work of one log; `writer` is None while the database is closed."""

    def __init__(
        self,
        path: Path,
        signatures: Signatures,
        checkpoints: CheckpointSchedule,
        remover: Remover,
        *,
        clock: Callable[[], int],
        now: Callable[[], float],
        make: MakeRecord,
        hold: Callable[[AuditRecord], None],
    ) -> None:
        self._path = path
        self._signatures = signatures
        self.remover = remover
        self._checkpoints = checkpoints
        self._clock = clock
        self._now = now
        self._make = make
        self._hold = hold
        self._paused_until = self._asked_at = 0.0  # monotonic seconds
        self._sealed_at = now()
        self.writer: ChainWriter | None = None
        self.unsealed = 0  # records after the last checkpoint
        self._failing: str | None = None
        self._waiting: list[Waiter] = []  # waiters for a seal of the records written so far
        self.unsigned: list[tuple[int, Waiter]] = []  # waiters for this checkpoint's signature

    @property
    def degraded(self) -> str | None:
        return self._failing or self.remover.unremoved

    def opened(self, writer: ChainWriter) -> None:
        self.writer = writer
        self.unsealed = writer.sequence - writer.checkpoint_sequence
        self._signatures.ask(writer)

    def attempt(self, action: Callable[[], None]) -> None:
        """Run a step. After a failure, skip all steps for a while."""
        if self._now() < self._paused_until:
            return
        try:
            action()
        except WRITE_ERRORS as error:
            self._failing = f"{self._path}: {error}"
            self._paused_until = self._now() + _HOUSE_SECONDS
        else:
            self._failing = None

    def next_due(self, now: float) -> float | None:
        if now < self._paused_until:
            return None
        due = self.remover.due
        return min(due, self._sealed_at + self._checkpoints.seconds) if self.unsealed else due

    # --- between two batches of records -----------------------------------------------------------------------

    def after_batch(self, *, written: bool) -> None:
        """Seal if it is due, and limit the lag of the full-text index: every search reads the unindexed records."""
        if written and self._seal_is_due():
            self.attempt(self.seal)
        if written and self._waiting:
            self.attempt(self._answer_sealed)
        self.attempt(self._index_backlog)

    def at_rest(self, *, quiet_since: float, busy: Callable[[], bool]) -> None:
        if self.writer is not None and not busy():
            # Committing the index for a single record is too expensive: wait for more records or for a quiet period.
            quiet = self._now() - quiet_since >= _IDLE_SECONDS / 2
            if quiet or self.writer.text_lag >= _TEXT_STEP:
                self.attempt(lambda: self._index(busy))
        if self.writer is not None and self._now() >= self.remover.due:
            self.attempt(self._retain)

    # --- checkpoints ------------------------------------------------------------------------------------------

    def _seal_is_due(self) -> bool:
        waited = self._now() - self._sealed_at
        return self.unsealed >= self._checkpoints.records or (
            self.unsealed > 0 and (waited >= self._checkpoints.seconds or bool(self._waiting))
        )

    def seal_now(self, waiter: Waiter) -> None:
        self._waiting = [pending for pending in self._waiting if not pending.done()] + [waiter]

    def _answer_sealed(self) -> None:
        if self.writer is None or self.unsealed:
            return
        number = self.writer.checkpoint_number
        pending = [*self.unsigned, *((number, waiter) for waiter in self._waiting)]
        self.unsigned, self._waiting = [one for one in pending if not one[1].done()], []
        if (newest := self.writer.newest_signed()) and parse_checkpoint(newest).number >= number:
            self._answer(lambda awaited: awaited <= number, None)

    def _answer(self, which: Callable[[int], bool], result: str | None) -> None:
        answer([waiter for number, waiter in self.unsigned if which(number)], result)
        self.unsigned = [(number, waiter) for number, waiter in self.unsigned if not which(number)]

    def seal(self) -> None:
        writer = self.writer
        if writer is None:
            return
        self._sealed_at = self._now()
        checkpoint, text = writer.seal(self._clock())
        detail = {"number": checkpoint.number, "sequence": checkpoint.sequence, "hash": checkpoint.hash}
        writer.append([self._make("checkpoint", Severity.DEBUG, "", detail)])
        self.unsealed = 0
        self.remover.sealed()
        if self._sealed_at - self._asked_at > _ASK_AGAIN_SECONDS:
            # Answers may be lost; repeated requests are harmless.
            self.ask_signatures()
        else:
            self._signatures.sealed(checkpoint.number, text)

    def ask_signatures(self) -> None:
        self._asked_at = self._now()
        if self.writer is not None:
            self._signatures.ask(self.writer)

    def keep_signature(self, number: int, signature: bytes, public_key: bytes) -> None:
        if self.writer is None:
            return
        refusal = self._signatures.keep(self.writer, number, signature, public_key)
        if refusal is not None:
            self.refused(number, refusal)
        else:
            self._answer(lambda awaited: awaited <= number, None)

    def refused(self, number: int, reason: str) -> None:
        self._hold(self._make("signature refused", Severity.ALARM, reason, {"number": number}))
        self._answer(lambda awaited: awaited >= number, reason)

    # --- index and retention ----------------------------------------------------------------------------------

    def _index(self, busy: Callable[[], bool]) -> None:
        while self.writer is not None and not busy() and self.writer.index_text():
            pass

    def _index_backlog(self) -> None:
        if self.writer is not None and self.writer.text_lag > _TEXT_BACKLOG:
            self.writer.index_text(_LARGEST_SLICE)

    def _retain(self) -> None:
        if self.writer is not None and self.remover.step(self.writer):
            self.unsealed += 1

    def removal_approved(self, number: int, text: bytes, signature: bytes, key: bytes) -> None:
        if self.writer is not None and self.remover.approved(self.writer, number, text, signature, key):
            self.unsealed += 1
