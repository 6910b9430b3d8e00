"""Check on a standby that control could start if this appliance took over now, and would not give the lease away.

The check also writes to the disk of the state and to the audit log, and compiles the specifications, so that a
takeover need not. It is repeated, because the appliance's own files, disk and ports may change. While it fails, this
appliance does not claim the lease, but still follows the active one and stays in the in-sync set.
"""

import asyncio
import contextlib
from collections.abc import Callable

import structlog

from appliance.configuration.settings import Settings
from appliance.control.assembly.active_role import STATE_ERRORS
from appliance.control.start_rehearsal import StartRehearsal
from appliance.features.standby.link_certificates import replication_context
from appliance.features.standby.membership import Membership
from appliance.features.standby.summary import UNCHECKED
from appliance.specifications.rollout import Parts
from appliance.specifications.specification_revisions import Check

_AGAIN_SECONDS = 15.0

_log = structlog.get_logger()


class TakeoverCheck:
    """The check; set `news` when the policy or the specifications of the active appliance have changed."""

    def __init__(
        self,
        settings: Settings,
        membership: Membership,
        compile_specifications: Check,
        parts: Parts,
        *,
        again: float = _AGAIN_SECONDS,
    ) -> None:
        self._membership = membership
        self._rehearsal = StartRehearsal(settings, compile_specifications, parts, robot=membership.witness)
        self._again = again
        self.obstacle = UNCHECKED
        self.news = asyncio.Event()

    async def run(self, changed: Callable[[], None]) -> None:
        while True:
            self.news.clear()
            obstacle = await self._find_obstacle()
            if obstacle != self.obstacle:
                if self.obstacle not in ("", UNCHECKED):
                    _log.info("the reason why this appliance cannot take over is gone", reason=self.obstacle)
                self.obstacle = obstacle
                changed()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(self._again):
                    await self.news.wait()

    async def _find_obstacle(self) -> str:
        try:
            await self._load()
        except STATE_ERRORS as error:
            reason, *more = str(error).splitlines() or [repr(error)]
        except Exception as error:  # noqa: BLE001  whatever it is, it would also end the start
            what = f"the state of the active appliance is not understood ({error!r})"
            reason, more = f"{what}; update this appliance to the same version", []
        else:
            return ""
        if reason != self.obstacle:
            _log.error("this appliance cannot take over", reason=reason, more=more)
        return reason

    async def _load(self) -> None:
        await self._rehearsal.run()
        if self.obstacle != "":  # the membership stays the same, and each call writes files
            replication_context(self._membership, self._rehearsal.folder, server=True)
