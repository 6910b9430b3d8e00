"""Define the record of the audit log: schema version 1. A written record never changes."""

import enum
from collections.abc import Callable
from typing import Any

import msgspec

SCHEMA_VERSION = 1


class Severity(enum.StrEnum):
    """The importance of a record for an operator, ascending."""

    DEBUG = "debug"
    INFO = "info"
    NOTICE = "notice"
    WARNING = "warning"
    ALARM = "alarm"


class RuleReference(msgspec.Struct, frozen=True):
    """The policy rule that decided."""

    section: str
    key: str
    file: str
    line: int


class AuditRecord(msgspec.Struct, frozen=True, kw_only=True):
    """An event with its author, or a decision with its rule.

    `time` is in nanoseconds since the epoch; `duration_us` is the time from the request's arrival to the decision.
    Two fields are not stored: `unknown` (no rule of the policy names `host`), and `folds` (repetitions are only
    counted).
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
    unknown: bool = False
    folds: bool = False


MakeRecord = Callable[[str, Severity, str, dict[str, Any]], AuditRecord]
"""Makes a record about the log itself from event, severity, reason and detail."""
