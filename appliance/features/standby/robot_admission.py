"""Estimate, on the active one of two appliances, whether computers of the robot may refuse its connections.

A follower admits an appliance only while its lease runs at the witness. So the followers refuse connections with both
appliances after a takeover and after a gap in the witness's answers, until they have asked the witness again. In this
time a refused connection does not mean that a node has ended.
"""

from collections.abc import Callable

from appliance.base import clock

_GAP_SECONDS = 0.9  # without an answer of the witness; less than the confidence of a follower
_ADMITTED_SECONDS = 2.0  # after the next answer, until all followers admit this appliance again


class RobotAdmission:
    """The times of the witness's answers (seconds of CLOCK_BOOTTIME)."""

    def __init__(self) -> None:
        self._answered = self._admitted = clock.since_boot()
        self._gap_ended: Callable[[], None] = lambda: None

    def on_end_of_gap(self, gap_ended: Callable[[], None]) -> None:
        """Call this at the first answer after each gap."""
        self._gap_ended = gap_ended

    def note_answer(self, at: float) -> None:
        """Note an answer of the witness."""
        gap = at - self._answered > _GAP_SECONDS
        self._answered = max(self._answered, at)
        if gap:
            self._admitted = at
            self._gap_ended()

    def in_doubt(self) -> bool:
        """Whether a computer of the robot may shut out this appliance."""
        now = clock.since_boot()
        return now - self._answered > _GAP_SECONDS or now - self._admitted < _ADMITTED_SECONDS
