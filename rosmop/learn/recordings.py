"""Recordings as input of the learner, and their split into training and held-out parts."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

Received = tuple[str, int, bytes]  # topic, nanoseconds, the bytes of the fields


class LearningError(Exception):
    """Nothing can be learnt; the message names the recordings and the reason."""


class RecordingFacts(Protocol):
    """Some topics of a recording from `began` to `ended`, in nanoseconds. `topics` have their message types."""

    @property
    def name(self) -> str:
        """Return the recording's name for messages to the user."""

    @property
    def began(self) -> int: ...

    @property
    def ended(self) -> int: ...

    @property
    def topics(self) -> Mapping[str, str]: ...


class RecordingSource(RecordingFacts, Protocol):
    @property
    def caller(self) -> str:
        """Return the caller id of the sender of the message that `messages` has just yielded."""

    def messages(self) -> Iterator[Received]:
        """Yield messages in order of time; each call starts again."""


@dataclass(frozen=True)
class LearnedSpan:
    """A recording by number, or the part of it between two times (both included)."""

    number: int
    name: str
    began: int
    ended: int

    @property
    def seconds(self) -> float:
        return (self.ended - self.began) / 10**9


def split(
    recordings: Sequence[RecordingFacts], held_out: float
) -> tuple[list[LearnedSpan], list[LearnedSpan]]:
    """Hold out whole recordings, spread evenly, or the end of a single one, unless it is too short to split."""
    parts = [
        LearnedSpan(number, recording.name, recording.began, recording.ended)
        for number, recording in enumerate(recordings)
    ]
    if held_out <= 0:
        return parts, []
    if len(parts) == 1:
        only = parts[0]
        cut = only.ended - int((only.ended - only.began) * held_out)
        if cut == only.ended:
            return parts, []
        return [replace(only, ended=cut)], [replace(only, began=cut + 1)]
    count = min(max(round(len(parts) * held_out), 1), len(parts) - 1)
    chosen = {int((number + 0.5) * len(parts) / count) for number in range(count)}
    return (
        [part for number, part in enumerate(parts) if number not in chosen],
        [part for number, part in enumerate(parts) if number in chosen],
    )
