"""A running specification: events as functions, runs of properties, timers."""

from collections import deque
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple, Protocol, cast

import msgspec

from rosmop.form.compiled import Compiled, EventCode, PropertyCode, SpecificationCode
from rosmop.form.nodes import SafeMessage
from rosmop.logics.interface import FormulaRun, Run
from rosmop.run.explain import TRAIL, Bound, Exits, Steps, history_of
from rosmop.run.interpreter import Interpreter
from rosmop.run.origins import Origin
from rosmop.run.slice_quota import HolderOf
from rosmop.run.slices import Slice, Slices
from rosmop.runtime.action_context import Context
from rosmop.runtime.wire import WireMessage

FAILING_AFTER = 10


class CellNames(msgspec.Struct, frozen=True, array_like=True):
    """The layout of a group's state in a module.

    It has the states of properties (monitor, number), then variables (monitor, name; None if not part of the state)
    with their `struct` codes, then clocks of the properties with these numbers.
    """

    properties: list[tuple[str, int]] = []
    variables: list[tuple[str, str] | None] = []
    code: str = ""
    clocks: list[int] = []


class StateHolder(Protocol):
    """Holds the state of monitors in Python or in a module."""

    names: CellNames

    def leave(self) -> None:
        """Move the state to Python."""

    def show(self) -> None:
        """Copy the state to Python."""

    def is_true(self, name: str) -> bool: ...

    size: int

    left: bool

    def cells(self) -> bytes | None:
        """Return the state in the module's memory: empty if it has been in Python since the last save, None to save
        from Python.
        """


@dataclass(eq=False, slots=True)
class MonitorGroup:
    """Monitors that share topics or variables: a message changes the state of at most one group.

    It is `changed` if the state may have changed outside the module since it was last saved.
    """

    monitors: tuple["MonitorInstance", ...]
    channels: frozenset[str]
    home: StateHolder | None = None
    changed: bool = True


Handler = Callable[[WireMessage | None], None]


class Remedy(NamedTuple):
    """Publishes the due message of a property; `accepts` returns whether the awaited event accepts a message.

    In slices, `key` returns the values that the event binds.
    """

    publish: Handler
    event: EventCode
    accepts: Callable[[WireMessage], object]
    key: Callable[[WireMessage], Any] | None


@dataclass(eq=False, slots=True)
class RunningProperty:
    """A property of a running specification. Its history explains verdicts."""

    index: int
    code: PropertyCode
    handlers: tuple[tuple[str, Handler], ...]
    run: Run
    history: Exits | Steps
    remedy: "Remedy | None" = None

    def begin(self, time_ns: int) -> None:
        self.run = self.code.property.start(time_ns)
        self.history.begin(time_ns)

    def mark(self) -> Callable[[], None]:
        run = cast("FormulaRun", self.run)
        before, history = run.mark(), self.history.mark()

        def take_back() -> None:
            run.take_back(before)
            self.run = run
            self.history.take_back(history)

        return take_back


@dataclass(eq=False, slots=True)
class Step:
    """One event's processing of a message.

    Since the last report (`told`), the event did not happen `past` times because an index was past the end.
    """

    monitor: "MonitorInstance"
    event: EventCode
    index: int
    name: str
    function: Callable[[WireMessage | None], bool]
    first: bool = False
    past: int = 0
    told: int | None = None
    key: Callable[[WireMessage], Any] | None = None


class Tap(Step):
    """A pseudo-event that never happens: it copies messages for shadow mode."""

    __slots__ = ()


@dataclass(eq=False, slots=True)
class Timer:
    """A periodic event. `due` is None while it does not run."""

    step: Step
    period: int
    due: int | None = None
    ticked: bool = False


@dataclass(eq=False, slots=True)
class SafeSender:
    """Sends a safe message while its monitor cannot judge. `due` is None before the first message."""

    safe: SafeMessage
    due: int | None = None


@dataclass(eq=False, slots=True)
class MonitorInstance:
    """A running specification."""

    code: SpecificationCode
    context: Context
    properties: tuple[RunningProperty, ...]
    steps: tuple[Step, ...] = ()
    timers: tuple[Timer, ...] = ()
    enabled: bool = True
    held: bool = False
    why_held: str = ""
    """Why the state was lost, if the monitor therefore holds its topics."""
    broken: bool = False
    """Whether first values or `init` faulted, so that there is no valid state."""
    faults: int = 0
    seen: bool = False
    home: StateHolder | None = None
    slices: Slices | None = None
    """The slices; `properties` has the runs of the slice used last."""
    slice: Slice | None = None
    group: MonitorGroup | None = None
    trail: deque[Bound] = field(default_factory=partial(deque, maxlen=TRAIL))
    safes: dict[str, SafeSender] = field(default_factory=dict)
    starting: dict[str, str] = field(default_factory=dict)
    """The topics with a safe message on which no message has come, and since when, in words: the last start."""
    sources: dict[str, Origin] = field(default_factory=dict)
    """The observed topics of a monitor declared `begin`."""

    @property
    def name(self) -> str:
        return self.code.name

    @property
    def held_channels(self) -> Collection[str]:
        """Return the channels that it holds while it cannot judge; all, if it is declared `hold` and only observes."""
        if self.code.acts_on or not self.code.hold:
            return self.code.acts_on
        return [event.channel for event in self.code.events if event.channel is not None]

    @property
    def failing(self) -> bool:
        return self.broken or self.faults >= FAILING_AFTER

    def hold(self, why: str = "") -> None:
        self.held, self.why_held = True, why

    def resume(self) -> None:
        """End a hold; without one, hear any node instead of those that it awaits."""
        forgets = bool(self.awaits) and not self.held
        self.held, self.why_held = False, ""
        for source in self.sources.values() if forgets else ():
            source.forget()

    def sending(self, *, passes: bool) -> list[SafeSender]:
        """Return the senders that send now: all while no message can be judged, else those of `starting` topics.

        With `passes` (`on_fault`), messages pass a monitor that failed to start.
        """
        if not self.safes or not self.enabled:
            return []
        blocks = self.blocks or (self.broken and not passes)
        return [sender for topic, sender in self.safes.items() if blocks or topic in self.starting]

    def start_anew(self) -> None:
        self.starting = dict.fromkeys(self.safes, "the guard began")

    def await_sources(self) -> None:
        for source in self.sources.values():
            source.begin_again()

    @property
    def awaits(self) -> str:
        """Return the nodes, with their topics, without whose messages it does not go on, or an empty text."""
        rows = ((topic, source.awaited) for topic, source in self.sources.items())
        return "; ".join(
            f"{', '.join(nodes).replace(chr(0), '…')} on {topic}" for topic, nodes in rows if nodes
        )

    @property
    def blocks(self) -> bool:
        """Whether it cannot judge, and so holds its topics, until an operator resumes it or until nodes speak."""
        return self.held or (bool(self.sources) and any(source.blocks for source in self.sources.values()))

    def touch(self) -> None:
        if self.group is not None:
            self.group.changed = True

    def move_to_python(self) -> None:
        """Call this before Python reads the state, or that of other monitors on its topics."""
        if self.home is not None:
            self.home.leave()


def monitors_of(
    compiled: Compiled,
    interpreter: Interpreter,
    time_ns: int,
    slices: int,
    holder_of: HolderOf,
) -> tuple[MonitorInstance, ...]:
    return tuple(_monitor(interpreter, code, time_ns, slices, holder_of) for code in compiled.specifications)


def _monitor(
    interpreter: Interpreter, code: SpecificationCode, time_ns: int, slices: int, holder_of: HolderOf
) -> MonitorInstance:
    function = interpreter.function
    properties = tuple(
        RunningProperty(
            index,
            declared,
            tuple((category, function(declared.handlers[category])) for category in declared.order),
            declared.property.start(time_ns),
            history_of(declared.property, time_ns),
            _remedy(function, code, declared),
        )
        for index, declared in enumerate(code.properties)
    )
    monitor = MonitorInstance(code, interpreter.contexts[code.context], properties)
    if code.slicing is not None:
        monitor.slices = Slices(code, interpreter.variables, slices, holder_of, interpreter.turn)
    monitor.safes = {safe.topic: SafeSender(safe) for safe in code.safes}
    steps = [
        Step(
            monitor,
            event,
            index,
            f"{code.name}.{event.name}",
            function(event.function),
            key=function(event.key) if event.key else None,
        )
        for index, event in enumerate(code.events)
    ]
    monitor.steps = tuple(step for step in steps if step.event.period_ns is None)
    if code.begins and code.slicing is None:
        events = [event for event in code.events if event.topic and event.part is None]
        each = {event.topic for event in events if event.each_node}
        topics = dict.fromkeys(event.topic or "" for event in events if event.topic not in code.acts_on)
        monitor.sources = {topic: Origin(speakers=topic in each) for topic in topics}
    monitor.timers = tuple(
        Timer(step, step.event.period_ns) for step in steps if step.event.period_ns is not None
    )
    return monitor


def _remedy(
    function: Callable[[str], Callable[..., Any]], code: SpecificationCode, declared: PropertyCode
) -> Remedy | None:
    if (remedy := declared.remedy) is None:
        return None
    event = code.events[remedy.event]
    key = function(event.key) if event.key else None
    return Remedy(function(remedy.function), event, function(remedy.accepts), key)
