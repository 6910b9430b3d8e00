"""Whether the times of the records can be believed: for status, metrics, and the log itself. It blocks nothing.

Four things are looked at: whether a time service keeps the machine's clock (the supervisor tells), whether the clock
stands before the last record of the log, which it does after it was set back, also while the appliance was off,
whether it went further than time has passed, and whether it stands before this program was made.
"""

import asyncio
import time
from collections.abc import Callable

from appliance.base.shipped import before_program
from appliance.channel.answers.status import ClockState
from appliance.telemetry.audit_trail import AuditTrail

_LOOK_SECONDS = 10.0
_STEP_SECONDS = 2.0  # less is what a time service mends


class Clock:
    """Records each change once. `behind()` is how many seconds the clock stands before the last record; else 0."""

    def __init__(
        self,
        trail: AuditTrail,
        behind: Callable[[], float],
        started: Callable[[], float] = lambda: time.time() - time.clock_gettime(time.CLOCK_BOOTTIME),
    ) -> None:
        """`started()` is when the machine was started, by its clock as it is now (seconds since the epoch)."""
        self._trail = trail
        self._behind = behind
        self._synchronised: bool | None = None
        self._set_back = False
        self._started = started
        self._seen = started()

    def told(self, synchronised: bool | None) -> None:
        """What the supervisor sees now; None: it cannot."""
        before, self._synchronised = self._synchronised, synchronised
        if synchronised is False and before is not False:
            self._trail.happened(
                "clock not synchronised",
                "no time service keeps the machine's clock: run chrony or systemd-timesyncd",
            )
        elif synchronised and before is False:
            text = "a time service keeps the machine's clock again"
            self._trail.happened("clock synchronised", text)

    def state(self) -> ClockState:
        """As it is now."""
        behind = self._behind()
        return ClockState(self._synchronised, behind if behind > _STEP_SECONDS else 0.0, before_program())

    async def watch(self) -> None:
        """Look every ten seconds whether it was set."""
        while True:
            self.look()
            await asyncio.sleep(_LOOK_SECONDS)

    def look(self) -> None:
        """Record each step forward, and once that it was set back; it may be again when it has caught up."""
        before, self._seen = self._seen, self._started()
        ahead = self._seen - before
        if ahead > _STEP_SECONDS:
            self._trail.happened(
                "clock set forward",
                f"the machine's clock went {ahead:.0f} s further than time has passed; that of monitors did not",
                seconds=round(ahead, 3),
            )
        behind = self.state().behind_seconds
        if behind and not self._set_back:
            self._trail.happened(
                "clock set back",
                f"the machine's clock stands {behind:.0f} s before the last record; ids and sequence go on",
                seconds=round(behind, 3),
            )
        self._set_back = behind > 0
