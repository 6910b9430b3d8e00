"""Check whether the times of audit records are credible, for status, metrics and the log. Nothing is blocked.

It reports a clock that no time service synchronises, that is behind the last record or the date of this program's
files, or that advanced by more than the elapsed time.
"""

import asyncio
from collections.abc import Callable

from appliance.base import clock
from appliance.base.shipped import before_program
from appliance.channel.answers.status import ClockState
from appliance.telemetry.audit_trail import AuditTrail

_LOOK_SECONDS = 10.0
_STEP_SECONDS = 2.0  # smaller steps are normal corrections of a time service


class ClockCheck:
    """Checks the clock, and records each change once. `behind()` returns seconds behind the last record."""

    def __init__(
        self,
        trail: AuditTrail,
        behind: Callable[[], float],
        started: Callable[[], float] = lambda: clock.wall() - clock.since_boot(),
        stepped: Callable[[], object] = lambda: None,
    ) -> None:
        """`stepped()` is called soon after each step of the clock: timers do not notice that a date has come."""
        self._trail = trail
        self._behind = behind
        self._synchronised: bool | None = None
        self._set_back = False
        self._started = started
        self._stepped = stepped
        self._seen = started()

    def synchronisation_reported(self, synchronised: bool | None) -> None:
        before, self._synchronised = self._synchronised, synchronised
        if synchronised is False and before is not False:
            self._trail.happened(
                "clock not synchronised",
                "no time service synchronises the machine's clock: run chrony or systemd-timesyncd",
            )
        elif synchronised and before is False:
            text = "a time service synchronises the machine's clock again"
            self._trail.happened("clock synchronised", text)

    def state(self) -> ClockState:
        behind = self._behind()
        return ClockState(self._synchronised, behind if behind > _STEP_SECONDS else 0.0, before_program())

    async def watch(self) -> None:
        while True:
            self.look()
            await asyncio.sleep(_LOOK_SECONDS)

    def look(self) -> None:
        """Record steps of the clock, but a step back only once, until the clock catches up with the last record."""
        before, self._seen = self._seen, self._started()
        ahead = self._seen - before
        if abs(ahead) > _STEP_SECONDS:
            self._stepped()
        if ahead > _STEP_SECONDS:
            self._trail.happened(
                "clock set forward",
                f"the machine's clock advanced {ahead:.0f} s more than the time that passed;"
                " the clock of monitors did not",
                seconds=round(ahead, 3),
            )
        behind = self.state().behind_seconds
        if behind and not self._set_back:
            self._trail.happened(
                "clock set back",
                f"the machine's clock is {behind:.0f} s behind the last record; ids and sequence still increase",
                seconds=round(behind, 3),
            )
        self._set_back = behind > 0

    def cut_short(self, kind: str, name: str, seconds: float) -> None:
        """Record that the clock ended a thing before the time that the appliance counted."""
        self._trail.happened(
            "ended by the clock",
            f"{kind} {name} has ended, and the appliance has counted {seconds:.0f} s less: the machine's clock was set,"
            " or the appliance was off",
            resource=name,
            kind=kind,
            seconds=round(seconds, 3),
        )
