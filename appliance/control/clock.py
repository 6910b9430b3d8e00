"""Whether the times of the records can be believed: for status, metrics, and the log itself. It blocks nothing.

Two things are looked at: whether a time service keeps the machine's clock (the supervisor tells), and whether the clock
stands before the last record of the log, which it does after it was set back, also while the appliance was off.
"""

import asyncio
from collections.abc import Callable

from appliance.audit.record import Severity
from appliance.audit_trail import AuditTrail
from appliance.channel.answers.status import ClockState

_LOOK_SECONDS = 10.0
_STEP_SECONDS = 2.0  # less is what a time service mends


class Clock:
    """Records each change once. `behind()` is how many seconds the clock stands before the last record; else 0."""

    def __init__(self, trail: AuditTrail, behind: Callable[[], float]) -> None:
        self._trail = trail
        self._behind = behind
        self._synchronised: bool | None = None
        self._set_back = False

    def told(self, synchronised: bool | None) -> None:
        """What the supervisor sees now; None: it cannot."""
        before, self._synchronised = self._synchronised, synchronised
        if synchronised is False and before is not False:
            self._trail.happened(
                "clock not synchronised",
                "no time service keeps the machine's clock: run chrony or systemd-timesyncd",
                severity=Severity.NOTICE,
            )
        elif synchronised and before is False:
            text = "a time service keeps the machine's clock again"
            self._trail.happened("clock synchronised", text, severity=Severity.NOTICE)

    def state(self) -> ClockState:
        """As it is now."""
        behind = self._behind()
        return ClockState(self._synchronised, behind if behind > _STEP_SECONDS else 0.0)

    async def watch(self) -> None:
        """Look every ten seconds whether it was set back."""
        while True:
            self.look()
            await asyncio.sleep(_LOOK_SECONDS)

    def look(self) -> None:
        """Record it, once, when the clock was set back; it may be again when it has caught up."""
        behind = self.state().behind_seconds
        if behind and not self._set_back:
            self._trail.happened(
                "clock set back",
                f"the machine's clock stands {behind:.0f} s before the last record; ids and sequence go on",
                severity=Severity.WARNING,
                seconds=round(behind, 3),
            )
        self._set_back = behind > 0
