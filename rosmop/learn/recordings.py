"""Recordings as input of the learner, their split into training and held-out parts, and windows."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

Received = tuple[str, int, bytes]  # topic, nanoseconds, the bytes of the fields

_WINDOWS = 24  # the minimum number for all recordings together


class RecordingSource(Protocol):
    """The messages on some topics from `began` to `ended`, in nanoseconds."""

    @property
    def name(self) -> str:
        """Return the name of the recording for messages to the user."""

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
        """Return the name of the recording."""
        return self.whole.name

    @property
    def topics(self) -> Mapping[str, str]:
        """Return the message types of the recording's topics."""
        return self.whole.topics

    @property
    def seconds(self) -> float:
        """Return the length in seconds."""
        return (self.ended - self.began) / 10**9

    def messages(self) -> Iterator[Received]:
        """Yield the messages between these times."""
        return (message for message in self.whole.messages() if self.began <= message[1] <= self.ended)


def split(
    recordings: Sequence[RecordingSource], held_out: float
) -> tuple[list[RecordingPart], list[RecordingPart]]:
    """Return the training part and the held-out part: whole recordings, spread evenly, or the end of a single one.

    If there is only one recording and it is too short to split, nothing is held out.
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
    """Number the windows that recordings are divided into.

    Windows are equally long, and each recording has enough of them.
    """

    def __init__(self, recordings: int) -> None:
        self._each = math.ceil(_WINDOWS / recordings)
        self._first = -self._each
        self._part: RecordingPart | None = None
        self.seconds = 0.0
        """The length of all windows so far."""

    @property
    def mean(self) -> float:
        """Return the mean length of a window in seconds."""
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
