"""What comes of a message, of a tick and of a deadline, as values for the relay and for `rosrv monitor run`."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from appliance.rosmop.positions import Position
from appliance.rosmop.runtime.context import LogLine, Published
from appliance.rosmop.runtime.wire import Buffer

Result = Literal["passed", "changed", "dropped"]


@dataclass(frozen=True, slots=True)
class Verdict:
    """A property is in a category that has a handler. `property` counts from 0 in its specification."""

    monitor: str
    property: int
    logic: str
    category: str


@dataclass(frozen=True, slots=True)
class Fault:
    """An action that could not go on: where it stands, why, and the values of the variables involved."""

    monitor: str
    position: Position
    text: str
    values: Mapping[str, object]


@dataclass(slots=True)
class Outcome:
    """What is to be done with a message, and everything that happened on the way.

    `buffer` is what to relay: the buffer that came in (changed in place where that was possible), or another.
    `events` are named `specification.event`. `timer` names what a tick or deadline belongs to
    (`specification.tick`, `specification.timeout`, `specification.deadline`); `time` is in nanoseconds. `before`
    are ticks and deadlines that were due before this message. `reason` says why a message of a service was
    refused, or of a held specification dropped.
    """

    result: Result = "passed"
    buffer: Buffer = b""
    time: int = 0
    timer: str | None = None
    events: list[str] = field(default_factory=list)
    verdicts: list[Verdict] = field(default_factory=list)
    published: list[Published] = field(default_factory=list)
    log: list[LogLine] = field(default_factory=list)
    faults: list[Fault] = field(default_factory=list)
    before: list["Outcome"] = field(default_factory=list)
    reason: str | None = None
