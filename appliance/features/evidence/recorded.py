"""The fields of a recording that evidence shows.

Evidence imports nothing of the recorder, so an appliance without a recorder exports the log only.
"""

from collections.abc import Sequence
from typing import Protocol


class RecordedTrigger(Protocol):
    """A trigger of a recording; `time` is nanoseconds since the epoch."""

    @property
    def time(self) -> int: ...
    @property
    def what(self) -> str: ...
    @property
    def record(self) -> str: ...
    @property
    def text(self) -> str: ...


class TopicOfRecording(Protocol):
    """A topic of a recording, with the number of its messages."""

    @property
    def topic(self) -> str: ...
    @property
    def type(self) -> str: ...
    @property
    def messages(self) -> int: ...
    @property
    def missed(self) -> int: ...


class RecordingSummary(Protocol):
    """A recording; `began` and `ended` are nanoseconds since the epoch."""

    @property
    def id(self) -> str: ...
    @property
    def began(self) -> int: ...
    @property
    def ended(self) -> int: ...
    @property
    def complete(self) -> bool: ...
    @property
    def why_not(self) -> str: ...
    @property
    def triggers(self) -> Sequence[RecordedTrigger]: ...
    @property
    def topics(self) -> Sequence[TopicOfRecording]: ...
