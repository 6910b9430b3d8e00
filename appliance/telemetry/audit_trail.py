"""Makes audit records of what happens in control, and says when nothing may be answered because none can be made."""

import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from appliance.audit.events import SEVERITIES
from appliance.audit.log import AuditLog
from appliance.audit.record import Record, RuleReference, Severity
from appliance.policy.model import Decision, Rule
from appliance.quotas.pool import Standing
from appliance.telemetry.metrics import Meter

# What a caller is told. Where the log is and what is wrong with it is for those who operate the appliance: it is in its
# output, in `rosrv status`, and in the log itself when that can be written again.
NOT_RECORDED = "the audit log cannot be written; nothing is granted until it can"


class Asker(NamedTuple):
    """Who made a call: his host, the `caller_id` he claims, when it arrived (monotonic, nanoseconds), at which node."""

    host: str
    caller_id: str
    arrived: int
    node: str | None = None


Recordings = Callable[[str, str | None, Severity, str | None, int], dict[str, str]]
"""Return what the record of an event says of its recording: `RecordingPlan.detail`."""


class AuditTrail:
    """Records decisions and events under the running policy revision.

    `strict`: an answer waits until its record is on disk. `deny_when_failed`: while the log cannot be written,
    every request is denied. What is refused to a host that no rule names is marked (`detail.stranger`), and what a
    host beyond its share of the log causes without a call is counted, not recorded each time.
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
        """Why nothing can be granted now (the log cannot be written), or None; in words that a stranger may read."""
        if self._deny_when_failed and self._log.failed is not None:
            return NOT_RECORDED
        return None

    def shut_out(self, host: str) -> str:
        """Why this host is granted nothing while its disk is nearly full; empty when that is no reason."""
        return self._log.budget.shut_out(host)

    def owing(self, host: str) -> str:
        """Why this host must wait before more is recorded of it; empty when it need not."""
        return self._log.budget.owing(host)

    async def still_owing(self, host: str) -> str:
        """The same after the log has caught up: a record that turns out to be a repetition is not owed for."""
        if self.owing(host):
            await self._log.wait_durable()
        return self.owing(host)

    def pause(self, host: str) -> float:
        """For how many seconds this host's calls wait for that, then to be asked again; 0 when they need not."""
        return self._log.budget.pause(host)

    async def durable(self) -> str | None:
        """Wait until everything recorded so far is on disk; why not, when it cannot be and must be."""
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
        """Record a decision; the id by which it is found, if it is more than counted.

        `asked_of` is what a command is about: a parameter, a node. `reads`: the call changes nothing, so that its
        repetitions are counted when it is allowed.
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
        """Record an event that is no decision; the id, as of `decided`. `more` is detail whose names others choose.

        `severity` is for an event that has not always the same (`audit/events.py`).
        `reads`: it changed nothing, so that its repetitions are counted.
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
        """Whether this is about a stranger whom something is refused; the detail says so then."""
        stranger = (
            host is not None and decision == "deny" and self._log.budget.standing(host) is Standing.STRANGER
        )
        if stranger:
            detail["stranger"] = True
        return stranger


def rule_reference(rule: Rule | None) -> RuleReference | None:
    """The policy's rule as a record keeps it."""
    return None if rule is None else RuleReference(rule.section, rule.key, rule.file, rule.line)
