"""What comes of a message, of a tick and of a deadline, as values for the relay and for `rosrv monitor run`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal

from rosmop.form.positions import Position
from rosmop.form.sites import Site, showing
from rosmop.logics.interface import Source
from rosmop.run.causes import Explanation
from rosmop.runtime.action_context import LogLine, Published
from rosmop.runtime.wire import Buffer

Result = Literal["passed", "changed", "dropped"]

DROPPED = -1
"""The place of the drop in `Outcome.handling`."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """A property is in a category that has a handler. `property` counts from 0 in its specification; `source` is its
    formula. `why` is None where nobody has asked (`MonitorSet.explain_when`), or it cannot be said.

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
    """An action that could not go on: where it stands, why, and the values of the variables involved."""

    monitor: str
    position: Position
    text: str
    values: Mapping[str, object]


def named(verdict: Verdict) -> str:
    """Which property of which monitor, with its binding, and the category that it is in."""
    name = f"property {verdict.property + 1} of {verdict.monitor} ({verdict.logic}){bound(verdict)}"
    return f"{name}: {verdict.category}"


def bound(verdict: Verdict) -> str:
    """The binding as text that goes on from the name of the property; empty without parameters."""
    if not verdict.binding:
        return ""
    return f" with {', '.join(f'{name} = {value}' for name, value in verdict.binding.items())}"


class Outcome:
    """What is to be done with a message, and everything that happened on the way.

    `buffer` is what to relay: the buffer that came in (changed in place where that was possible), or another.
    `events` are named `specification.event`. `timer` names what a tick or deadline belongs to
    (`specification.tick`, `specification.timeout`, `specification.deadline`); `time` is in nanoseconds. `before`
    are ticks and deadlines that were due before this message. `tried` is, of the beginning of a set, that of each of
    its sets on trial.

    `changed_by` are the events whose actions made its bytes others than they found them, in order; empty unless the
    result is `changed`; at `changed_at` stand the statements that assigned to the fields whose bytes are others. An
    event that happened without a change, or assigned what was there, is not among them.
    `dropped_by` is the specification that dropped it: by its last event, by `fatal` (a fault that dropped it), or for
    `reason` (it is held, or could not begin); `dropped_at` is where the statement, the action or the specification
    stands. `handling` has the verdicts in whose handlers the message was dropped (under `DROPPED`) and messages were
    published (under their places in `published`).

    `looked` are the conditions that were met on the way, by their sites, with the values that they compared: each
    `when` of an event that happened, each `if` around a statement that dropped or changed the message, or published.

    `overwritten` is, of a dropped message, what stood in the buffer that came in where actions have written into it
    (place and bytes, in order): `restore` puts it back.

    Most messages have nothing to tell; so there is nothing to make for them but the object itself.
    """

    result: Result = "passed"
    timer: str | None = None
    events: Sequence[str] = ()
    verdicts: Sequence[Verdict] = ()
    published: Sequence[Published] = ()
    log: Sequence[LogLine] = ()
    faults: Sequence[Fault] = ()
    before: Sequence["Outcome"] = ()
    tried: Sequence["Outcome"] = ()
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
        """Make of the buffer that came in what was received; one that cannot be written was left alone."""
        if not buffer.readonly:
            for start, old in reversed(self.overwritten):
                buffer[start : start + len(old)] = old

    @property
    def conditions(self) -> dict[str, dict[str, object]]:
        """Where the conditions stand that were met, and the values that they compared."""
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
