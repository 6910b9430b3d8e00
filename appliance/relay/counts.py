"""What was done to messages that needed nothing to be told, added up until the second is over."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from appliance.relay.monitors.observation_points import Place

if TYPE_CHECKING:
    from rosmop.run.fast_path import FastLane, Walked


class Count(NamedTuple):
    """How often an event happened, and dropped a message; when it dropped one last (nanoseconds)."""

    happened: int
    dropped: int
    last_drop: int


class Told(NamedTuple):
    """How often there was a verdict, and when last (nanoseconds)."""

    times: int
    last: int


class Counts:
    """What walks at one place have done since it was last taken."""

    def __init__(self, walker: FastLane, place: Place) -> None:
        self.walker = walker
        self.place = place
        self.begun = False
        """Whether somebody has been told that something is counted."""
        self.changed: dict[int, int] = {}
        """Where walks add up what was changed (`Prepared`)."""
        self._clear()

    def add(self, walked: Walked, time: int) -> int:
        """Count what a walk dropped; how many messages."""
        for number, count in enumerate(walked.dropped):
            if count:
                self._dropped[number] += count
                self._last_drop[number] = time
        for number, count in enumerate(walked.told):
            if count:
                self._told[number] = Told(self._told[number].times + count, time)
        return sum(walked.dropped)

    def take(self) -> tuple[list[Count], dict[tuple[str, ...], int], list[Told]]:
        """The counts of all events, of changed messages by the events that changed them, and of all verdicts; they
        begin anew.
        """
        happened = self.walker.happened()
        counts = [Count(*row) for row in zip(happened, self._dropped, self._last_drop, strict=True)]
        changed = {self.walker.writers(who): count for who, count in self.changed.items()}
        told = self._told
        self._clear()
        return counts, changed, told

    def _clear(self) -> None:
        self.begun = False
        self.changed.clear()
        self._dropped = [0] * len(self.walker.events)
        self._last_drop = [0] * len(self.walker.events)
        self._told = [Told(0, 0)] * len(self.walker.verdicts)
