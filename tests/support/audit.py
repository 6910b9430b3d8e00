import asyncio
from typing import Any

from appliance.audit.log.log import AuditLog
from appliance.audit.log.record import AuditRecord, RuleReference
from appliance.base import clock
from appliance.telemetry.audit_trail import AuditTrail
from tests.support.engines import let_pass


class RecordingTrail(AuditTrail):
    def __init__(self, log: AuditLog) -> None:
        super().__init__(log, strict=False, deny_when_failed=False)
        self.heard: list[tuple[str, dict[str, Any]]] = []

    def happened(self, event: str, reason: str, **fields: Any) -> str:
        self.heard.append((event, {"reason": reason, **fields}))
        return super().happened(event, reason, **fields)


def decision(log: AuditLog, number: int = 0, **changes: Any) -> AuditRecord:
    fields: dict[str, Any] = {
        "id": log.ids.next(),
        "time": clock.wall_ns(),
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
    return AuditRecord(**fields | changes)


def settle(log: AuditLog, seconds: float = 0.0) -> str | None:
    """Wait until all records are on the disk, or return the reason if they cannot be written.

    For some `seconds`, virtual time passes: a log that failed to write tries again after half a second.
    """

    async def settled() -> str | None:
        waiting = asyncio.ensure_future(log.wait_durable())
        await asyncio.sleep(0)
        if seconds:
            let_pass(log, seconds)
        return await asyncio.wait_for(waiting, 60)

    return asyncio.run(settled())
