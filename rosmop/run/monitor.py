"""A running specification: its events as functions, the runs of its properties, its timers."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Protocol, cast

import msgspec

from rosmop.form.compiled import Compiled, EventCode, PropertyCode, SpecificationCode
from rosmop.logics.interface import FormulaRun, Run
from rosmop.run.explain import TRAIL, Bound, Exits, Steps, history_of
from rosmop.run.interpreter import Interpreter
from rosmop.run.slice_quota import HolderOf
from rosmop.run.slices import Slice, Slices
from rosmop.runtime.action_context import Context
from rosmop.runtime.wire import Message

FAILING_AFTER = 10
"""Faults after which a monitor is shown as failing."""


class CellNames(msgspec.Struct, frozen=True, array_like=True):
    """What is in the bytes that a module has of a group's state.

    First the states of properties (monitor, number), then the variables (monitor, name; None for one that is not state)
    with their `struct` codes, then the clocks of the properties with these numbers.
    """

    properties: list[tuple[str, int]] = []
    variables: list[tuple[str, str] | None] = []
    code: str = ""
    clocks: list[int] = []


class Home(Protocol):
    """Where the state of monitors is: with Python, or in a module."""

    names: CellNames
    """What `cells` are."""

    def leave(self) -> None:
        """See that Python has it."""

    def show(self) -> None:
        """Give Python a copy of it."""

    size: int
    """Bytes of `cells`; 0 where the state is more than numbers."""

    left: bool
    """Python has had the state since it was last kept."""

    def cells(self) -> bytes | None:
        """The state as it is in the module's memory, if it is only numbers; empty if Python has it, and had it when it
        was last kept. None: it is to be kept as Python has it.
        """


@dataclass(eq=False, slots=True)
class Group:
    """The monitors that share topics or variables, so that a message changes the state of one group at most.

    `ways` are their topics and parts of services; `changed`: something else than the module may have changed their
    state since that was last kept.
    """

    monitors: tuple["Monitor", ...]
    ways: frozenset[str]
    home: Home | None = None
    changed: bool = True


Handler = Callable[[Message | None], None]


@dataclass(eq=False, slots=True)
class RunningProperty:
    """A property of a running specification: the monitor of its formula, what is kept of it to explain a verdict, and
    its handlers in source order.
    """

    index: int
    code: PropertyCode
    handlers: tuple[tuple[str, Handler], ...]
    run: Run
    history: Exits | Steps

    def begin(self, time_ns: int) -> None:
        """Begin anew."""
        self.run = self.code.property.start(time_ns)
        self.history.begin(time_ns)

    def mark(self) -> Callable[[], None]:
        """Return what takes back all that comes to the property from here on, but time."""
        run = cast("FormulaRun", self.run)
        before, history = run.mark(), self.history.mark()

        def take_back() -> None:
            run.take_back(before)
            self.run = run
            self.history.take_back(history)

        return take_back


@dataclass(eq=False, slots=True)
class Step:
    """What one event does with a message: its function, then its properties.

    `past` counts how often the event did not happen because an index was past the end, since `told`.
    """

    monitor: "Monitor"
    event: EventCode
    index: int
    name: str
    function: Callable[[Message | None], bool]
    first: bool = False
    """The first of its monitor on its topic."""
    past: int = 0
    told: int | None = None
    key: Callable[[Message], Any] | None = None
    """Of a parametric specification: what a message binds of its parameters (see `compile/events.py`)."""


@dataclass(eq=False, slots=True)
class Timer:
    """An event that happens every so often; `due` is the time of its next tick, None while it does not run."""

    step: Step
    period: int
    due: int | None = None
    ticked: bool = False


@dataclass(eq=False, slots=True)
class Monitor:
    """A running specification."""

    code: SpecificationCode
    context: Context
    properties: tuple[RunningProperty, ...]
    steps: tuple[Step, ...] = ()
    timers: tuple[Timer, ...] = ()
    enabled: bool = True
    held: bool = False
    why_held: str = ""
    """Why, if it is because its state was lost."""
    broken: bool = False
    """Its first values or `init` faulted, so it has no state to judge by."""
    faults: int = 0
    seen: bool = False
    """A message of one of its events has come."""
    home: Home | None = None
    """Where its state is, if that may be in a module."""
    slices: Slices | None = None
    """Of a parametric specification: its states. `properties` have the runs of the one that was looked at last."""
    slice: Slice | None = None
    """The slice that was looked at last."""
    group: Group | None = None
    """Those whose state changes together with its own."""
    trail: deque[Bound] = field(default_factory=partial(deque, maxlen=TRAIL))
    """Of a parametric specification: what happened last in all slices."""

    @property
    def name(self) -> str:
        """The name of the specification."""
        return self.code.name

    @property
    def failing(self) -> bool:
        """Whether it has faulted so often, or could not even begin, that somebody should look."""
        return self.broken or self.faults >= FAILING_AFTER

    def hold(self, why: str = "") -> None:
        """Drop the messages of its topics until `resume`."""
        self.held, self.why_held = True, why

    def resume(self) -> None:
        """Let the messages of its topics go on."""
        self.held, self.why_held = False, ""

    def touch(self) -> None:
        """Note that its state, or that of others in its group, is about to change."""
        if self.group is not None:
            self.group.changed = True

    def come_home(self) -> None:
        """Before Python looks at its state, or at that of others on its topics, it is with Python."""
        if self.home is not None:
            self.home.leave()


def monitors_of(
    compiled: Compiled,
    interpreter: Interpreter,
    time_ns: int,
    slices: int,
    holder_of: HolderOf,
) -> tuple[Monitor, ...]:
    """Return the running forms of compiled specifications, in their initial state.

    Each has at most `slices` slices, which are charged to `holder_of(source)`.
    """
    return tuple(_monitor(interpreter, code, time_ns, slices, holder_of) for code in compiled.specifications)


def _monitor(
    interpreter: Interpreter, code: SpecificationCode, time_ns: int, slices: int, holder_of: HolderOf
) -> Monitor:
    function = interpreter.function
    properties = tuple(
        RunningProperty(
            index,
            declared,
            tuple((category, function(declared.handlers[category])) for category in declared.order),
            declared.property.start(time_ns),
            history_of(declared.property, time_ns),
        )
        for index, declared in enumerate(code.properties)
    )
    monitor = Monitor(code, interpreter.contexts[code.context], properties)
    if code.slicing is not None:
        monitor.slices = Slices(code, interpreter.variables, slices, holder_of)
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
    monitor.timers = tuple(
        Timer(step, step.event.period_ns) for step in steps if step.event.period_ns is not None
    )
    return monitor
