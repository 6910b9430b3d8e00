"""Summarise the denials of a log by host: number, first and last time, most frequent reasons, callers.

1. Memory and time are bounded: beyond the limits, hosts, reasons and callers count as `OTHERS`. Decisions about calls
   have their own limit, so the noise of a port scan does not hide them.
2. No reason has contents of messages. Reasons that differ only in numbers are counted together.
3. Rights that a new policy or a block revoked are not counted, because the host attempted nothing.
"""

import functools
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import msgspec

from appliance.audit.log.record import AuditRecord
from appliance.audit.log.record_format import LogEntry, rfc3339, rule_text, without_contents
from appliance.audit.log.repetition import OTHERS
from appliance.audit.search.equality import FOLDED, plain_reason, time_span, times
from appliance.audit.search.query import Filter
from appliance.audit.search.search import export
from appliance.base.varying_numbers import without_numbers

LARGEST_SUMMARY = 1000
MAX_RECORDS = 1_000_000
_PAGE = 5000
_MAX_HOSTS = 10_000
_MAX_NAMES = 256
_SHOWN_REASONS = 3
_SHOWN_CALLERS = 5
_NO_HOST = "(no host)"
_TOGETHER = "(denials of many hosts, counted together)"
_without_numbers = functools.lru_cache(1024)(without_numbers)


_Time = Annotated[str, msgspec.Meta(description="RFC 3339, UTC")]


class CountedName(msgspec.Struct, frozen=True):
    """A rule, reason or caller, and how often it occurred."""

    name: Annotated[
        str,
        msgspec.Meta(
            description="a rule with its line, the newest of reasons that differ in numbers, or a node's name"
        ),
    ]
    count: Annotated[int, msgspec.Meta(description="number of denials")]


class HostDenials(msgspec.Struct, frozen=True):
    """The denials of a host, with their most frequent rules or reasons and callers."""

    host: Annotated[str, msgspec.Meta(description="its address")]
    count: Annotated[int, msgspec.Meta(description="number of denials, with those that a record only counts")]
    first: _Time
    last: _Time
    reasons: Annotated[
        list[CountedName],
        msgspec.Meta(
            description="at most three, the most frequent first; decisions about calls before all others, such as"
            " malformed data"
        ),
    ]
    callers: Annotated[list[CountedName], msgspec.Meta(description="at most five, the most frequent first")]
    more_callers: Annotated[int, msgspec.Meta(description="number of further callers")]
    more_reasons: Annotated[int, msgspec.Meta(description="number of further reasons")] = 0


class DenialSummary(msgspec.Struct, frozen=True):
    """The denials of a period, by host; the host with the most comes first."""

    denials: Annotated[int, msgspec.Meta(description="number of denials of all hosts")]
    hosts: Annotated[list[HostDenials], msgspec.Meta(description="enrolled, awaited or declared")]
    more_hosts: Annotated[int, msgspec.Meta(description="number of hosts that are left out")]
    more_denials: Annotated[int, msgspec.Meta(description="number of their denials")]
    counted_since: Annotated[
        _Time | None,
        msgspec.Meta(
            description="only records from this time on were counted, as there are too many; else null"
        ),
    ]


@dataclass(slots=True)
class _HostCounts:
    first: int
    last: int
    count: int = 0
    decisions: Counter[str] = field(default_factory=Counter)
    """The rules and reasons of decisions about calls; `reasons` has all others."""
    reasons: Counter[str] = field(default_factory=Counter)
    texts: dict[str, str] = field(default_factory=dict)
    """The newest text of each reason without numbers."""
    callers: Counter[str] = field(default_factory=Counter)


def summary_of_log(path: Path, wanted: Filter, limit: int) -> DenialSummary:
    """Return the summary of a log, with at most `limit` hosts. Raises `LogUnreadableError` and `FilterError`."""
    denials = msgspec.structs.replace(wanted, decision=("deny",))
    return summarise(export(path, denials, _PAGE, newest_first=True), limit)


def summarise(denials: Iterable[LogEntry], limit: int) -> DenialSummary:
    hosts: dict[str, _HostCounts] = {}
    counted_since, last = None, 0
    for number, entry in enumerate(denials):
        if number == MAX_RECORDS:
            counted_since = rfc3339(last)
            break
        record = without_contents(entry).record
        last = record.time
        if _event_of(record) == "revoked":
            continue
        for host, count in _hosts_of(record):
            _count(hosts, host, count, record)
    ranked = sorted(hosts.items(), key=lambda item: (-item[1].count, item[0]))
    left = ranked[limit:]
    return DenialSummary(
        sum(counts.count for counts in hosts.values()),
        [_shown(host, counts) for host, counts in ranked[:limit]],
        len(left),
        sum(counts.count for _host, counts in left),
        counted_since,
    )


def _event_of(record: AuditRecord) -> object:
    return record.detail.get("of") if record.event in FOLDED else record.event


def _hosts_of(record: AuditRecord) -> Iterator[tuple[str, int]]:
    number = times(record)
    named = record.detail.get("hosts")
    if record.host or not isinstance(named, dict):
        yield record.host or _NO_HOST, number
        return
    for host, count in named.items():
        if type(count) is int and 0 < count <= number:
            yield host, count
            number -= count
    if number:
        yield OTHERS, number


def _count(hosts: dict[str, _HostCounts], host: str, number: int, record: AuditRecord) -> None:
    if host not in hosts and len(hosts) >= _MAX_HOSTS:
        host = OTHERS
    first, last = time_span(record)
    counts = hosts.get(host)
    if counts is None:
        counts = hosts[host] = _HostCounts(first, last)
    counts.count += number
    counts.first, counts.last = min(counts.first, first), max(counts.last, last)
    reasons = counts.decisions if _event_of(record) == "decision" else counts.reasons
    for reason, count in _reasons(record, number):
        key = _without_numbers(reason)
        _tally(reasons, key, count)
        if key in reasons:
            counts.texts.setdefault(key, reason)
    for caller, count in _callers(record, number):
        _tally(counts.callers, caller, count)


def _reasons(record: AuditRecord, number: int) -> Iterable[tuple[str, int]]:
    if record.rule is not None:
        return [(rule_text(record.rule) or "", number)]
    if record.host is None and "scope" in record.detail:
        return [(_TOGETHER, number)]
    return _tallied(record.detail.get("reasons")) or [(plain_reason(record), number)]


def _callers(record: AuditRecord, number: int) -> Iterable[tuple[str, int]]:
    if record.caller_id:
        return [(record.caller_id, number)]
    return _tallied(record.detail.get("callers")) if record.host else []


def _tallied(names: object) -> list[tuple[str, int]]:
    if not isinstance(names, dict):
        return []
    return [(name, count) for name, count in names.items() if type(count) is int]


def _tally(counts: Counter[str], name: str, number: int) -> None:
    counts[name if name in counts or len(counts) < _MAX_NAMES else OTHERS] += number


def _shown(host: str, counts: _HostCounts) -> HostDenials:
    reasons = [*counts.decisions.most_common(), *counts.reasons.most_common()]
    return HostDenials(
        host,
        counts.count,
        rfc3339(counts.first),
        rfc3339(counts.last),
        [CountedName(counts.texts.get(reason, reason), count) for reason, count in reasons[:_SHOWN_REASONS]],
        [CountedName(*one) for one in counts.callers.most_common(_SHOWN_CALLERS)],
        max(0, len(counts.callers) - _SHOWN_CALLERS),
        max(0, len(reasons) - _SHOWN_REASONS),
    )
