"""Show equal records as one row: a flood of one cause is one row for a person.

1. Records are equal if they differ only in time, ids, contents of messages and the numbers in the reason.
2. A record that stands for several (`12 more in the same second`) equals the record that it continues, and counts
   that many times. If it does not repeat the reason, it equals each record with its other fields.
3. Equal records are one row if they are consecutive. At most `_BETWEEN` rows of other monitors may separate a
   monitor's records, because one message causes several. Any other record ends all rows, so order is kept.
"""

import hashlib
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

from appliance.audit.log.record import AuditRecord
from appliance.audit.log.record_format import LogEntry, rfc3339
from appliance.audit.log.repetition import ABOUT, KIND, repetitions
from appliance.base.varying_numbers import without_numbers

FOLDED = frozenset({"denials folded", "repetitions folded"})
_ABOUT_THE_LOG = frozenset({"records removed", "records lost", "forwarding gap"})
"""Events whose `detail.count` is a number of records, not of repetitions."""
_MORE = re.compile(
    r"(in shadow mode(?:, not done)?: )?"
    r"\d{1,18}+ more(?: in the same second| in \d{1,18}+ s|, \d{1,18}+ in \d{1,18}+ s, until it ended)(?:: )?"
)
_BETWEEN = 8


class EqualKey(NamedTuple):
    """The fields that equal records share; `reason` is without numbers, and empty if the record does not repeat it."""

    fields: tuple[object, ...]
    reason: str

    def equals(self, other: "EqualKey") -> bool:
        same_reason = self.reason == other.reason or not (self.reason and other.reason)
        return self.fields == other.fields and same_reason


@dataclass(slots=True)
class EqualRecords:
    """A row of equal records: how many there are, and how often the event happened."""

    first: LogEntry
    last: LogEntry
    records: int
    count: int
    value: str


def equal_key(record: AuditRecord) -> EqualKey:
    detail, rule = record.detail, record.rule
    event = str(detail.get("of")) if _continues(record) else record.event
    fields = (
        event, record.severity, record.decision, record.host, record.caller_id, record.category, record.resource,
        detail.get("category"), detail.get("would"), *(str(detail.get(name)) for name in ABOUT),
        None if rule is None else (rule.section, rule.key, rule.file, rule.line),
    )  # fmt: skip
    return EqualKey(fields, without_numbers(plain_reason(record)))


def plain_reason(record: AuditRecord) -> str:
    """Return the reason without its words about repetitions."""
    if "monitor" not in record.detail:
        return record.reason
    match = _MORE.match(record.reason)
    if match is None:
        return record.reason
    text = record.reason[match.end() :]
    return (match[1] or "") + text if text else ""


def time_span(record: AuditRecord) -> tuple[int, int]:
    """Return the times of the first and last event, if the record has them: it is made some time after its events."""
    first, last = record.detail.get("first_time"), record.detail.get("last_time")
    return (first, last) if type(first) is int and type(last) is int else (record.time, record.time)


def times(record: AuditRecord) -> int:
    return times_of(record.event, record.detail)


def times_of(event: str, detail: dict[str, object]) -> int:
    return 1 if event in _ABOUT_THE_LOG else repetitions(detail)


def group_equal(entries: Iterable[LogEntry]) -> list[EqualRecords]:
    rows: list[EqualRecords] = []
    open_rows: list[tuple[EqualKey, EqualRecords]] = []
    for entry in entries:
        key, reach = equal_key(entry.record), _reach(entry.record)
        reachable = open_rows[-reach:]
        at = next((place for place, (other, _row) in enumerate(reachable) if key.equals(other)), None)
        if at is None:
            row = EqualRecords(entry, entry, 1, times(entry.record), plain_reason(entry.record))
            rows.append(row)
            open_rows = [*open_rows, (key, row)][-reach:]
            continue
        other, row = reachable[at]
        _add(row, entry)
        if not other.reason and key.reason:
            open_rows[open_rows.index(reachable[at])] = (key, row)
    return rows


def equality_of(record: AuditRecord) -> dict[str, object]:
    """Return everything that a client needs to make the rows of `group_equal` itself.

    Equal records have equal keys, and equal reasons unless one is empty. A record joins one of the last `reach`
    rows.
    """
    key = equal_key(record)
    value = plain_reason(record)
    began, ended = map(rfc3339, time_span(record))
    return {
        "key": _hash(repr(key.fields)),
        "reason": key.reason and _hash(key.reason),
        "reach": _reach(record),
        "times": times(record),
        "value": value,
        "began": began,
        "ended": ended,
    }


def _hash(text: str) -> str:
    return hashlib.blake2b(text.encode(errors="surrogatepass"), digest_size=12).hexdigest()


def _reach(record: AuditRecord) -> int:
    return _BETWEEN + 1 if "monitor" in record.detail else 1


def _add(row: EqualRecords, entry: LogEntry) -> None:
    row.records += 1
    row.count += times(entry.record)
    reason = plain_reason(entry.record)
    if entry.sequence < row.first.sequence:
        row.first, row.value = entry, row.value or reason
    else:
        row.last, row.value = entry, reason or row.value


def _continues(record: AuditRecord) -> bool:
    return record.event in FOLDED and record.detail.get("scope") == KIND
