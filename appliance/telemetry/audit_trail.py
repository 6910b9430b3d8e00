"""Make audit records of events in control, count them, and block answers while the log cannot be written.

Counting costs a few additions per request and no formatting.
"""

import bisect
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from appliance.audit.log.events import SEVERITIES
from appliance.audit.log.log import AuditLog
from appliance.audit.log.record import AuditRecord, RuleReference, Severity
from appliance.audit.log.repetition import repetitions
from appliance.base import clock
from appliance.base.counted import counted
from appliance.base.metric import BOUNDS
from appliance.policy.model import Decision, Rule
from appliance.quotas.pool import QuotaClass

# The text for callers. Operators see the path and the error in the output, in `rosrv status`, and later in the log.
NOT_RECORDED = "the audit log cannot be written; nothing is granted until it can"

_SECONDS = 60
MAX_REQUESTS = 64
_LONGEST_RESOURCE = 200
_NO_ADDRESS = "a caller without an address"
_REST = "rest"
OTHERS = "other"
"""The category of denials that have none, such as a connection without a request."""


class LastMinute:
    """Counts of the last 60 seconds, one for each second and name; `clock` returns seconds and is never set back.

    The caller limits the number of names, or gives the `most` names in a second; others are then left out.
    """

    def __init__(self, clock: Callable[[], float] = clock.now, most: int | None = None) -> None:
        self._clock = clock
        self._most = most
        self._seconds: deque[tuple[int, Counter[str]]] = deque(maxlen=_SECONDS)

    def add(self, name: str, number: int = 1) -> None:
        second = int(self._clock())
        if not self._seconds or self._seconds[-1][0] != second:
            self._seconds.append((second, Counter()))
        counts = self._seconds[-1][1]
        if self._most is None or name in counts or len(counts) < self._most:
            counts[name] += number

    def counts(self) -> dict[str, int]:
        """Return the counts, without names that had no event."""
        oldest = int(self._clock()) - _SECONDS
        total: Counter[str] = Counter()
        for second, counts in self._seconds:
            if second > oldest:
                total.update(counts)
        return dict(total)


@dataclass(slots=True)
class Histogram:
    """Durations by upper bound; the last entry of `counts` is for those above all `BOUNDS`."""

    counts: list[int] = field(default_factory=lambda: [0] * (len(BOUNDS) + 1))
    sum: float = 0.0

    def observe(self, seconds: float) -> None:
        self.counts[bisect.bisect_left(BOUNDS, seconds)] += 1
        self.sum += seconds

    def values(self) -> tuple[list[int], float]:
        return self.counts, self.sum


class Meter:
    """The counters of RVMaster's events since its start, and of the last minute.

    `denied` has the denied requests, and `denied_requests` each with its host, of at most `MAX_REQUESTS` in a second. A
    right that ended is neither: no request was denied. `denied_hosts` has both, of nodes: those of unknown hosts
    together, as "".
    """

    def __init__(self) -> None:
        self.decisions: Counter[tuple[str, str]] = Counter()
        self.decision_seconds = Histogram()
        self.calls: dict[str, Histogram] = {}
        self.denied = LastMinute()
        self.denied_hosts = LastMinute()
        self.denied_requests = LastMinute(most=MAX_REQUESTS)
        self.dropped = LastMinute()

    def count_record(self, record: AuditRecord) -> None:
        """Count the decision of a record. `AuditTrail` calls this for every record, so that none is left out."""
        if record.decision is None or (record.decision == "allow" and record.event != "decision"):
            return  # not a decision of the policy, such as a call of REST
        number, category = repetitions(record.detail), record.category or OTHERS
        self.decisions[category, record.decision] += number
        if record.decision == "deny":
            if category != _REST:  # not of a node
                self.denied_hosts.add("" if record.unknown else record.host or "", number)
            if record.event == "revoked":
                return
            self.denied.add(category, number)
            asked = f"{category} {(record.resource or '')[:_LONGEST_RESOURCE]}".rstrip()
            self.denied_requests.add(f"{record.host or _NO_ADDRESS}\n{asked}", number)

    def most_denied(self, in_words: Callable[[str], str] = str) -> str:
        """Return in words which host was denied most in the last minute, and what; "" if none was.

        `in_words` returns an address with its name.
        """
        hosts, requests = Counter[str](), dict[str, Counter[str]]()
        for name, number in self.denied_requests.counts().items():
            host, _, asked = name.partition("\n")
            hosts[host] += number
            requests.setdefault(host, Counter())[asked] += number
        for host, number in hosts.most_common(1):
            ((asked, _times),) = requests[host].most_common(1)
            more = " and more" if len(requests[host]) > 1 else ""
            return f"{in_words(host)} was denied {asked}{more}, {counted(number, 'time')}"
        return ""

    def count_call(self, call: str, seconds: float) -> None:
        """Count a call; `call` is a name of the call table, never text from a client."""
        histogram = self.calls.get(call)
        if histogram is None:
            histogram = self.calls[call] = Histogram()
        histogram.observe(seconds)


class Asker(NamedTuple):
    """A caller, with the arrival time of its call (monotonic ns) and the target node."""

    host: str
    caller_id: str
    arrived: int
    node: str | None = None


_ORDINARY = frozenset({Severity.DEBUG, Severity.INFO})

RecordDetails = Callable[[str, str | None, Severity, str | None, int], dict[str, str]]
"""Returns what features add to the details of a record, by event, decision, severity, host and time.

Only denials and records above info have such details, so an allowed call runs no code of a feature.
"""


class AuditTrail:
    """The writer of decisions and events under the running policy revision.

    `strict`: an answer waits until its record is on disk. `deny_when_failed`: every request is denied while the
    log cannot be written. While a host exceeds its log quota, its events without a decision are only counted.
    """

    def __init__(self, log: AuditLog, *, strict: bool, deny_when_failed: bool) -> None:
        self.audit = log
        self._ids = log.ids
        self.strict = strict
        self._deny_when_failed = deny_when_failed
        self._details: list[RecordDetails] = []
        self.revision = 0
        self.meter = Meter()

    def add_details(self, details: RecordDetails) -> None:
        self._details.append(details)

    @property
    def obstacle(self) -> str | None:
        """Return why nothing can be granted now; the text is safe to show to unknown hosts."""
        if self._deny_when_failed and self.audit.failed is not None:
            return NOT_RECORDED
        return None

    def shut_out(self, host: str) -> str:
        return self.audit.budget.shut_out(host)

    def owing(self, host: str) -> str:
        return self.audit.budget.owing(host)

    async def still_owing(self, host: str) -> str:
        if self.owing(host):
            await self.audit.wait_durable()
        return self.owing(host)

    def pause(self, host: str) -> float:
        return self.audit.budget.pause(host)

    async def durable(self) -> str | None:
        """Return None once all records so far are on disk, or, with `deny_when_failed`, the reason why they are
        not.
        """
        failure = await self.audit.wait_durable()
        return failure if self._deny_when_failed else None

    def decided(
        self,
        asker: Asker,
        method: str,
        category: str,
        resource: str,
        decision: Decision,
        *,
        reads: bool = False,
        **asked_of: str,
    ) -> str:
        """Record a decision; return the record's id. If the decision is only counted, no record has this id.

        `asked_of` names the object of a command. `reads`: repetitions of an allowed call are only counted.
        """
        word = decision.word
        detail: dict[str, object] = {"call": method, **asked_of}
        if asker.node is not None:
            detail["node"] = asker.node
        if decision.needs:
            detail["needs"] = decision.needs
        if decision.asks is not None:
            detail["approval"] = f"{decision.asks.category} {decision.asks.resource}"
        now, taken = clock.wall_ns(), clock.now_ns() - asker.arrived
        severity = Severity.INFO if decision.allowed and not decision.would_deny else Severity.WARNING
        for details in self._completing(word, severity):
            detail |= details("decision", word, severity, asker.host, now)
        unknown = self._marked(asker.host, word, detail)
        record = AuditRecord(
            id=self._ids.next(),
            time=now,
            event="decision",
            severity=severity,
            decision=word,
            host=asker.host,
            caller_id=asker.caller_id,
            category=category,
            resource=resource,
            rule=rule_reference(decision.rule),
            revision=self.revision,
            reason=decision.reason,
            duration_us=taken // 1000,
            unknown=unknown,
            detail=detail,
            folds=reads and word == "allow",
        )
        self.meter.decision_seconds.observe(taken / 1e9)
        return self._record(record)

    def happened(
        self,
        event: str,
        reason: str,
        *,
        severity: Severity | None = None,
        host: str | None = None,
        caller_id: str | None = None,
        category: str | None = None,
        resource: str | None = None,
        rule: Rule | None = None,
        decision: str | None = None,
        more: Mapping[str, object] | None = None,
        reads: bool = False,
        whole: bool = False,
        **detail: object,
    ) -> str:
        """Record an event; return the record's id.

        `reads`: repetitions are only counted. `whole`: every record is kept, even if the host is beyond its quota.
        """
        now, severity = clock.wall_ns(), severity or SEVERITIES.get(event, Severity.INFO)
        detail = {**(more or {}), **detail}
        for details in self._completing(decision, severity):
            detail |= details(event, decision, severity, host, now)
        unknown = self._marked(host, decision, detail)
        return self._record(
            AuditRecord(
                id=self._ids.next(),
                time=now,
                event=event,
                severity=severity,
                decision=decision,
                host=host,
                caller_id=caller_id,
                category=category,
                resource=resource,
                rule=rule_reference(rule),
                revision=self.revision,
                reason=reason,
                detail=detail,
                unknown=unknown,
                folds=reads or not (whole or decision or host is None or not self.owing(host)),
            )
        )

    def _record(self, record: AuditRecord) -> str:
        self.meter.count_record(record)
        return self.audit.record(record)

    def _completing(self, decision: str | None, severity: Severity) -> Sequence[RecordDetails]:
        return self._details if decision == "deny" or severity not in _ORDINARY else ()

    def _marked(self, host: str | None, decision: str | None, detail: dict[str, object]) -> bool:
        if (
            host is None
            or decision != "deny"
            or self.audit.budget.quota_class(host) is not QuotaClass.UNKNOWN
        ):
            return False
        detail["unknown_host"] = True
        return True


def rule_reference(rule: Rule | None) -> RuleReference | None:
    return None if rule is None else RuleReference(rule.section, rule.key, rule.file, rule.line)
