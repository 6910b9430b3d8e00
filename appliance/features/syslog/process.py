"""Run the forwarder of the audit log to a syslog receiver, as a process of the appliance."""

import asyncio
import ssl
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import msgspec
import structlog

from appliance.audit.log.log_database import LogUnreadableError, reading
from appliance.audit.log.log_queries import (
    first_after_id,
    last_checkpoint,
    log_id,
    record_extent,
    record_id,
)
from appliance.audit.log.record import AuditRecord, Severity
from appliance.audit.log.record_format import LogEntry
from appliance.audit.proof.copies import signed_checkpoints
from appliance.audit.search.query import Filter
from appliance.audit.search.search import search
from appliance.base import clock
from appliance.base.atomic_files import write_whole
from appliance.channel.messages import ForwardingReported
from appliance.configuration.settings import Settings, load_resolved
from appliance.features.syslog.receiver import DatagramReceiver, Receiver, StreamReceiver, tls_context
from appliance.features.syslog.settings import Syslog
from appliance.features.syslog.syslog import LONGEST_DATAGRAM, LONGEST_IN_STREAM, Formatter
from appliance.forwarding.process import ForwardingProcess

# Forward the committed records of the log: in order, at least once, from the stored position.
#
# 1. The database is only read, so forwarding never delays the log or loses its records.
# 2. The position advances only when the receiver has the batch.
# 3. If the log was restored from a copy, new records that reuse sequence numbers of sent records are also sent.

Chosen = Literal["all", "denials"]
_BATCH = 256
_IDLE_SECONDS = 0.5
_BACK_OFF = (0.5, 1.0, 2.0, 5.0, 10.0, 30.0)
_SAVE_SECONDS = 1.0
_log = structlog.get_logger()


class ForwardingPosition(msgspec.Struct, frozen=True):
    """The last record and checkpoint that the receiver has.

    It is stored after the receiver has both, so after a crash some records are sent again.
    """

    log: str
    sequence: int = 0
    checkpoint: int = 0
    record: str = ""
    """An id: if the log was restored from a copy, another record may have the same sequence."""


def load_position(path: Path) -> ForwardingPosition | None:
    try:
        return msgspec.json.decode(path.read_bytes(), type=ForwardingPosition)
    except FileNotFoundError:
        return None
    except ValueError as error:
        raise ValueError(f"{path}: {error}; remove it to have the whole log forwarded again") from error


def save_position(path: Path, position: ForwardingPosition) -> None:
    write_whole(path, msgspec.json.encode(position), 0o600)


@dataclass(slots=True)
class LogForwarder:
    """Forwards the log; its position is in the file `kept`. Not thread-safe."""

    log: Path
    kept: Path
    receiver: Receiver
    formatter: Formatter
    chosen: Chosen
    clock: Callable[[], int] = clock.wall_ns
    progress: ForwardingReported = field(default_factory=ForwardingReported)
    _position: ForwardingPosition | None = None
    _saved: ForwardingPosition | None = None
    _saved_at: float = 0.0
    _failures: int = 0

    def step(self) -> float:
        try:
            position = self._position or self._begin()
            more = self._forward(position)
        except (LogUnreadableError, OSError, ValueError) as error:
            return self._failed(str(error) or type(error).__name__)
        if self._failures:
            _log.warning("the audit log is forwarded again")
        self._failures = 0
        try:
            self._save(_SAVE_SECONDS)
        except OSError as error:  # a full disk delays no record: only a restart sends some again
            reason = f"the position is not kept, so a restart sends records again: {error}"
            self.progress = msgspec.structs.replace(self.progress, trouble=reason)
        return 0.0 if more else _IDLE_SECONDS

    def close(self, *, stopped: bool = False) -> None:  # noqa: ARG002  syslog has no message for it
        self.receiver.close()
        try:
            self._save(0.0)
        except OSError as error:
            _log.error("the position is not kept: some records will be forwarded again", error=str(error))

    def _begin(self) -> ForwardingPosition:
        first, _last, log_id = _extent(self.log)
        position = load_position(self.kept)
        if position is not None and position.log != log_id:
            _log.warning("another audit log is forwarded from its beginning", log=log_id, before=position.log)
            position = None
        self._position = _in_log(self.log, position) if position else ForwardingPosition(log_id, first - 1)
        return self._position

    def _forward(self, position: ForwardingPosition) -> bool:
        _first, head, log_id = _extent(self.log)
        if log_id != position.log or head < position.sequence:
            self._position = None
            raise LogUnreadableError(f"{self.log}: the log was replaced; its position is determined again")
        entries = search(self.log, Filter(), str(position.sequence), _BATCH, newest_first=False).entries
        checkpoints = signed_checkpoints(self.log, position.checkpoint, _BATCH)
        missed = entries[0].sequence - position.sequence - 1 if entries else 0
        if missed:
            _log.error("retention removed records before they were forwarded", count=missed)
        through = entries[-1].sequence if entries else position.sequence
        ready = [checkpoint for checkpoint in checkpoints if checkpoint.sequence <= through or not entries]
        self._look(head - position.sequence, entries)
        messages = [self.formatter.record(entry) for entry in entries if self._wanted(entry.record)]
        messages += [self.formatter.checkpoint(checkpoint) for checkpoint in ready]
        if messages:
            self.receiver.send(messages)
        last = ready[-1].number if ready else position.checkpoint
        self._position = ForwardingPosition(
            position.log, through, last, entries[-1].record.id if entries else position.record
        )
        self.progress = ForwardingReported(
            sent=self.progress.sent + len(messages),
            sequence=through,
            checkpoint=last,
            behind=head - through,
            seconds=self._waited(entries[-1:]) if head > through else 0.0,
            missed=self.progress.missed + missed,
        )
        return head > through or len(ready) == _BATCH

    def _wanted(self, record: AuditRecord) -> bool:
        return (
            self.chosen == "all"
            or record.decision in ("deny", "would deny")
            or record.severity in (Severity.WARNING, Severity.ALARM)
        )

    def _look(self, behind: int, entries: list[LogEntry]) -> None:
        seconds = self._waited(entries)
        self.progress = msgspec.structs.replace(self.progress, behind=behind, seconds=seconds)

    def _waited(self, entries: list[LogEntry]) -> float:
        return max(0.0, (self.clock() - entries[0].record.time) / 1e9) if entries else 0.0

    def _failed(self, reason: str) -> float:
        self.receiver.close()
        pause = _BACK_OFF[min(self._failures, len(_BACK_OFF) - 1)]
        if not self._failures:
            _log.error("the audit log is not forwarded; it is tried again and again", reason=reason)
        self._failures += 1
        self.progress = msgspec.structs.replace(self.progress, trouble=reason)
        return pause

    def _save(self, at_most_every: float) -> None:
        now = clock.now()
        if self._position is None or self._position == self._saved or now - self._saved_at < at_most_every:
            return
        save_position(self.kept, self._position)
        self._saved, self._saved_at = self._position, now


def _extent(path: Path) -> tuple[int, int, str]:
    with reading(path, advice="") as connection:
        return *record_extent(connection), log_id(connection)


def _in_log(path: Path, position: ForwardingPosition) -> ForwardingPosition:
    """Return the position in a log that may have been restored from a copy.

    Such a log continues with sequences that were already used. Ids are ordered by time, so every record with a later
    id than the last sent record is new.
    """
    with reading(path, advice="") as connection:
        found = record_id(connection, position.sequence)
        _first, head = record_extent(connection)
        is_there = not position.record or found is None or found == position.record
        if is_there and position.sequence <= head:
            return position
        new = first_after_id(connection, position.record) if position.record else None
        sequence = min(position.sequence, head) if new is None else new - 1
        number = last_checkpoint(connection, sequence)
    _log.warning(
        "the audit log was restored from a copy: forwarding continues from its end", sequence=sequence
    )
    return ForwardingPosition(position.log, sequence, min(position.checkpoint, number))


def main(lifeline_fd: int, config: Path) -> None:
    forwarder = make_forwarder(load_resolved(config), Path.cwd() / "position.json")
    asyncio.run(ForwardingProcess(forwarder, lifeline_fd).run())


def make_forwarder(settings: Settings, kept: Path) -> LogForwarder:
    wanted = settings.of(Syslog)
    longest = LONGEST_DATAGRAM if wanted.destination[0] == "udp" else LONGEST_IN_STREAM
    return LogForwarder(
        settings.state / "control" / "audit.db",
        kept,
        receiver_of(wanted),
        Formatter(
            facility=wanted.facility,
            longest=longest,
            host_name=wanted.host_name or settings.name or None,
        ),
        chosen=wanted.send,
    )


def receiver_of(wanted: Syslog) -> Receiver:
    protocol, host, port = wanted.destination
    if protocol == "udp":
        return DatagramReceiver(host, port)
    context: Callable[[], ssl.SSLContext] | None = None
    if protocol == "tls":
        # Made for each connection, so that replaced certificate files apply to the next connection.
        def context() -> ssl.SSLContext:
            return tls_context(wanted.ca, wanted.certificate, wanted.key)

    return StreamReceiver(host, port, context, wanted.name)
