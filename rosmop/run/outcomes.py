"""Outcomes of messages, ticks and deadlines, as values for the relay and for `rosmop run`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

from rosmop.form.positions import Position
from rosmop.form.sites import Site, showing
from rosmop.logics.interface import Source
from rosmop.runtime.action_context import LogLine, Published
from rosmop.runtime.wire import Buffer

Result = Literal["passed", "changed", "dropped"]

DROPPED = -1
"""The key of the drop in `Outcome.handling`."""


class MessageSender(NamedTuple):
    """The source of a message (a number chosen by the caller; 0: none), and a sequence number of the given `kind`.

    `kind` says which sequence number the message has.
    """

    source: int = 0
    number: int = 0
    kind: int = 0


NOBODY = MessageSender()
NO_NUMBER, SEQ = range(2)
"""Kinds of sequence numbers: none; `seq` of the header."""


class EventOccurrence(NamedTuple):
    """An event (its number in the specification), its time and sender, and the name of the state after it, if any."""

    event: int
    time: int
    sender: MessageSender
    state: str = ""


class Explanation(NamedTuple):
    """Events that alone give a verdict. `fewest`: none of them can be left out.

    With `since` (ns), the events lead to the verdict from the property's state at that time; earlier events are not
    kept.
    """

    events: tuple[EventOccurrence, ...]
    fewest: bool = True
    since: int | None = None


@dataclass(frozen=True, slots=True)
class Verdict:
    """A property's arrival in a category that has a handler. `property` counts from 0 in its specification; `source` is
    its formula. `why` is None if an explanation was not wanted (`MonitorSet.explain_when`) or is impossible.

    `binding` has the values of the parameters of a parametric specification, by name.
    """

    monitor: str
    property: int
    logic: str
    category: str
    source: Source
    why: Explanation | None = None
    binding: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault, which stopped an action: position, reason, and the values of the variables involved."""

    monitor: str
    position: Position
    text: str
    values: Mapping[str, object]


def named(verdict: Verdict) -> str:
    """Return monitor, property, binding and category of a verdict as text."""
    name = f"property {verdict.property + 1} of {verdict.monitor} ({verdict.logic}){bound(verdict)}"
    return f"{name}: {verdict.category}"


def bound(verdict: Verdict) -> str:
    """Return the binding as text after the name of the property; empty without parameters."""
    if not verdict.binding:
        return ""
    return f" with {', '.join(f'{name} = {value}' for name, value in verdict.binding.items())}"


class Outcome:
    """The result of processing a message, and all events on the way.

    `buffer` is the message to relay: the buffer that came in (changed in place where possible), or another buffer.
    `events` are named `specification.event`. `timer` names the source of a tick or deadline (`specification.tick`,
    `specification.timeout`, `specification.deadline`). `time` is in nanoseconds. `before` has the outcomes of ticks and
    deadlines that were due before this message. `shadowed` has the outcomes of the sets in shadow mode when a set
    starts.

    `changed_by` are the events whose actions changed bytes of the message, in order. It is empty unless the result is
    `changed`. `changed_at` are the positions of the statements that assigned to the changed fields. An event that
    assigned nothing, or the same value, is not included. `dropped_by` is the specification that dropped the message: at
    its last event, after a fault (`fatal`), or for `reason` (the topic is held, or the start failed). `dropped_at` is
    the position of the statement, the action or the specification. `handling` has the verdicts whose handlers dropped
    the message (key `DROPPED`) or published messages (keys: their indices in `published`).

    `looked` are the conditions that were met during processing, by site, with the values that they compared. They are
    each `when` of an event that happened, and each `if` around a statement that dropped, changed or published a
    message.

    For a dropped message, `overwritten` has the original bytes of the buffer that actions overwrote (position and
    bytes, in order). `restore` writes these bytes again.

    Most messages have none of these, so only the object itself is created for them.
    """

    result: Result = "passed"
    timer: str | None = None
    events: Sequence[str] = ()
    verdicts: Sequence[Verdict] = ()
    published: Sequence[Published] = ()
    log: Sequence[LogLine] = ()
    faults: Sequence[Fault] = ()
    before: Sequence["Outcome"] = ()
    shadowed: Sequence["Outcome"] = ()
    reason: str | None = None
    changed_by: Sequence[str] = ()
    changed_at: Sequence[Position] = ()
    dropped_by: str = ""
    fatal: Fault | None = None
    dropped_at: Position | None = None
    handling: Mapping[int, Verdict] = MappingProxyType({})
    looked: Mapping[int, tuple[Any, ...]] = MappingProxyType({})
    sites: Sequence[Site] = ()
    overwritten: Sequence[tuple[int, bytes]] = ()

    def __init__(self, buffer: Buffer = b"", time: int = 0) -> None:
        self.buffer = buffer
        self.time = time

    def restore(self, buffer: memoryview) -> None:
        """Restore the received bytes in the buffer, unless it is read-only."""
        if not buffer.readonly:
            for start, old in reversed(self.overwritten):
                buffer[start : start + len(old)] = old

    @property
    def conditions(self) -> dict[str, dict[str, object]]:
        """Return the positions of conditions that were met, with the values that they compared."""
        return {
            str(site.position): {
                each.name: showing(each.type)(value)
                for each, value in zip(site.compared, values, strict=True)
            }
            for site, values in ((self.sites[number], values) for number, values in self.looked.items())
        }

    def __repr__(self) -> str:
        told = {name: value for name, value in vars(self).items() if name != "buffer"}
        return f"Outcome({self.result}, {told})"
