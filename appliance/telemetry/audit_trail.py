"""Make audit records of events in control, and block answers while no record can be made."""

import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from appliance.audit.events import SEVERITIES
from appliance.audit.log import AuditLog
from appliance.audit.record import Record, RuleReference, Severity
from appliance.policy.model import Decision, Rule
from appliance.quotas.pool import Standing
from appliance.telemetry.metrics import Meter

# The text for callers. Operators find the path and the error in the output, in `rosrv status`, and later in the log.
NOT_RECORDED = "the audit log cannot be written; nothing is granted until it can"


class Asker(NamedTuple):
    """Describe a caller: host, claimed `caller_id`, arrival of the call (monotonic ns), and the target node."""

    host: str
    caller_id: str
    arrived: int
    node: str | None = None


Recordings = Callable[[str, str | None, Severity, str | None, int], dict[str, str]]
"""Return the details of an event's recording for its record, as `RecordingPlan.detail`."""


class AuditTrail:
    """Records decisions and events under the running policy revision.

    `strict`: an answer waits until its record is on disk. `deny_when_failed`: every request is denied while the log
    cannot be written. Denials of unknown hosts are marked (`detail.stranger`). Events that a host beyond its quota of
    the log causes without a call are only counted.
    """

    def __init__(
        self, log: AuditLog, *, strict: bool, deny_when_failed: bool, recordings: Recordings
    ) -> None:
        self._log = log
        self._ids = log.ids
        self.strict = strict
        self._deny_when_failed = deny_when_failed
        self._recordings = recordings
        self.revision = 0
        self.meter = Meter()

    @property
    def obstacle(self) -> str | None:
        """Return why nothing can be granted now (the log cannot be written), or None; safe to show to unknown hosts."""
        if self._deny_when_failed and self._log.failed is not None:
            return NOT_RECORDED
        return None

    def shut_out(self, host: str) -> str:
        """Return why a nearly full disk blocks this host; empty if it does not."""
        return self._log.budget.shut_out(host)

    def owing(self, host: str) -> str:
        """Return why this host must wait before its next record; empty if it need not."""
        return self._log.budget.owing(host)

    async def still_owing(self, host: str) -> str:
        """Return `owing` after the log has caught up; repetitions then no longer count."""
        if self.owing(host):
            await self._log.wait_durable()
        return self.owing(host)

    def pause(self, host: str) -> float:
        """Return the seconds for which calls of this host wait before the next check; 0 if they need not."""
        return self._log.budget.pause(host)

    async def durable(self) -> str | None:
        """Wait until all records so far are on disk. Return the reason if they must be and cannot."""
        failure = await self._log.wait_durable()
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
        """Record a decision, and return the id of its record, which exists unless the decision is only counted.

        `asked_of` is the object of a command: a parameter, a node. `reads`: the call changes nothing, so repetitions
        are only counted if it is allowed.
        """
        word = decision.word
        detail: dict[str, Any] = {"call": method, **asked_of}
        if asker.node is not None:
            detail["node"] = asker.node
        if decision.needs:
            detail["needs"] = decision.needs
        now = time.time_ns()
        severity = Severity.INFO if decision.allowed and not decision.would_deny else Severity.WARNING
        detail |= self._recordings("decision", word, severity, asker.host, now)
        record = Record(
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
            duration_us=(time.monotonic_ns() - asker.arrived) // 1000,
            stranger=self._marked(asker.host, word, detail),
            detail=detail,
            folds=reads and word == "allow",
        )
        self.meter.decided(category, word, (time.monotonic_ns() - asker.arrived) / 1e9)
        return self._log.record(record)

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
        more: Mapping[str, Any] | None = None,
        reads: bool = False,
        **detail: Any,
    ) -> str:
        """Record an event that is not a decision; return the id as `decided` does. `more` has further details.

        `severity` is for an event of varying severity (`audit/events.py`).
        `reads`: the event changed nothing, so repetitions are only counted.
        """
        now, severity = time.time_ns(), severity or SEVERITIES.get(event, Severity.INFO)
        detail = {**(more or {}), **detail, **self._recordings(event, decision, severity, host, now)}
        stranger = self._marked(host, decision, detail)
        return self._log.record(
            Record(
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
                stranger=stranger,
                folds=reads or (decision is None and host is not None and bool(self.owing(host))),
            )
        )

    def _marked(self, host: str | None, decision: str | None, detail: dict[str, Any]) -> bool:
        """Whether this denies an unknown host; if so, mark the detail."""
        stranger = (
            host is not None and decision == "deny" and self._log.budget.standing(host) is Standing.STRANGER
        )
        if stranger:
            detail["stranger"] = True
        return stranger


def rule_reference(rule: Rule | None) -> RuleReference | None:
    """Return the policy's rule in the form of a record."""
    return None if rule is None else RuleReference(rule.section, rule.key, rule.file, rule.line)
