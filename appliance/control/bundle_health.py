"""Compare the robot's health before and after a change: denials, monitors, processes."""

from collections.abc import Sequence
from typing import NamedTuple, Self

from appliance.channel.answers.status import MinuteState, ProcessInfo
from appliance.control.monitor_states import monitors_status
from appliance.specifications.specification_manager import SpecificationManager
from appliance.telemetry.metrics import Meter

_MORE_OFTEN = 3  # a change may not make denials this many times as frequent
_ATTENTION_AT = MinuteState(0, {}).attention_at


class RobotHealth(NamedTuple):
    """The denials of the last minute, the monitors that fail or hold topics, and the processes that keep ending."""

    denials: int
    failing: frozenset[str]
    processes: frozenset[str]
    rejected: tuple[str, ...] = ()  # why relays reject the specifications in force

    @classmethod
    def of(cls, meter: Meter, monitors: SpecificationManager, processes: Sequence[ProcessInfo]) -> Self:
        """Return the present health."""
        state = monitors_status(monitors)
        return cls(
            sum(meter.denied.counts().values()),
            frozenset([*state.failing, *state.held]),
            frozenset(process.role for process in processes if process.failing),
            tuple(state.refused),
        )

    def worse_than(self, before: "RobotHealth") -> str:
        """Return why the robot is less healthy than before; empty if it is not."""
        most = max(_MORE_OFTEN * before.denials, _ATTENTION_AT)
        if self.rejected and not before.rejected:
            return f"a relay rejects the specifications: {self.rejected[0]}"
        if self.failing - before.failing:
            return f"monitors fail or hold their topics: {', '.join(sorted(self.failing - before.failing))}"
        if self.processes - before.processes:
            return f"processes keep ending: {', '.join(sorted(self.processes - before.processes))}"
        if self.denials > most:
            return (
                f"{self.denials} denials in the last minute, {before.denials} in the minute before the change"
            )
        return ""
