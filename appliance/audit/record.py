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
