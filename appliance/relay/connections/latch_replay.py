"""Find the message that a latching publisher sends again on a connection: a command of that kind is not new."""

REPLAY_SECONDS = 1.0
"""The time after a connection in which the first message of a latching publisher is the one that it had latched."""


class LatchReplay:
    """The connections of one publisher, which counts as new until `new_until` (seconds of the relay's clock)."""

    def __init__(self, new_until: float) -> None:
        self._new_until = new_until
        self._until = 0.0

    def opened(self, now: float, *, is_latching: bool) -> None:
        self._until = now + REPLAY_SECONDS if is_latching and now > self._new_until else 0.0
        self._new_until = -1.0  # only the first connection of a new publisher has a new message first

    @property
    def awaited(self) -> bool:
        return self._until > 0

    def is_first(self, now: float) -> bool:
        """Return whether the next message is the one that was latched; call this once for a connection."""
        until, self._until = self._until, 0.0
        return now <= until
