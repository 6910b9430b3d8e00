"""Count the unreported actions of the fast path until the second is over."""

from __future__ import annotations

from typing import TYPE_CHECKING

from appliance.relay.monitors.observation_points import ObservationPoint
from appliance.relay.transport.pump import ModuleCall

if TYPE_CHECKING:
    from rosmop.run.fast_path import BatchResult, FastLane


_Count = tuple[int, int, int]
"""How often something occurred, and the times of the first and the last occurrence (nanoseconds)."""

_NONE: _Count = (0, 0, 0)


class FastPathCounts:
    """The counts of the fast path at one point since they were last taken."""

    def __init__(self, lane: FastLane, point: ObservationPoint) -> None:
        self.lane = lane
        self.point = point
        self.begun = False
        """Whether the observer will collect these counts."""
        self.changed: dict[int, int] = {}
        """How many messages each set of writers changed, added up by the module (`BatchOptions`)."""
        self._call: ModuleCall | None = None
        self._clear()

    def count_in(self, call: ModuleCall) -> None:
        if self._call is not None:
            self._call.settle()
        self._call = call

    def add(self, walked: BatchResult, time: int) -> int:
        for number, count in enumerate(walked.dropped):
            if count:
                self._dropped[number] = _more(self._dropped[number], count, time)
        for number, count in enumerate(walked.told):
            if count:
                self._told[number] = _more(self._told[number], count, time)
        return sum(walked.dropped)

    def take(self) -> tuple[list[_Count], dict[tuple[str, ...], int], list[_Count]]:
        """Return and reset three counts: drops by event, changed messages by the events that changed them, verdicts.

        While the pump may still count, the counts stay `begun`.
        """
        if self._call is not None:
            self._call.settle()
        changed = {self.lane.writers(who): count for who, count in self.changed.items()}
        dropped, told = self._dropped, self._told
        self.begun = self._call is not None and self._call.valid
        self._clear()
        return dropped, changed, told

    def _clear(self) -> None:
        self.changed.clear()
        self._dropped: list[_Count] = [_NONE] * len(self.lane.events)
        self._told: list[_Count] = [_NONE] * len(self.lane.verdicts)


def _more(counted: _Count, count: int, time: int) -> _Count:
    return counted[0] + count, counted[1] or time, time
