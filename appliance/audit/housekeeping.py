"""What a log does beside writing records: checkpoints and their signatures, the full-text index, retention.

Invariants:

1. All of it can wait: when something fails it is tried again later (`degraded` says why), and records are written
   meanwhile. Only writing records decides whether the log has failed.
2. Nothing here takes long at once: a step of retention, a slice of the index, a bounded number of signatures.
3. What a step wants recorded is given to `hold`, or appended with the step itself.
"""

import sqlite3
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from appliance.audit.log_database import LogUnreadableError
from appliance.audit.log_writer import ChainWriter
from appliance.audit.record import Record, Severity
from appliance.audit.removal import Remover
from appliance.audit.signatures import Signatures
from appliance.audit.waiters import Waiter, answer
from appliance.signing.signed_statements import parse_checkpoint

WRITE_ERRORS = (sqlite3.Error, OSError, LogUnreadableError)
_TEXT_BACKLOG = 20_000
_TEXT_STEP = 256
_LARGEST_SLICE = 2048
_IDLE_SECONDS = 1.0
_HOUSE_SECONDS = 10.0
_ASK_AGAIN_SECONDS = 30.0


MakeRecord = Callable[[str, Severity, str, dict[str, Any]], Record]
"""Makes a record of the log's own, of event, severity, reason and detail, with an id and the time."""


@dataclass(frozen=True)
class Checkpoints:
    """A checkpoint is made every so many `records`, or `seconds`, whichever is first."""

    records: int = 1000
    seconds: float = 60.0


@dataclass
class _Moments:
    """When each was done last, or is due; monotonic seconds."""

    house: float = 0.0
    asked: float = 0.0
    sealed: float = field(default_factory=time.monotonic)


class Housekeeping:
    """Keeps the house of the log at `path`, on the log's thread; `writer` is None while the database is closed."""

    def __init__(
        self,
        path: Path,
        signatures: Signatures,
        checkpoints: Checkpoints,
        remover: Remover,
        *,
        clock: Callable[[], int],
        make: MakeRecord,
        hold: Callable[[Record], None],
    ) -> None:
        self._path = path
        self._signatures = signatures
        self.remover = remover
        self._checkpoints = checkpoints
        self._clock = clock
        self._make = make
        self._hold = hold
        self._at = _Moments()
        self.writer: ChainWriter | None = None
        self.unsealed = 0  # records after the last checkpoint
        self._failing: str | None = None
        self._waiting: list[Waiter] = []  # until what is written now is sealed
        self._sealed: list[tuple[int, Waiter]] = []  # until the checkpoint with this number is signed

    @property
    def degraded(self) -> str | None:
        """Why something is behind; None when nothing is."""
        return self._failing or self.remover.unremoved

    def opened(self, writer: ChainWriter) -> None:
        """The database is open."""
        self.writer = writer
        self.unsealed = writer.sequence - writer.checkpoint_sequence
        self._signatures.ask(writer)

    def attempt(self, action: Callable[[], None]) -> None:
        """Do what can wait; when it fails nothing of this kind is tried for a while."""
        if time.monotonic() < self._at.house:
            return
        try:
            action()
        except WRITE_ERRORS as error:
            self._failing = f"{self._path}: {error}"
            self._at.house = time.monotonic() + _HOUSE_SECONDS
        else:
            self._failing = None

    def next_due(self, now: float) -> float | None:
        """In how many seconds something is due; None while nothing is tried."""
        if now < self._at.house:
            return None
        due = self.remover.due - now
        return min(due, self._at.sealed + self._checkpoints.seconds - now) if self.unsealed else due

    # --- between two batches of records -----------------------------------------------------------------------

    def after_batch(self, *, written: bool) -> None:
        """Seal if it is time to, and let the index not fall too far behind: what it lacks every search has to read."""
        if written and self._seal_is_due():
            self.attempt(self.seal)
        if written and self._waiting:
            self.attempt(self._answer_sealed)
        self.attempt(self._index_backlog)

    def at_rest(self, *, quiet_since: float, busy: Callable[[], bool]) -> None:
        """Nothing waits to be written (since `quiet_since`): index, and remove what is too old."""
        if self.writer is not None and not busy():
            # One record alone does not pay a commit of the index; it waits for others or for a quiet second.
            quiet = time.monotonic() - quiet_since >= _IDLE_SECONDS / 2
            if quiet or self.writer.text_lag >= _TEXT_STEP:
                self.attempt(lambda: self._index(busy))
        if self.writer is not None and time.monotonic() >= self.remover.due:
            self.attempt(self._retain)

    # --- checkpoints ------------------------------------------------------------------------------------------

    def _seal_is_due(self) -> bool:
        waited = time.monotonic() - self._at.sealed
        return self.unsealed >= self._checkpoints.records or (
            self.unsealed > 0 and (waited >= self._checkpoints.seconds or bool(self._waiting))
        )

    def seal_now(self, waiter: Waiter) -> None:
        """Seal with the next batch; the waiter is answered when that is signed."""
        self._waiting = [pending for pending in self._waiting if not pending.future.done()] + [waiter]

    def _answer_sealed(self) -> None:
        """What was to be sealed now is: its waiters wait for the signature, if it is not there yet."""
        if self.writer is None or self.unsealed:
            return
        number = self.writer.checkpoint_number
        self._sealed += [(number, waiter) for waiter in self._waiting]
        self._waiting = []
        if (newest := self.writer.newest_signed()) and parse_checkpoint(newest).number >= number:
            self._answer(lambda awaited: awaited <= number, None)

    def _answer(self, which: Callable[[int], bool], result: str | None) -> None:
        answer([waiter for number, waiter in self._sealed if which(number)], result)
        self._sealed = [(number, waiter) for number, waiter in self._sealed if not which(number)]

    def seal(self) -> None:
        """Make a checkpoint over everything written, record it, and have it signed."""
        writer = self.writer
        if writer is None:
            return
        self._at.sealed = time.monotonic()
        checkpoint, text = writer.seal(self._clock())
        detail = {"number": checkpoint.number, "sequence": checkpoint.sequence, "hash": checkpoint.hash}
        writer.append([self._make("checkpoint", Severity.DEBUG, "", detail)])
        self.unsealed = 0
        self.remover.sealed()
        if self._at.sealed - self._at.asked > _ASK_AGAIN_SECONDS:
            # An answer may have been lost on the way; asking twice for the same is harmless.
            self.ask_signatures()
        else:
            self._signatures.sealed(checkpoint.number, text)

    def ask_signatures(self) -> None:
        """Ask the signer for what is not signed yet."""
        self._at.asked = time.monotonic()
        if self.writer is not None:
            self._signatures.ask(self.writer)

    def keep_signature(self, number: int, signature: bytes, public_key: bytes) -> None:
        """The signer's answer: kept if it is right, else recorded."""
        if self.writer is None:
            return
        refusal = self._signatures.keep(self.writer, number, signature, public_key)
        if refusal is not None:
            self.refused(number, refusal)
        else:
            self._answer(lambda awaited: awaited <= number, None)

    def refused(self, number: int, reason: str) -> None:
        """A checkpoint was not signed, or wrongly."""
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
        """Remove one step of old records if they must go; the next step follows at once."""
        if self.writer is not None and self.remover.step(self.writer):
            self.unsealed += 1

    def removal_approved(self, number: int, text: bytes, signature: bytes, key: bytes) -> None:
        """The signer signed a removal."""
        if self.writer is not None and self.remover.approved(self.writer, number, text, signature, key):
            self.unsealed += 1
