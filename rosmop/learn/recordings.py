"""Recordings as input of the learner, their split into training and held-out parts, and windows."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

Received = tuple[str, int, bytes]  # topic, nanoseconds, the bytes of the fields

_WINDOWS = 24  # at least this number for all recordings together


class RecordingSource(Protocol):
    """The messages on some topics from `began` to `ended`, in nanoseconds."""

    @property
    def name(self) -> str:
        """Return the name for messages."""

    @property
    def began(self) -> int:
        """Return the time of its first message."""

    @property
    def ended(self) -> int:
        """Return the time of its last message."""

    @property
    def topics(self) -> Mapping[str, str]:
        """Return the message types of its topics."""

    def messages(self) -> Iterator[Received]:
        """Yield all messages in order of time; each call starts again."""


@dataclass(frozen=True)
class RecordingPart:
    """A recording, or the part of it between two times (both included)."""

    whole: RecordingSource
    began: int
    ended: int

    @property
    def name(self) -> str:
        """Return the recording's."""
        return self.whole.name

    @property
    def topics(self) -> Mapping[str, str]:
        """Return the recording's."""
        return self.whole.topics

    @property
    def seconds(self) -> float:
        """Return the length in seconds."""
        return (self.ended - self.began) / 10**9

    def messages(self) -> Iterator[Received]:
        """Return the messages of these times."""
        return (message for message in self.whole.messages() if self.began <= message[1] <= self.ended)


def split(
    recordings: Sequence[RecordingSource], held_out: float
) -> tuple[list[RecordingPart], list[RecordingPart]]:
    """Return the training part and the held-out part: whole recordings, spread evenly, or the end of a single one.

    Nothing is held out of one recording that is too short to have an end.
    """
    parts = [RecordingPart(recording, recording.began, recording.ended) for recording in recordings]
    if held_out <= 0:
        return parts, []
    if len(parts) == 1:
        only = parts[0]
        cut = only.ended - int((only.ended - only.began) * held_out)
        if cut == only.ended:
            return parts, []
        return [RecordingPart(only.whole, only.began, cut)], [RecordingPart(only.whole, cut + 1, only.ended)]
    count = min(max(round(len(parts) * held_out), 1), len(parts) - 1)
    chosen = {int((number + 0.5) * len(parts) / count) for number in range(count)}
    return (
        [part for number, part in enumerate(parts) if number not in chosen],
        [part for number, part in enumerate(parts) if number in chosen],
    )


class Windows:
    """Number the windows that recordings are divided into: equally long, and enough of them in each recording."""

    def __init__(self, recordings: int) -> None:
        self._each = math.ceil(_WINDOWS / recordings)
        self._first = -self._each
        self._part: RecordingPart | None = None
        self.seconds = 0.0
        """The length of all windows so far."""

    @property
    def mean(self) -> float:
        """Seconds of a window."""
        return max(self.seconds / (self._first + self._each), 1e-3)

    def enter(self, part: RecordingPart) -> None:
        """Continue with the times of this recording."""
        self._part = part
        self._first += self._each
        self.seconds += part.seconds

    def at(self, time: int) -> int:
        """Return the window of a time."""
        assert self._part is not None  # noqa: S101  `enter` comes first
        length = self._part.ended - self._part.began + 1
        return self._first + (time - self._part.began) * self._each // length
