"""Make audit records of events in control, and block answers while the log cannot be written."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from appliance.audit.log.events import SEVERITIES
from appliance.audit.log.log import AuditLog
from appliance.audit.log.record import AuditRecord, RuleReference, Severity
from appliance.base import clock
from appliance.policy.model import Decision, Rule
from appliance.quotas.pool import QuotaClass
from appliance.telemetry.metrics import Meter

# The text for callers. Operators see the path and the error in the output, in `rosrv status`, and later in the log.
NOT_RECORDED = "the audit log cannot be written; nothing is granted until it can"


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
        self.meter.decided(category, word, taken / 1e9, "" if unknown else asker.host)
        return self.audit.record(record)

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
        return self.audit.record(
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
