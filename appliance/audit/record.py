"""One record of the audit log: the documented schema, the same in the CLI, REST and the export.

Schema version 1. A record is made where the thing happens, gets its `sequence` and its place in the hash
chain when the log takes it, and is never changed afterwards.
"""

import enum
from typing import Any

import msgspec

SCHEMA_VERSION = 1


class Severity(enum.StrEnum):
    """How much a person should care."""

    DEBUG = "debug"
    INFO = "info"
    NOTICE = "notice"
    WARNING = "warning"
    ALARM = "alarm"


class RuleReference(msgspec.Struct, frozen=True):
    """The policy rule that decided: section, key, file and line (from 1)."""

    section: str
    key: str
    file: str
    line: int


class Record(msgspec.Struct, frozen=True, kw_only=True):
    """What happened, who did it, and what was decided by which rule.

    `id` is sortable (time first) and unique; `time` is nanoseconds since the epoch, UTC; `decision` is
    `allow`, `deny`, `would deny` or None; `host` is the peer's address; `duration_us` is microseconds from
    the request's arrival to the decision; `detail` holds the fields of this event.

    Two are for the log alone and not stored: `stranger`: no rule of the policy names `host`; `folds`: it passed, and
    its repetitions are counted, because it only reads.
    """

    id: str
    time: int
    event: str
    severity: Severity = Severity.INFO
    decision: str | None = None
    host: str | None = None
    caller_id: str | None = None
    category: str | None = None
    resource: str | None = None
    rule: RuleReference | None = None
    revision: int | None = None
    reason: str = ""
    duration_us: int | None = None
    detail: dict[str, Any] = {}
    stranger: bool = False
    folds: bool = False


class Repeated:
    """A record that `folds`, and how often the same has happened since: the log is given at once what is new of that.

    `total`, and when the last one was and how long it took, are written by who counts; `taken` by the log's thread.
    That clears `queued` before it reads `total`, and who counts reads `queued` after he has counted: none is missed.
    """

    __slots__ = ("duration_us", "queued", "record", "taken", "time", "total")

    def __init__(self, record: Record) -> None:
        self.record = record
        self.total = self.taken = 0
        self.queued = False
        self.time = record.time
        self.duration_us = record.duration_us

    def take(self) -> int:
        """How many are new."""
        self.queued = False
        new = self.total - self.taken
        self.taken += new
        return new

    def made(self, record_id: str, number: int) -> Record:
        """The record of so many of them."""
        detail = self.record.detail | ({"count": number} if number > 1 else {})
        return msgspec.structs.replace(
            self.record, id=record_id, time=self.time, duration_us=self.duration_us, detail=detail
        )
