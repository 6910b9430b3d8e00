"""Histories of two appliances that do not serve whenever they are active, both for the same reason."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

from appliance.audit.log.log import AuditLog
from appliance.control import start_rehearsal
from appliance.control.assembly.listener_limits import Answering
from appliance.features.standby import requests as standby_requests
from tests.world.appliance import Appliance
from tests.world.loop import BrokenPromiseError, present_process
from tests.world.pair import PairWorld

_AGAIN_SECONDS = 0.05  # sooner than a control is ready
_WHOLE_SECONDS, _HARMED_SECONDS, _MAX_TAKEOVERS = (
    30.0,
    585.0,
    2,
)  # ten minutes by a clock that runs 1 % faster are 594
_FULL, _FREE = 3 << 20, 20 << 20


class UnableWorld(PairWorld):
    """`reason` is the name of a method that harms an active appliance, again and again."""

    reason: str

    def __init__(self, seed: int, folder: Path, say: Callable[[str], object]) -> None:
        super().__init__(seed, folder, say)
        self.harmed = False
        self.taken_over = 0

    def activated(self, appliance: Appliance, epoch: int) -> None:
        super().activated(appliance, epoch)
        self.taken_over += self.harmed

    async def run(self) -> None:
        self.start()
        disk = SimpleNamespace(statvfs=self._statvfs)
        works: Any = AuditLog.failed
        failed = property(lambda log: "it is away" if self._fails("log") else works.fget(log))
        overdue = lambda _calls: 60.0 if self._fails("calls") else 0.0  # noqa: E731  as the two above
        with (
            patch.object(start_rehearsal, "os", disk),
            patch.object(AuditLog, "failed", failed),
            patch.object(Answering, "overdue", overdue),
        ):
            await self.passes(_WHOLE_SECONDS)
            self.harmed = True
            self._harm()
            await self.passes(_HARMED_SECONDS)
            await self._says()
            self.harmed = False
            for appliance in self.appliances:
                appliance.restart_relay()
                appliance.kill_control()
            await self.passes(self.settles)
        if not 0 < self.taken_over <= _MAX_TAKEOVERS:
            raise BrokenPromiseError(f"{self.taken_over} takeovers in {_HARMED_SECONDS:g} s")
        await self.settled()

    async def _says(self) -> None:
        """The standby reports that the active appliance does not serve: that one perhaps answers no call."""
        [standby] = [appliance for appliance in self.appliances if not appliance.active]
        administration, _process = standby.admin.administration  # type: ignore[attr-defined]  # as `_AdminServer` sets it
        answer: Any = await administration.carry_out(standby_requests.StandbyWanted(), who="operator")
        if "keeps the lease" not in answer.body.not_serving:
            raise BrokenPromiseError(f"the standby does not report it: {answer}")

    def _harm(self) -> None:
        if self.harmed:
            for appliance in self.appliances:
                if appliance.active:
                    getattr(self, self.reason)(appliance)
            self.loop.outside.call(_AGAIN_SECONDS, self._harm)

    def _fails(self, reason: str) -> bool:
        here = present_process().machine.name
        return (
            self.reason == reason
            and self.harmed
            and any(appliance.active for appliance in self.appliances if appliance.address == here)
        )

    def _statvfs(self, _folder: Path) -> SimpleNamespace:
        return SimpleNamespace(f_bavail=_FULL if self._fails("disk") else _FREE, f_frsize=1)

    # --- the reasons ---

    def disk(self, appliance: Appliance) -> None:
        """An active appliance has too little room, and enough again as the standby."""

    def log(self, appliance: Appliance) -> None:
        """An active appliance cannot write its log."""

    def calls(self, appliance: Appliance) -> None:
        """An active appliance reports, and answers no calls."""

    def silent(self, appliance: Appliance) -> None:
        if appliance.ready and appliance.control is not None:
            appliance.control.paused = True

    def unready(self, appliance: Appliance) -> None:
        if appliance.control is not None:
            appliance.control.paused = True

    def died(self, appliance: Appliance) -> None:
        if appliance.ready:
            appliance.kill_control()
        else:
            self.unready(appliance)

    def relays(self, appliance: Appliance) -> None:
        appliance.relay.process.kill()


REASONS = ("disk", "log", "calls", "silent", "unready", "died", "relays")
