"""Build the part of control for evidence."""

import asyncio

from appliance.audit.log.log import AuditLog
from appliance.base.counted import counted
from appliance.control.core import ControlPart, Core
from appliance.control.errors import UnavailableError
from appliance.control.operators.request_method import RequestMethod
from appliance.features.evidence.requests import EvidenceExported, LogSealed, Sealed
from appliance.telemetry.audit_trail import AuditTrail

# Answer the requests of an evidence export: seal the log now, and record the bundle's hash.

SEAL_SECONDS = 10.0


class NotSealedError(UnavailableError):
    """The log's newest records cannot be sealed now."""


class EvidenceOrders:
    """The requests of an evidence export. Methods raise `NotSealedError`."""

    def __init__(self, log: AuditLog, trail: AuditTrail, robot: str = "") -> None:
        self._log = log
        self._trail = trail
        self._robot = {"robot": robot} if robot else {}

    async def seal(self, _request: LogSealed) -> Sealed:
        await self._seal()
        return Sealed()

    async def exported(self, request: EvidenceExported, who: str) -> Sealed:
        record = self._trail.happened(
            "evidence exported",
            f"{counted(request.records, 'record was', 'records were')} exported as evidence",
            who=who,
            manifest=request.manifest,
            since=request.since,
            until=request.until,
            records=request.records,
            recording=request.recording,
            more=self._robot,
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
                f"the newest records cannot be sealed, so nothing would prove them: {reason}"
            )


async def begin(core: Core) -> ControlPart:
    orders = EvidenceOrders(core.trail.audit, core.trail, core.settings.name)
    return ControlPart(
        (
            RequestMethod(LogSealed, orders.seal),
            RequestMethod(EvidenceExported, orders.exported, who=True),
        )
    )
