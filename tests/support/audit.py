"""Records for tests of the audit log, and waiting for them to be on disk."""

import asyncio
import time
from typing import Any

from appliance.audit.log import AuditLog
from appliance.audit.record import Record, RuleReference
from appliance.telemetry.audit_trail import AuditTrail


class HeardTrail(AuditTrail):
    """A trail that keeps what happened where a test finds it: (event, its reason and other fields)."""

    def __init__(self, log: AuditLog) -> None:
        super().__init__(log, strict=False, deny_when_failed=False, recordings=lambda *_: {})
        self.heard: list[tuple[str, dict[str, Any]]] = []

    def happened(self, event: str, reason: str, **fields: Any) -> str:
        """As `AuditTrail`."""
        self.heard.append((event, {"reason": reason, **fields}))
        return super().happened(event, reason, **fields)


def decision(log: AuditLog, number: int = 0, **changes: Any) -> Record:
    """A decision of RVMaster; `changes` replace fields."""
    fields: dict[str, Any] = {
        "id": log.ids.next(),
        "time": time.time_ns(),
        "event": "decision",
        "decision": "allow",
        "host": f"10.0.0.{number % 5}",
        "caller_id": f"/node{number % 50}",
        "category": "publish",
        "resource": f"/cmd_{number % 20}",
        "rule": RuleReference("Publishers", "/cmd_*", "robot.ini", 12),
        "revision": 3,
        "reason": "[Publishers] /cmd_* lets it",
        "duration_us": 40,
        "detail": {"call": "registerPublisher"},
    }
    return Record(**fields | changes)


def settle(log: AuditLog) -> str | None:
    """Wait until everything recorded is on disk; the reason if it cannot be."""
    return asyncio.run(asyncio.wait_for(log.wait_durable(), 60))
