"""What was done to messages that needed nothing to be told, added up until the second is over."""

from typing import NamedTuple

from appliance.rosmop.batch import Walked, Walker


class Count(NamedTuple):
    """How often an event happened, and dropped or changed a message; when it dropped one last (nanoseconds)."""

    happened: int
    dropped: int
    changed: int
    last_drop: int


class Counts:
    """What walks at one place (key of an incarnation, topic) have done since it was last taken."""

    def __init__(self, walker: Walker, place: tuple[str, str]) -> None:
        self.walker = walker
        self.place = place
        self.begun = False
        """Whether something is counted."""
        self._events = len(walker.events)
        self._clear()

    def add(self, walked: Walked, time: int) -> int:
        """Count a walk; how many messages it dropped."""
        self.begun = True
        happened = self._happened
        for number, count in enumerate(walked.happened):
            happened[number] += count
        if self.walker.changes:
            changed = self._changed
            for number, count in enumerate(walked.changed):
                changed[number] += count
        if not self.walker.drops:
            return 0
        gone = 0
        for number, count in enumerate(walked.dropped):
            if count:
                gone += count
                self._dropped[number] += count
                self._last_drop[number] = time
        return gone

    def take(self) -> list[Count]:
        """The counts of all events; they begin anew."""
        counts = [
            Count(*each)
            for each in zip(self._happened, self._dropped, self._changed, self._last_drop, strict=True)
        ]
        self._clear()
        return counts

    def _clear(self) -> None:
        self.begun = False
        self._happened = [0] * self._events
        self._dropped = [0] * self._events
        self._changed = [0] * self._events
        self._last_drop = [0] * self._events
