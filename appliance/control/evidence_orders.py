"""What is asked when evidence is exported: that the log is sealed now, and that it has the bundle's hash."""

import asyncio

from appliance.audit.log import AuditLog
from appliance.channel import admin
from appliance.channel.answers.evidence_answers import Sealed
from appliance.telemetry.audit_trail import AuditTrail

SEAL_SECONDS = 10.0


class NotSealedError(Exception):
    """The log's newest records cannot be sealed now; the text says why."""


class EvidenceOrders:
    """Each method answers the request that it takes. They raise `NotSealedError`."""

    def __init__(self, log: AuditLog, trail: AuditTrail) -> None:
        self._log = log
        self._trail = trail

    async def seal(self, _request: admin.LogSealed) -> Sealed:
        """A signed checkpoint over all that was recorded."""
        await self._seal()
        return Sealed()

    async def exported(self, request: admin.EvidenceExported, who: str) -> Sealed:
        """Record a bundle that was made, under a signed checkpoint."""
        record = self._trail.happened(
            "evidence exported",
            f"{request.records} records were exported as evidence",
            who=who,
            manifest=request.manifest,
            since=request.since,
            until=request.until,
            records=request.records,
            recording=request.recording,
        )
        await self._seal()
        return Sealed(record)

    async def _seal(self) -> None:
        try:
            async with asyncio.timeout(SEAL_SECONDS):
                reason = await self._log.wait_signed()
        except TimeoutError:
            why = self._log.failed or self._log.degraded or "see `rosrv status`"
            reason = f"the signer has not answered within {SEAL_SECONDS:g} s ({why})"
        if reason is not None:
            raise NotSealedError(
                f"the newest records cannot be sealed, so that nothing would prove them: {reason}"
            )
