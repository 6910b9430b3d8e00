"""Recordings as the learner takes them, their split into what is learnt from and what is held out, and windows."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

Received = tuple[str, int, bytes]  # topic, nanoseconds, the bytes of the fields

_WINDOWS = 24  # at least so many, of all recordings together


class Recording(Protocol):
    """What was received on some topics from `began` to `ended`, in nanoseconds."""

    @property
    def name(self) -> str:
        """How people call it."""

    @property
    def began(self) -> int:
        """The time of its first message."""

    @property
    def ended(self) -> int:
        """The time of its last message."""

    @property
    def topics(self) -> Mapping[str, str]:
        """The message types of its topics."""

    def messages(self) -> Iterator[Received]:
        """All messages, in the order of their times; each call begins anew."""


@dataclass(frozen=True)
class Part:
    """A recording, or the part of it between two times (both included)."""

    whole: Recording
    began: int
    ended: int

    @property
    def name(self) -> str:
        """The recording's."""
        return self.whole.name

    @property
    def topics(self) -> Mapping[str, str]:
        """The recording's."""
        return self.whole.topics

    @property
    def seconds(self) -> float:
        """How long it is."""
        return (self.ended - self.began) / 10**9

    def messages(self) -> Iterator[Received]:
        """The messages of these times."""
        return (message for message in self.whole.messages() if self.began <= message[1] <= self.ended)


def split(recordings: Sequence[Recording], held_out: float) -> tuple[list[Part], list[Part]]:
    """Return what is learnt from, and about this share to test it: whole recordings, spread evenly; of one its end.

    Nothing is held out of one recording that is too short to have an end.
    """
    parts = [Part(recording, recording.began, recording.ended) for recording in recordings]
    if held_out <= 0:
        return parts, []
    if len(parts) == 1:
        only = parts[0]
        cut = only.ended - int((only.ended - only.began) * held_out)
        if cut == only.ended:
            return parts, []
        return [Part(only.whole, only.began, cut)], [Part(only.whole, cut + 1, only.ended)]
    count = min(max(round(len(parts) * held_out), 1), len(parts) - 1)
    chosen = {int((number + 0.5) * len(parts) / count) for number in range(count)}
    return (
        [part for number, part in enumerate(parts) if number not in chosen],
        [part for number, part in enumerate(parts) if number in chosen],
    )


class Windows:
    """Numbers the windows that recordings are divided into: each into as many of equal length as give enough."""

    def __init__(self, recordings: int) -> None:
        self._each = math.ceil(_WINDOWS / recordings)
        self._first = -self._each
        self._part: Part | None = None
        self.seconds = 0.0
        """Of all windows so far together."""

    @property
    def mean(self) -> float:
        """Seconds of a window."""
        return max(self.seconds / (self._first + self._each), 1e-3)

    def enter(self, part: Part) -> None:
        """The times that follow are of this recording."""
        self._part = part
        self._first += self._each
        self.seconds += part.seconds

    def at(self, time: int) -> int:
        """The window of a time."""
        assert self._part is not None  # noqa: S101  `enter` comes first
        length = self._part.ended - self._part.began + 1
        return self._first + (time - self._part.began) * self._each // length
