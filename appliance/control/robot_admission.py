"""Estimate, on the active one of two appliances, whether computers of the robot may refuse its connections.

A follower admits an appliance only while its lease runs at the witness. So the followers refuse connections with both
appliances after a takeover and after a gap in the witness's answers, until they have asked the witness again. In this
time a refused connection does not mean that a node has ended.
"""

from appliance.base import clock

_GAP_SECONDS = 0.9  # without an answer of the witness; less than the confidence of a follower
_ADMITTED_SECONDS = 2.0  # after the next answer, until all followers admit this appliance again


class RobotAdmission:
    """The times of the witness's answers (seconds of CLOCK_BOOTTIME)."""

    def __init__(self) -> None:
        self._answered = self._admitted = clock.since_boot()

    def note_answer(self, at: float) -> None:
        """Note an answer of the witness."""
        if at - self._answered > _GAP_SECONDS:
            self._admitted = at
        self._answered = max(self._answered, at)

    def in_doubt(self) -> bool:
        """Whether a computer of the robot may shut out this appliance."""
        now = clock.since_boot()
        return now - self._answered > _GAP_SECONDS or now - self._admitted < _ADMITTED_SECONDS
