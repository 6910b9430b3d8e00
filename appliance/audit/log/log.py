"""Write the audit log: `record` puts a record into a queue, and a turn of the log writes it.

1. `record` never blocks and never raises.
2. Records keep their order.
3. If the log cannot be written, records beyond `queue_limit` are counted, and the count is recorded later.
"""

import asyncio
import contextlib
import os
import sqlite3
import threading
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import msgspec
import structlog

from appliance.audit.log.budget import Budget
from appliance.audit.log.folding import FoldSettings, RecordFolder
from appliance.audit.log.housekeeping import WRITE_ERRORS, Housekeeping, Remover, Waiter, answer
from appliance.audit.log.ids import IdSource
from appliance.audit.log.log_writer import ChainWriter
from appliance.audit.log.record import AuditRecord, MakeRecord, Severity
from appliance.audit.log.repetition import summary
from appliance.audit.log.retention import Retention
from appliance.audit.log.signatures import CheckpointSigner, RemovalSigner, Signatures, pinned_key_path
from appliance.base.clock import now, wall_ns
from appliance.base.counted import counted
from appliance.base.engine_thread import Drive, EngineThread
from appliance.base.full_disk import reason_of
from appliance.quotas.pool import QuotaClass
from appliance.quotas.table import AUDIT_RESERVE
from appliance.signing.signed_logs import OtherLog

# Record that the signer signed other logs than the present one, which was therefore replaced or moved away.
#
# Each of them is a record in the present log, with its last signed checkpoint, so the chain goes on. The record is
# repeated at each start until an operator sets that log aside.


class OtherLogs:
    """The other logs that the signer has signed. `hold` receives a record for each change."""

    def __init__(self, make: MakeRecord, hold: Callable[[AuditRecord], None]) -> None:
        self._make = make
        self._hold = hold
        self._missing: dict[str, OtherLog] = {}

    @property
    def missing(self) -> str | None:
        """Return which logs no operator set aside, in words; None if there are none."""
        if not self._missing:
            return None
        names = ", ".join(f"{one.log} (up to checkpoint {one.last})" for one in self._missing.values())
        return (
            f"the audit log was replaced: the signer also signed {counted(len(self._missing), 'other log')}, {names};"
            " rosrv audit verify"
        )

    def named(self, others: Sequence[OtherLog]) -> None:
        before, self._missing = self._missing, {one.log: one for one in others if one.set_aside is None}
        for log, other in self._missing.items():
            if before.get(log) != other:
                reason = "another log took its place, and no operator has set it aside"
                self._note("log replaced", Severity.ALARM, reason, other)
        for other in others:
            if other.set_aside is not None and other.log in before:
                self._note("log set aside", Severity.NOTICE, "by an operator on the machine", other)

    def _note(self, event: str, severity: Severity, reason: str, other: OtherLog) -> None:
        detail = {"log": other.log, "number": other.last, "hash": other.hash}
        self._hold(self._make(event, severity, reason, detail))


# Find the processes that hold SQLite's write locks on the log, in the kernel's list of locks.
#
# A correct reader never takes these locks. The files are not opened, because closing a file releases all of this
# process's locks on it.

_LISTED = Path("/proc/locks")
_OF_WRITING = range(120, 123)  # bytes of the -shm file: write, checkpoint, recover (walIndex of SQLite)
_OF_THE_DATABASE = range(0x40000000, 0x40000002)  # bytes of the database: pending, reserved


def holders(log: Path) -> list[int]:
    """Return the ids of the processes with such a lock; -1 is a lock without a process (open file description)."""
    bytes_of = {}
    for path, needed in ((log.with_name(f"{log.name}-shm"), _OF_WRITING), (log, _OF_THE_DATABASE)):
        try:
            bytes_of[path.stat().st_ino] = needed
        except OSError:
            continue
    try:
        lines = _LISTED.read_text(encoding="ascii").splitlines()
    except OSError:
        return []
    found = set()
    for line in lines:
        # `1: POSIX  ADVISORY  READ 4711 fe:00:2190450 120 120`; a waiting process has `->` after the number
        words = line.split()
        if len(words) != 8 or words[1] not in {"POSIX", "OFDLCK"}:
            continue
        needed = bytes_of.get(int(words[5].rpartition(":")[2]), range(0))
        first, last = int(words[6]), 1 << 63 if words[7] == "EOF" else int(words[7])
        if needed and first <= needed[-1] and needed[0] <= last:
            found.add(int(words[4]))
    return sorted(found)


# Watch the free space on the log's disk.

_LOOK_SECONDS = 0.5
_AGAIN = 1.25  # times the reserve must be free before space is no longer scarce, so that alarms do not flap


class DiskSpace:
    """The free space on the disk of the log at `path`.

    `tell` gets the bytes left of the last `reserve` bytes, or None while more is free, and the free bytes.
    """

    def __init__(self, path: Path, reserve: int, tell: Callable[[int | None, int], None]) -> None:
        self._folder = path.parent
        self._reserve = reserve
        self._tell = tell
        self.due = float("-inf")
        self.left: int | None = None

    def look(self, now: float) -> bool | None:
        """Return True if space just became scarce, False if it just ceased to be, else None. Raises `OSError`."""
        self.due = now + _LOOK_SECONDS
        disk = os.statvfs(self._folder)
        free, before = disk.f_bavail * disk.f_frsize, self.left
        enough = self._reserve if before is None else self._reserve * _AGAIN
        self.left = None if free >= enough else min(free, self._reserve)
        self._tell(self.left, free)
        return None if (before is None) == (self.left is None) else self.left is not None

    @property
    def scarce(self) -> str | None:
        if self.left is None:
            return None
        return (
            f"the disk of {self._folder} is nearly full: {self.left / 1e6:.1f} MB are free, less than the reserve of"
            f" {self._reserve / 1e6:.1f} MB (audit.reserve_bytes). Hosts that cause many records are slowed, and soon"
            " most changes are refused: make room, or let old records go (audit.retention_bytes)"
        )


Durability = Literal["strict", "batched"]
_GATHER_SECONDS = 0.02
_RETRY_SECONDS = 0.5
_LARGEST_BATCH = 2048
_IDLE_SECONDS = 1.0
_CLOSE_SECONDS = 10.0
_logger = structlog.get_logger()


class Lag(NamedTuple):
    """The number of waiting records, and the seconds since the queue was last empty."""

    records: int
    seconds: float


class _Lost(NamedTuple):
    """Records that did not fit into the queue."""

    records: int = 0
    first_time: int = 0
    last_time: int = 0


class AuditLog:
    """The log at `path`, open for writing; `drive` makes the driver that calls its turns, in one thread.

    `durability`: `strict` writes at once (group commit), `batched` after 20 ms; both fsync. The owner passes the
    answers of `signer` to `store_signature` or `refused`, those of `removals` to `removal_signed` or `removal_refused`.
    `held_by` gets the ids of processes that lock the log.
    """

    def __init__(
        self,
        path: Path,
        *,
        durability: Durability = "batched",
        checkpoint_every: int = 1000,
        checkpoint_seconds: float = 60.0,
        fold: FoldSettings | None = None,
        signer: CheckpointSigner | None = None,
        removals: RemovalSigner | None = None,
        retention: Retention | None = None,
        budget: Budget | None = None,
        reserve: int = AUDIT_RESERVE.bounds.whole,
        queue_limit: int = 100_000,
        held_by: Callable[[list[int]], None] = lambda processes: None,  # noqa: ARG005  the default ignores them
        clock: Callable[[], int] = wall_ns,
        drive: Drive = EngineThread,
    ) -> None:
        self.path = path
        self.ids = IdSource(clock=clock)
        self._clock = clock
        self._now = now()  # the time of the present turn
        self._queue_limit = queue_limit
        self._held_by = held_by
        self.budget = budget or Budget(lambda _host: QuotaClass.NAMED)
        self._room = DiskSpace(path, reserve, self.budget.room)
        self._folder = RecordFolder(fold or FoldSettings(), self.ids.next, clock)
        self._queue: deque[AuditRecord | Waiter | Callable[[], None]] = deque()
        self._held: list[AuditRecord] = []
        signatures, turn = Signatures(path, signer), lambda: self._now
        self.housekeeping = Housekeeping(
            signatures,
            Remover(retention or Retention(), signatures, removals, clock=clock, now=turn, make=self._own),
            records=checkpoint_every,
            seconds=checkpoint_seconds,
            writer=lambda: self._writer,
            clock=clock,
            now=turn,
            make=self._own,
            hold=self._held.append,
        )
        self._other_logs = OtherLogs(self._own, self._held.append)
        self._waiting: list[Waiter] = []
        self._writer: ChainWriter | None = None
        self._failed: str | None = "the log is being opened"
        self._failed_since = 0
        self._caught_up = self._written_at = self._retry_at = self._now
        self._lost, self._lock = _Lost(), threading.Lock()
        self._closing = self._ended = False
        self._continued: tuple[str, int] | None = None
        self._driver = drive("audit log", self.turn, 0.0 if durability == "strict" else _GATHER_SECONDS)

    # --- for the owner, from any thread ---------------------------------------------------------------------

    def record(self, record: AuditRecord) -> str:
        """Return the id of the record, or of the record that it repeats; "" if it is only counted with other kinds.

        The caller must not change `detail` afterwards.
        """
        if self._backlog >= self._queue_limit:
            with self._lock:
                records, first, _ = self._lost
                self._lost = _Lost(records + 1, first or record.time, record.time)
            return record.id
        self.budget.charge(record)
        found_by = self._folder.in_full(record)
        self._put(record)
        return found_by

    @property
    def _backlog(self) -> int:
        return len(self._queue) + len(self._held)

    async def wait_durable(self) -> str | None:
        """Return None after the fsync, or the reason why the records cannot be written."""
        waiter: Waiter = asyncio.get_running_loop().create_future()
        self._put(waiter)
        self._driver.hurry()
        return await waiter

    async def wait_signed(self) -> str | None:
        """Return None once a checkpoint that seals all records so far is signed, or why it is not."""
        waiter: Waiter = asyncio.get_running_loop().create_future()
        self._put(partial(self.housekeeping.seal_now, waiter))
        self._driver.hurry()
        return await waiter

    @property
    def failed(self) -> str | None:
        return self._failed or (f"{self.path}: the log is closed" if self._ended else None)

    @property
    def degraded(self) -> str | None:
        """Return which work besides writing is behind, or that the disk is nearly full."""
        behind = self.housekeeping.degraded
        return f"the audit log is behind: {behind}" if behind else self._room.scarce

    @property
    def lag(self) -> Lag:
        waiting = self._backlog
        return Lag(waiting, now() - self._caught_up if waiting else 0.0)

    def store_signature(self, number: int, signature: bytes, public_key: bytes) -> None:
        """Store a signature of the signer, if it is valid and made with the pinned key."""
        keep = self.housekeeping.keep_signature
        self._soon(lambda writer: keep(writer, number, signature, public_key))

    def other_logs(self, others: Sequence[OtherLog]) -> None:
        """Record the logs that the signer signed besides this one."""
        self._put(partial(self._other_logs.named, others))

    @property
    def replaced(self) -> str | None:
        """Return which other logs the signer signed that no operator set aside, in words."""
        return self._other_logs.missing

    def refused(self, number: int, reason: str) -> None:
        self._put(partial(self.housekeeping.refused, number, reason))

    def removal_signed(self, number: int, text: bytes, signature: bytes, public_key: bytes) -> None:
        """Remove records, if the signer's signature of exactly that removal is valid."""
        signed = self.housekeeping.remover.signed
        self._soon(lambda writer: signed(writer, number, text, signature, public_key))

    def removal_refused(self, number: int, reason: str, *, early: bool = False) -> None:
        """Request a removal again later; `early`: the records are too young for the signer."""
        self._put(partial(self.housekeeping.remover.refused, number, reason, early=early))

    def request_signatures(self) -> None:
        self._soon(self.housekeeping.ask_signatures)
        self._put(self.housekeeping.remover.ask_again)

    def _soon(self, step: Callable[[ChainWriter], None]) -> None:
        self._put(partial(self.housekeeping.attempt, step))

    def close(self, seconds: float = _CLOSE_SECONDS) -> str | None:
        self._closing = True
        if not self._driver.end(seconds):
            return f"{self.path}: still being written after {seconds:g} s"
        return self._failed

    def _put(self, item: AuditRecord | Waiter | Callable[[], None]) -> None:
        self._queue.append(item)
        self._driver.wake()
        if self._ended:
            self._refuse_queued()

    # --- the turns ------------------------------------------------------------------------------------------

    def turn(self, now: float) -> float | None:
        if self._ended:
            return None
        self._now = now
        if now < self._retry_at and not self._closing:
            return self._retry_at
        due = None
        try:
            due = self._turn(now)
        except BaseException as error:
            # A defect: the owner must see that records are not written, and deny requests, until a turn succeeds.
            self._failed = f"{self.path}: writing ended: {type(error).__name__}: {error}"
            if self._closing or not isinstance(error, Exception):
                raise
            self._fail(error)
            due = self._retry_at = now + _RETRY_SECONDS
        finally:
            if due is None:
                self._ended = True
                self._answer_waiting()
                self._refuse_queued()
        return due

    def _refuse_queued(self) -> None:
        with contextlib.suppress(IndexError):
            while True:
                item = self._queue.popleft()
                if isinstance(item, asyncio.Future):
                    answer([item], self.failed)

    def _turn(self, now: float) -> float | None:
        closing = self._closing  # the queue has everything that was recorded before
        self.budget.parts.queue(self._backlog / self._queue_limit)
        more = self._drain(now)
        for due in self._folder.expire(now):
            self._held.append(due)
            self.budget.correct(due, 1)
        if now >= self._room.due:
            self._look_for_room(now)
        written = self._attempt()
        self._answer_waiting()
        again = more and written
        self.housekeeping.after_batch(
            written=written, rest=not again, quiet_since=self._written_at, busy=lambda: bool(self._queue)
        )
        if again:
            return now
        if closing:
            self._finish()
            return None
        if self._failed is not None:
            self._retry_at = now + _RETRY_SECONDS
            return self._retry_at
        if not self._queue:
            self._caught_up = now
        dues = (now + _IDLE_SECONDS, self._folder.next_due(), self.housekeeping.next_due(now))
        return max(now + 0.001, min(due for due in dues if due is not None))

    def _finish(self) -> None:
        self._held.extend(self._folder.finish())
        if self._attempt() and self._writer is not None and self._writer.unsealed:
            self.housekeeping.attempt(self.housekeeping.seal)
        self._answer_waiting()
        if self._writer is not None:
            self._writer.close()

    def _drain(self, now: float) -> bool:
        queue, offer = self._queue, self._folder.offer
        for _ in range(_LARGEST_BATCH):
            if not queue:
                return False
            item = queue.popleft()
            if isinstance(item, AuditRecord):
                written = list(offer(item, now))
                self._held.extend(written)
                for record in written:
                    if record is not item:
                        self.budget.correct(record, 1)
                if not any(record is item for record in written):
                    self.budget.correct(item, -1)
            elif isinstance(item, asyncio.Future):
                self._waiting.append(item)
            else:
                item()
        return bool(queue)

    def _look_for_room(self, now: float) -> None:
        with contextlib.suppress(OSError):  # the writer reports a missing folder
            scarce = self._room.look(now)
            if scarce is not None:
                severity, left = (Severity.ALARM if scarce else Severity.NOTICE), self._room.left
                event = "disk nearly full" if scarce else "disk has room"
                _logger.warning(event, left=left, reason=self._room.scarce)
                self._held.append(self._own(event, severity, self._room.scarce or "", {"left": left}))

    def _attempt(self) -> bool:
        """Return whether everything is written. A failure closes the database until a retry."""
        try:
            if self._writer is None:
                self._open()
            self._write()
        except Exception as error:  # noqa: BLE001  after a defect too, records wait for the next attempt
            self._fail(error)
            return False
        return True

    def _fail(self, error: Exception) -> None:
        known = isinstance(error, WRITE_ERRORS)
        reason = reason_of(error, self.path.parent) if known else f"{type(error).__name__}: {error}"
        if isinstance(error, sqlite3.OperationalError) and "locked" in reason:
            # This process is in the list because its own connection is still open.
            others = [pid for pid in holders(self.path) if pid != os.getpid()]
            if others:
                reason = f"{reason} by process {', '.join(map(str, others))}"
                self._held_by(others)
        self._failed = reason if str(self.path) in reason else f"{self.path}: {reason}"
        if self._failed_since == 0:
            self._failed_since = self._clock()
            _logger.error(
                "the audit log cannot be written", reason=self._failed, exc_info=None if known else error
            )
        if self._writer is not None:
            writer, self._writer = self._writer, None
            with contextlib.suppress(sqlite3.Error):
                writer.close()

    def _open(self) -> None:
        earlier = pinned_key_path(self.path).exists()
        self._writer = writer = ChainWriter(self.path, self._clock(), self._continued)
        self.ids.raise_floor(writer.last_id)
        if writer.created:
            detail = {"log": writer.log_id, "earlier_log_missing": earlier}
            self._held.insert(
                0, self._own("log begun", Severity.ALARM if earlier else Severity.NOTICE, "", detail)
            )
        # Recover counts only once: afterwards the table has the counts of this process.
        if self._continued is None and (left := writer.open_folds()):
            summaries = [
                summary(fold, self.ids.next(), self._clock(), recovered=True) for fold in left.values()
            ]
            writer.append(summaries, [(key, None) for key in left])
        self._continued = (writer.log_id, writer.sequence)
        self.housekeeping.ask_signatures(writer)

    def _write(self) -> None:
        writer = self._writer
        while writer and (self._held or self._folder.touched or self._failed_since):
            batch = self._held[:_LARGEST_BATCH]
            touched = tuple(self._folder.touched)
            report = []
            if self._failed_since:
                detail = {"since": self._failed_since, "until": self._clock()}
                report = [self._own("log failed", Severity.ALARM, self._failed or "", detail)]
            writer.append(
                batch + report,
                [(msgspec.json.encode(key), self._folder.state(key)) for key in touched],
            )
            self._continued = (writer.log_id, writer.sequence)
            del self._held[: len(batch)]
            self._folder.touched.difference_update(touched)
            self._caught_up = self._written_at = self._now
            if self._failed_since:
                self._failed_since = 0
                _logger.warning("the audit log is written again")
            if self._lost.records:
                with self._lock:
                    lost, self._lost = self._lost, _Lost()
                detail = {"count": lost.records, "first_time": lost.first_time, "last_time": lost.last_time}
                self._held.append(self._own("records lost", Severity.ALARM, "the queue was full", detail))
        self._failed = None

    def _answer_waiting(self) -> None:
        result = self.failed if self._held or self._folder.touched else None
        waiting, self._waiting = self._waiting, []
        answer(waiting, result)

    def _own(self, event: str, severity: Severity, reason: str, detail: dict[str, Any]) -> AuditRecord:
        identity, time = self.ids.next(), self._clock()
        return AuditRecord(
            id=identity, time=time, event=event, severity=severity, reason=reason, detail=detail
        )
