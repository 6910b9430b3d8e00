"""Run the pusher of segments as a process of the appliance, like the forwarder of the log."""

import asyncio
import contextlib
import gzip
import os
import random
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated

import msgspec
import structlog

from appliance.audit.log.log_database import LogUnreadableError, reading
from appliance.audit.log.log_queries import first_time, last_signed, log_id, record_extent
from appliance.audit.log.signatures import read_public_key
from appliance.audit.proof.copies import signed_checkpoints
from appliance.base import clock
from appliance.base.atomic_files import write_whole
from appliance.base.system_errors import without_number
from appliance.channel.messages import ForwardingReported
from appliance.configuration.settings import Settings, load_resolved
from appliance.features.fleet.connection import CollectorConnection, CollectorError, robot_connection
from appliance.features.fleet.settings import Fleet
from appliance.formats.receipts import SegmentReceipt
from appliance.formats.segments import SegmentSummary, next_segment, write_segment
from appliance.forwarding.process import ForwardingProcess
from appliance.signing.log_proof import checkpoint_hash

# Push the log's sealed segments to the collector: in order, until each has a receipt.
#
# 1. The database is only read, so pushing never delays the log or loses its records.
# 2. Memory is bounded by one record. The segment at work is a compressed file.
# 3. A segment counts as pushed only with a receipt on this disk that the collector's key has signed.
# 4. On each new connection the collector reports what it has: it may have been restored from a backup.
# 5. If the log was restored from a copy, pushing continues from the last checkpoint that log and collector share.
# 6. While nothing waits, the robot reports so every minute, because a robot without records is not silent. When it is
#    shut down cleanly, it reports that as well, unless pushing fails.

_IDLE_SECONDS = 1.0
_PRESENCE_SECONDS = 60.0
_NO_LOG = "0" * 32
_FIRST_PAUSE = 0.5
_LONGEST_PAUSE = 60.0
_LONGEST_ASKED = 3600.0
_RECEIPTS_BYTES = 16 << 20
_LARGEST_SEGMENT = 1 << 30
_PART = 65_536
_log = structlog.get_logger()


class PushPosition(msgspec.Struct, frozen=True):
    """The checkpoint and the last record of the last segment with a receipt.

    Before the first receipt, `number` is 0, and `sequence` is the last record that retention had removed by then, or
    None if that is unknown.
    """

    log: str
    number: int = 0
    sequence: int | None = None


class StoredHead(msgspec.Struct, frozen=True):
    """The collector's newest checkpoint of a log (0: none), with the hashes of all checkpoints of this number."""

    robot: str
    log: str
    number: Annotated[int, msgspec.Meta(ge=0, lt=10**18)]
    hashes: list[str]


@dataclass(slots=True)
class SegmentPusher:
    """Pushes segments with files in `folder`; the public key `receipt_key` (raw) verifies the receipts."""

    log: Path
    folder: Path
    collector: CollectorConnection
    receipt_key: bytes
    jitter: Callable[[], float] = random.random
    clock: Callable[[], int] = clock.wall_ns
    progress: ForwardingReported = field(default_factory=ForwardingReported)
    _position: PushPosition | None = None
    _presence_due: float = 0.0
    _failures: int = 0

    def step(self) -> float:
        try:
            more = self._push_next() if self._has_log() else self._state_presence(PushPosition(_NO_LOG))
        except (CollectorError, LogUnreadableError, OSError, ValueError) as error:
            return self._failed(error)
        if self._failures:
            _log.warning("segments are pushed to the collector again")
        self._failures = 0
        return 0.0 if more else _IDLE_SECONDS

    def close(self, *, stopped: bool = False) -> None:
        if stopped and not self.progress.trouble:
            # Without an answer, the collector will report this robot as silent.
            with contextlib.suppress(CollectorError, OSError, ValueError):
                self._report_presence(self._position or PushPosition(_NO_LOG), "&off=true")
        self.collector.close()

    def _begin(self) -> PushPosition:
        log, upto = _newest_signed(self.log)
        lowest = next_segment(self.log, 0) or 1
        kept = self._stored_position()
        if kept is None or kept.log != log:
            self._store(PushPosition(log, 0, _removed_through(self.log)))
        position, step = PushPosition(log, 0, self._kept_sequence(log, 0)), 1
        while upto > 0:
            head = msgspec.json.decode(self.collector.get(f"v1/logs/{log}?upto={upto}"), type=StoredHead)
            if head.number > upto:
                raise ValueError(
                    f"the collector answers with checkpoint {head.number}, later than the requested {upto}: upgrade"
                    " both to the same version"
                )
            if head.number < lowest:  # the log has no such checkpoint (any more)
                position = PushPosition(log, head.number, self._kept_sequence(log, head.number))
                break
            sequence = _sequence_of(self.log, head.number, head.hashes)
            if sequence is not None and sequence == self._kept_sequence(log, head.number):
                position = PushPosition(log, head.number, sequence)
                break
            if sequence is not None:  # its receipt is not on this disk: the answer to the same segment has it
                position = PushPosition(log, head.number - 1)
                break
            upto, step = head.number - step, 2 * step
        self._position = position
        self._look(position)
        return position

    def _stored_position(self) -> PushPosition | None:
        try:
            return msgspec.json.decode((self.folder / "position.json").read_bytes(), type=PushPosition)
        except (FileNotFoundError, ValueError):
            return None

    def _kept_sequence(self, log: str, number: int) -> int | None:
        kept = self._stored_position()
        return kept.sequence if kept is not None and (kept.log, kept.number) == (log, number) else None

    def _store(self, position: PushPosition) -> None:
        write_whole(self.folder / "position.json", msgspec.json.encode(position), 0o600)

    def _has_log(self) -> bool:
        """Return whether there is a log. Only an appliance that was never active has none."""
        return self.log.exists() or (self.folder / "position.json").exists()

    def _state_presence(self, position: PushPosition) -> bool:
        """Report once a minute that nothing waits. If the collector lacks the last segment, begin again."""
        now = clock.now()
        if now < self._presence_due:
            return False
        head = self._report_presence(position)
        self._presence_due = now + _PRESENCE_SECONDS * (0.8 + 0.4 * self.jitter())
        if head.number != position.number or (head.number and not head.hashes):
            self._position = None
        self.progress = msgspec.structs.replace(self.progress, trouble="")
        return False

    def _report_presence(self, position: PushPosition, more: str = "") -> StoredHead:
        asked = f"v1/logs/{position.log}?upto={position.number}&idle=true{more}"
        return msgspec.json.decode(self.collector.get(asked), type=StoredHead)

    def _push_next(self) -> bool:
        position = self._position or self._begin()
        log, _newest = _newest_signed(self.log)
        if log != position.log:
            self._position = None
            self.progress = msgspec.structs.replace(self.progress, sequence=0, checkpoint=0)
            raise LogUnreadableError(
                f"{self.log}: the log was replaced; the collector is asked for its position"
            )
        number = next_segment(self.log, position.number)
        if number is not None and not self.collector.is_open:
            position = self._begin()
            number = next_segment(self.log, position.number)
        if number is None:
            self._look(position)
            return self._state_presence(position)
        file = self.folder / "segment.gz"
        summary = self._write(file, number)
        if summary is None:
            self._look(position)
            if _is_passed_over(self.log, number):
                raise LogUnreadableError(
                    f"{self.log}: checkpoint {number} is not signed, but later ones are: run rosrv audit verify;"
                    " collecting continues when retention has removed its records"
                )
            return False
        path = f"v1/logs/{log}/segments/{number}/{summary.name}"
        try:
            with file.open("rb") as body:
                parts = iter(partial(body.read, _PART), b"")
                answer = self.collector.put(path, parts, file.stat().st_size, [("Content-Encoding", "gzip")])
        finally:
            file.unlink()
        receipt = msgspec.json.decode(answer, type=SegmentReceipt)
        self._check(receipt, log, number, summary)
        self._keep(receipt)
        self._advance(position, summary)
        return True

    def _write(self, file: Path, number: int) -> SegmentSummary | None:
        left = _LARGEST_SEGMENT
        try:
            with (
                file.open("wb") as raw,
                gzip.GzipFile(fileobj=raw, mode="wb", mtime=0, filename="") as packed,
            ):

                def write(line: bytes) -> None:
                    nonlocal left
                    left -= len(line)
                    if left < 0:
                        raise ValueError(f"segment {number} has more than {_LARGEST_SEGMENT} bytes")
                    packed.write(line)

                summary = write_segment(self.log, number, write)
        except BaseException:
            file.unlink(missing_ok=True)
            raise
        if summary is None:
            file.unlink()
        return summary

    def _check(self, receipt: SegmentReceipt, log: str, number: int, summary: SegmentSummary) -> None:
        expected = (log, number, summary.name, summary.first, summary.last)
        if (receipt.log, receipt.number, receipt.segment, receipt.first, receipt.last) != expected:
            raise ValueError(f"the collector's receipt is not for segment {number}")
        if not receipt.is_signed(self.receipt_key):
            raise ValueError(
                "the collector's receipt has a wrong signature: fleet.receipt_key is another collector's, so join"
                " again (rosrv fleet join)"
            )

    def _keep(self, receipt: SegmentReceipt) -> None:
        """Append a receipt to the file. Only the last 16 to 32 MiB of receipts are kept."""
        file = self.folder / "receipts.ndjson"
        with file.open("a+b") as kept:
            if kept.tell():  # a kill or a full disk may have left a part of a line
                kept.seek(-1, os.SEEK_END)
                kept.write(b"" if kept.read(1) == b"\n" else b"\n")
            kept.write(msgspec.json.encode(receipt) + b"\n")
            kept.flush()
            os.fsync(kept.fileno())
        if file.stat().st_size > _RECEIPTS_BYTES:
            file.replace(file.with_name("receipts.1.ndjson"))

    def _advance(self, position: PushPosition, summary: SegmentSummary) -> None:
        missed = 0 if position.sequence is None else max(0, summary.first - position.sequence - 1)
        if missed:
            _log.error("retention removed records before the collector had them", count=missed)
        end = summary.header.end
        self._position = PushPosition(position.log, end.number, end.sequence)
        self._store(self._position)
        self.progress = msgspec.structs.replace(
            self.progress, sent=self.progress.sent + 1, missed=self.progress.missed + missed
        )
        self._look(self._position)

    def _look(self, position: PushPosition) -> None:
        sequence = position.sequence or 0
        sealed, oldest = _waiting(self.log, sequence)
        self.progress = msgspec.structs.replace(
            self.progress,
            sequence=sequence,
            checkpoint=position.number,
            behind=max(0, sealed - sequence),
            seconds=max(0.0, (self.clock() - oldest) / 1e9) if oldest else 0.0,
            trouble="",
        )

    def _failed(self, error: Exception) -> float:
        """Note the failure, and return a pause that grows, with jitter, so that robots do not return together."""
        self.collector.close()
        self._position = None
        reason = without_number(error) or type(error).__name__
        if not self._failures:
            _log.error("segments are not pushed to the collector; it is tried again and again", reason=reason)
        pause = min(_LONGEST_PAUSE, _FIRST_PAUSE * 2.0 ** min(self._failures, 10))
        if isinstance(error, CollectorError):
            pause = max(pause, min(error.wait, _LONGEST_ASKED))
        self._failures += 1
        self.progress = msgspec.structs.replace(self.progress, trouble=reason)
        return pause * (0.5 + self.jitter())


def _newest_signed(log: Path) -> tuple[str, int]:
    with reading(log, advice="") as connection:
        number, _sequence = last_signed(connection)
        return log_id(connection), number


def _removed_through(log: Path) -> int:
    """Return the sequence before the first record."""
    with reading(log, advice="") as connection:
        first, _last = record_extent(connection)
    return first - 1


def _sequence_of(log: Path, number: int, hashes: list[str]) -> int | None:
    found = signed_checkpoints(log, number - 1, 1) if number else []
    same = found and found[0].number == number and checkpoint_hash(found[0].text()) in hashes
    return found[0].sequence if same else None


def _is_passed_over(log: Path, number: int) -> bool:
    """Return whether the checkpoint will never be signed, because a later checkpoint is."""
    signed = signed_checkpoints(log, number - 1, 1)
    return bool(signed) and signed[0].number > number and next_segment(log, number - 1) == number


def _waiting(log: Path, sequence: int) -> tuple[int, int]:
    """Return the last sealed sequence, and the time of the first sealed record after `sequence` (0: none)."""
    with reading(log, advice="") as connection:
        _number, sealed = last_signed(connection)
        return sealed, first_time(connection, sequence, sealed)


def main(lifeline_fd: int, config: Path) -> None:
    pusher = make_pusher(load_resolved(config), Path.cwd())
    asyncio.run(ForwardingProcess(pusher, lifeline_fd).run())


def make_pusher(settings: Settings, folder: Path) -> SegmentPusher:
    fleet = settings.of(Fleet)
    assert fleet.receipt_key is not None  # noqa: S101  the role runs only with it
    return SegmentPusher(
        settings.state / "control" / "audit.db",
        folder,
        robot_connection(*fleet.connection),
        read_public_key(fleet.receipt_key),
    )
