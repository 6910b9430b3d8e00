"""The audit log as its owner sees it: `record` puts a record into a queue, a thread writes it.

Invariants:
1. `record` never blocks and never raises: it appends to a queue. All else is done by the log's own thread.
2. Order is kept: what was recorded first has the smaller sequence.
3. Nothing is dropped silently: while the log cannot be written (`failed`), records wait, up to `queue_limit`;
   those past it are counted and the count is recorded when writing works again.
4. Who waits (`wait_durable`) is answered when every record before is on disk (fsync), or with the reason why it is
   not; a denial that was folded is on disk as a count.
"""

import asyncio
import contextlib
import contextvars
import os
import sqlite3
import threading
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import msgspec
import structlog

from appliance.audit.budget import Budget
from appliance.audit.disk_space import Room
from appliance.audit.folding import Folder, FoldSettings
from appliance.audit.housekeeping import WRITE_ERRORS, Checkpoints, Housekeeping
from appliance.audit.ids import IdSource
from appliance.audit.lock_holders import holders
from appliance.audit.log_database import LogUnreadableError
from appliance.audit.log_writer import ChainWriter
from appliance.audit.losses import Lost
from appliance.audit.record import Record, Severity
from appliance.audit.removal import Remover
from appliance.audit.repetition import summary
from appliance.audit.retention import Retention
from appliance.audit.signatures import RemovalSigner, Signatures, Signer
from appliance.audit.waiters import Waiter, answer
from appliance.quotas.pool import Standing
from appliance.quotas.table import AUDIT_RESERVE

Durability = Literal["strict", "batched"]
_GATHER_SECONDS = 0.02
_RETRY_SECONDS = 0.5
_LARGEST_BATCH = 2048
_IDLE_SECONDS = 1.0
_CLOSE_SECONDS = 10.0
_logger = structlog.get_logger()


class Lag(NamedTuple):
    """How far the disk is behind: records that wait, and seconds since nothing waited."""

    records: int
    seconds: float


class AuditLog:
    """The log at `path`, open for writing.

    `durability` says when writing starts: `strict` at once (group commit), `batched` after 20 ms; both
    fsync. A checkpoint is made every `checkpoint_every` records or `checkpoint_seconds`, whichever is first,
    and `signer(number, text)` is called for it *on the log's thread*; the owner answers with `signed` or
    `refused`. `removals(number, checkpoint, newest)` asks for the signature over a removal, in the same way; the answer
    is `removal_approved` or `removal_refused`. `held_by(processes)` is told, on that thread too, which processes keep
    the log locked. `budget` says what hosts owe for their records; below `reserve` bytes on the disk that is less.
    """

    def __init__(
        self,
        path: Path,
        *,
        durability: Durability = "batched",
        checkpoint_every: int = 1000,
        checkpoint_seconds: float = 60.0,
        fold: FoldSettings | None = None,
        signer: Signer | None = None,
        removals: RemovalSigner | None = None,
        retention: Retention | None = None,
        budget: Budget | None = None,
        reserve: int = AUDIT_RESERVE.bounds.whole,
        queue_limit: int = 100_000,
        held_by: Callable[[list[int]], None] = lambda processes: None,  # noqa: ARG005  nobody asks
        clock: Callable[[], int] = time.time_ns,
    ) -> None:
        self.path = path
        self.ids = IdSource(clock=clock)
        self.strict = durability == "strict"
        self._clock = clock
        self._queue_limit = queue_limit
        self._held_by = held_by
        self.budget = budget or Budget(lambda _host: Standing.NAMED)
        self._room = Room(path, reserve, self.budget.room)
        self._folder = Folder(fold or FoldSettings(), self.ids.next, clock)
        self._signatures = Signatures(path, signer)
        self._queue: deque[Record | Waiter | Callable[[], None]] = deque()
        self._held: list[Record] = []
        self._house = Housekeeping(
            path,
            self._signatures,
            Checkpoints(checkpoint_every, checkpoint_seconds),
            Remover(
                retention or Retention(),
                self._signatures,
                removals,
                clock=clock,
                report=lambda reason, detail: self._own("records removed", Severity.NOTICE, reason, detail),
            ),
            clock=clock,
            make=self._own,
            hold=self._held.append,
        )
        self._waiting: list[Waiter] = []
        self._writer: ChainWriter | None = None
        self._failed: str | None = "the log is being opened"
        self._failed_since = 0
        self._caught_up = self._written_at = time.monotonic()
        self._lost = Lost()
        self._idle = False
        self._ended = False
        self._counts_recovered = False
        self._continued: tuple[str, int] | None = None
        self._unwritten: str | None = None
        self._wake = threading.Event()
        self._hurry = threading.Event()
        self._stopping = threading.Event()
        self._opened = threading.Event()
        said_with_logs = contextvars.copy_context()  # which process this is
        self._thread = threading.Thread(
            target=said_with_logs.run, args=(self._run,), name="audit log", daemon=True
        )
        self._thread.start()
        self._opened.wait()

    # --- for the owner, from any thread ---------------------------------------------------------------------

    def record(self, record: Record) -> str:
        """Take a record into the log; the id by which it is found there: its own, that of the one it repeats, or none.

        Its `detail` must not be changed afterwards.
        """
        if self._is_full:
            self._lost.add(record)
            return record.id
        self.budget.charge(record)
        found_by = self._folder.in_full(record)
        self._put(record)
        return found_by

    @property
    def _is_full(self) -> bool:
        return len(self._queue) + len(self._held) >= self._queue_limit

    async def wait_durable(self) -> str | None:
        """Wait until all that was recorded so far is on disk; the reason when it cannot be written."""
        loop = asyncio.get_running_loop()
        future: asyncio.Future[str | None] = loop.create_future()
        self._put(Waiter(loop, future))
        if not self.strict:
            self._hurry.set()
        return await future

    async def wait_signed(self) -> str | None:
        """Wait until a signed checkpoint, made now, seals all that was recorded; the reason when it is refused."""
        loop = asyncio.get_running_loop()
        future: asyncio.Future[str | None] = loop.create_future()
        self._put(partial(self._house.seal_now, Waiter(loop, future)))
        self._hurry.set()
        return await future

    @property
    def failed(self) -> str | None:
        """Why the log cannot be written now; None when it can."""
        return self._failed

    @property
    def degraded(self) -> str | None:
        """Why checkpoints, the full-text index or retention are behind, or room is scarce; None when all is well."""
        return self._house.degraded or self._room.scarce

    @property
    def lag(self) -> Lag:
        """How far the disk is behind."""
        waiting = len(self._queue) + len(self._held)
        return Lag(waiting, time.monotonic() - self._caught_up if waiting else 0.0)

    def signed(self, number: int, signature: bytes, public_key: bytes) -> None:
        """The signer's answer: kept if it is right and made with the pinned key, else recorded as refused."""
        keep = partial(self._house.keep_signature, number, signature, public_key)
        self._put(partial(self._house.attempt, keep))

    def refused(self, number: int, reason: str) -> None:
        """The signer refused a checkpoint: recorded as an alarm."""
        self._put(partial(self._house.refused, number, reason))

    def removal_approved(self, number: int, text: bytes, signature: bytes, public_key: bytes) -> None:
        """The signer signed the removal of the records up to a checkpoint."""
        remove = partial(self._house.removal_approved, number, text, signature, public_key)
        self._put(partial(self._house.attempt, remove))

    def removal_refused(self, number: int, reason: str, *, early: bool = False) -> None:
        """The signer does not sign a removal (`early`: not yet); it is asked again later."""
        self._put(partial(self._house.remover.refused, number, reason, early=early))

    def request_signatures(self) -> None:
        """The signer is (back) in service: ask it for every checkpoint that is not signed yet."""
        self._put(partial(self._house.attempt, self._house.ask_signatures))
        self._put(self._house.remover.ask_again)

    def close(self, seconds: float = _CLOSE_SECONDS) -> str | None:
        """Write what waits, make a last checkpoint and close; the reason when that did not succeed in time."""
        self._stopping.set()
        self._hurry.set()
        self._wake.set()
        self._thread.join(seconds)
        if self._thread.is_alive():
            return f"{self.path}: still being written after {seconds:g} s"
        return self._unwritten

    def _put(self, item: Record | Waiter | Callable[[], None]) -> None:
        """What is to be written, somebody who waits, or what the log's thread is to do."""
        self._queue.append(item)
        # The writer sets `_idle` before it looks at the queue a last time: it sees the item or we see idle.
        if self._idle:
            self._idle = False
            self._wake.set()
        if self._ended:
            self._refuse_queued()

    # --- the log's thread -----------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            self._serve()
        except BaseException as error:
            # A defect of ours: the owner must see that nothing is recorded any more, and deny.
            self._unwritten = self._failed = f"{self.path}: writing ended: {type(error).__name__}: {error}"
            raise
        finally:
            self._failed = self._failed or f"{self.path}: the log is closed"
            self._ended = True
            self._opened.set()
            self._answer_waiting()
            self._refuse_queued()

    def _refuse_queued(self) -> None:
        with contextlib.suppress(IndexError):
            while True:
                item = self._queue.popleft()
                if isinstance(item, Waiter):
                    answer([item], self._failed)

    def _serve(self) -> None:
        self._attempt(self._open)
        self._opened.set()
        while not self._stopping.is_set():
            self._wait()
            self._turn()
        self._turn()
        self._held.extend(self._folder.finish())
        self._house.unsealed += len(self._held)
        if self._attempt(self._write) and self._house.unsealed:
            self._house.attempt(self._house.seal)
        self._answer_waiting()
        self._unwritten = self._failed
        if self._writer is not None:
            self._writer.close()

    def _turn(self) -> None:
        """Take what is queued, write it, and do what is due."""
        while True:
            more = self._drain()
            now = time.monotonic()
            for due in self._folder.expire(now):
                self._held.append(due)
                self.budget.summarised(due)
            self._look_for_room()
            written = self._attempt(self._write)
            self._answer_waiting()
            self._house.after_batch(written=written)
            if not more or not written:
                break
        self._house.at_rest(quiet_since=self._written_at, busy=lambda: bool(self._queue))

    def _wait(self) -> None:
        if self._failed is not None:
            self._stopping.wait(_RETRY_SECONDS)
            return
        self._wake.clear()
        self._idle = True
        if not self._queue:
            self._caught_up = time.monotonic()
            self._wake.wait(self._until_due())
        self._idle = False
        if self._queue and not self.strict:
            self._hurry.wait(_GATHER_SECONDS)
        self._hurry.clear()
        if self._stopping.is_set():
            self._hurry.set()

    def _until_due(self) -> float:
        now = time.monotonic()
        due = self._folder.next_due()
        waits = [_IDLE_SECONDS] if due is None else [_IDLE_SECONDS, due - now]
        house = self._house.next_due(now)
        if house is not None:
            waits.append(house)
        return max(0.001, min(waits))

    def _drain(self) -> bool:
        """Move what is queued to where it is handled; whether more is left."""
        now = time.monotonic()
        queue, offer = self._queue, self._folder.offer
        for _ in range(_LARGEST_BATCH):
            if not queue:
                return False
            item = queue.popleft()
            if isinstance(item, Record):
                written = list(offer(item, now))
                self._held.extend(written)
                if not written or written[-1] is not item:
                    self.budget.folded(item)
            elif isinstance(item, Waiter):
                self._waiting.append(item)
            else:
                item()
        return bool(queue)

    def _look_for_room(self) -> None:
        with contextlib.suppress(OSError):  # a folder that is gone is told by what writes there
            scarce = self._room.look()
            if scarce is not None:
                severity, left = (Severity.ALARM if scarce else Severity.NOTICE), self._room.left
                event = "disk nearly full" if scarce else "disk has room"
                _logger.warning(event, left=left, reason=self._room.scarce)
                self._held.append(self._own(event, severity, self._room.scarce or "", {"left": left}))

    def _attempt(self, action: Callable[[], None]) -> bool:
        """Do something with the database; whether it succeeded. A failure closes it until the next try."""
        try:
            if self._writer is None and action != self._open:
                self._open()
            action()
        except WRITE_ERRORS as error:
            self._fail(error)
            return False
        return True

    def _fail(self, error: Exception) -> None:
        reason = str(error)
        if isinstance(error, sqlite3.OperationalError) and "locked" in reason:
            # With ours still open, ours are in the list as well.
            others = [pid for pid in holders(self.path) if pid != os.getpid()]
            if others:
                reason = f"{reason} by process {', '.join(map(str, others))}"
                self._held_by(others)
        self._failed = reason if str(self.path) in reason else f"{self.path}: {reason}"
        if self._failed_since == 0:
            self._failed_since = self._clock()
            _logger.error("the audit log cannot be written", reason=self._failed)
        if self._writer is not None:
            writer, self._writer, self._house.writer = self._writer, None, None
            with contextlib.suppress(sqlite3.Error):
                writer.close()

    def _open(self) -> None:
        earlier = self._signatures.key_was_pinned
        writer = ChainWriter(self.path, self._clock(), self._continued)
        self.ids.raise_floor(writer.last_id)
        self._writer = writer
        if writer.created:
            detail = {"log": writer.log_id, "earlier_log_missing": earlier}
            self._held.insert(
                0, self._own("log begun", Severity.ALARM if earlier else Severity.NOTICE, "", detail)
            )
        # Only what an earlier process left; what this one counts stands there as well and is still being counted.
        left = [] if self._counts_recovered else writer.open_folds()
        if left:
            writer.close_folds(
                [summary(fold, self.ids.next(), self._clock(), recovered=True) for fold in left]
            )
        self._counts_recovered = True
        self._continued = (writer.log_id, writer.sequence)
        if not self._failed_since:
            self._failed = None
        self._house.opened(writer)

    def _write(self) -> None:
        writer = self._writer
        if writer is None:
            raise LogUnreadableError(self._failed or "the log is not open")
        while self._held or self._folder.touched or self._failed_since:
            batch = self._held[:_LARGEST_BATCH]
            touched = tuple(self._folder.touched)
            report = self._report_of_failure()
            writer.append(
                batch + report, [(msgspec.json.encode(key), self._folder.state(key)) for key in touched]
            )
            self._continued = (writer.log_id, writer.sequence)
            del self._held[: len(batch)]
            self._folder.touched.difference_update(touched)
            self._house.unsealed += len(batch) + len(report)
            self._caught_up = self._written_at = time.monotonic()
            if self._failed_since:
                _logger.warning("the audit log is written again")
            self._failed, self._failed_since = None, 0
            if self._lost.count:
                self._held.append(
                    self._own("records lost", Severity.ALARM, "the queue was full", self._lost.take())
                )

    def _report_of_failure(self) -> list[Record]:
        if not self._failed_since:
            return []
        detail = {"since": self._failed_since, "until": self._clock()}
        return [self._own("log failed", Severity.ALARM, self._failed or "", detail)]

    def _answer_waiting(self) -> None:
        result = self._failed if self._held or self._folder.touched else None
        waiting, self._waiting = self._waiting, []
        answer(waiting, result)

    def _own(self, event: str, severity: Severity, reason: str, detail: dict[str, Any]) -> Record:
        return Record(
            id=self.ids.next(),
            time=self._clock(),
            event=event,
            severity=severity,
            reason=reason,
            detail=detail,
        )
