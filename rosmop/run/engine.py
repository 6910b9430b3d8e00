"""The running monitors: a message goes in, what is to be done with it comes out. No I/O, no clock.

Theory of operation:

1. `MonitorSet.of` takes what was compiled; `start` gives the variables their first values.
2. `process` gives a message to the events on its topic (`execution.py`).
3. Time is what the caller says: nanoseconds, with every message. Ticks and deadlines that are due (`agenda.py`) happen
   before a message; `process` returns them in `before`. While no message comes, the caller calls `advance` when
   `next_due` has come; a deadline may have been put off since.
4. `walker` offers, for most topics, a lane of the fast path (`fast_path.py`), which does what `process` does to many
   messages at once, as far as these need nothing that is recorded or explained. Its results differ in nothing but
   the time that they take.
5. A new set takes the place of another one with `succeed`, in one swap between two messages. Specifications whose
   text is the same keep their variables and runs.
6. Specifications on trial are sets of their own (`trials`), one for those that share variables: nothing that one does
   or uses up is seen by others. Where the first of such a set would stand among the others, a copy of the message as
   it is there is left in `tapped`; the caller gives it to them when the message is passed on (`Tapped.give`), and what
   comes of it is what would have been done. The copies for one set are given in their order.
"""

import math
import sys
import weakref
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

from rosmop.form.compiled import Compiled, EventCode
from rosmop.form.connected_groups import way_of
from rosmop.form.positions import Finding, Position
from rosmop.form.specification_groups import groups
from rosmop.run.causes import NOBODY, Sender
from rosmop.run.execution import Asked, Execution, OnFault
from rosmop.run.fast_path import MESSAGE_FUEL, FastLane, FastPath, Lanes, Prepared
from rosmop.run.interpreter import Interpreter
from rosmop.run.monitor import Group, Monitor, Step, monitors_of
from rosmop.run.outcomes import Outcome
from rosmop.run.slice_quota import HolderOf, no_holder
from rosmop.run.slices import LIMIT
from rosmop.run.state import (
    KeptGroup,
    encoded,
    guards,
    kept_monitor,
    refused,
    restore,
    shape,
    states_of,
    types_of,
)
from rosmop.run.state_of_runs import StateTooLargeError
from rosmop.run.state_of_slices import SliceParts
from rosmop.run.timers import Agenda, Patience
from rosmop.runtime.action_context import TRIAL_BUDGET, Context
from rosmop.runtime.wire import Buffer, Message
from roswire.definitions import Definitions

_CHANGED = "its text, or the definition of a message, has changed, and its state is lost"


def _never() -> bool:
    return False


class _Tap(Step):
    """Where specifications on trial would stand: it copies the message, and never happens."""

    __slots__ = ()


class Tapped(NamedTuple):
    """A copy of a message for specifications on trial: where it came, as which part of a service, and when."""

    trial: "MonitorSet"
    resource: str
    part: str | None
    data: bytes
    time: int

    def give(self, sender: Sender = NOBODY) -> Outcome:
        """What they would have done with it."""
        if self.part is None:
            return self.trial.process(self.resource, self.data, self.time, sender)
        return self.trial.process_service(self.resource, self.part, self.data, self.time, sender)


class Margin(NamedTuple):
    """How close a comparison of numbers came while it was true (`holds`) or while it was not: its two sides.

    `number` counts the monitor's comparisons in the order of the text; `threshold` is the side that is a constant, 0
    or 1 (None: neither is).
    """

    monitor: str
    number: int
    position: Position
    threshold: int | None
    holds: bool
    left: float
    right: float

    @property
    def distance(self) -> float:
        """How far the sides are apart."""
        return abs(self.left - self.right)

    @property
    def threshold_at(self) -> float | None:
        """Where the constant would have to stand to be reached; None where neither side is one."""
        return None if self.threshold is None else (self.right, self.left)[self.threshold]


class MonitorSet:
    """Specifications in force together."""

    def __init__(
        self,
        compiled: Compiled,
        on_fault: OnFault,
        patience: Patience,
        trials: Sequence["MonitorSet"] = (),
        *,
        fast: FastPath | None = None,
        slices: int = LIMIT,
        deadlines: int = sys.maxsize,
        holder_of: HolderOf = no_holder,
    ) -> None:
        """`compiled` is all of them in their order; what is on trial is in `trials`. `fast` was compiled from the
        others; without it the engine processes every message. At most so many `deadlines` of slices pass at a time.
        Slices are charged to `holder_of` the source whose message makes them (`quota.py`).
        """
        tried = {name for trial in trials for name in trial.names}
        self.names: tuple[str, ...] = tuple(one.name for one in compiled.specifications)
        compiled = compiled.part(frozenset(self.names).difference(tried)) if tried else compiled
        self.trials = trials
        self.tapped: list[Tapped] = []
        self._tapped_ways: frozenset[str] = frozenset()
        self.warnings: tuple[Finding, ...] = compiled.warnings
        self.compiled = compiled
        contexts = {one.context: one.name for one in compiled.specifications}
        self.interpreter = Interpreter(
            compiled.functions, compiled.sites, compiled.types, contexts, compiled.messages
        )
        self.on_fault: OnFault = on_fault
        self.patience = patience
        self._monitors = monitors_of(compiled, self.interpreter, 0, slices, holder_of)
        self.groups = tuple(_groups(compiled, self._monitors))
        self._guards = guards(compiled)
        self._types = types_of(compiled)
        self._beginnings: dict[str, bytes] = {}
        """The state in which those that guard began (`shape`), as far as it is known."""
        self.steps: dict[str, tuple[Step, ...]] = {}
        self._contexts: dict[str, tuple[Context, ...]] = {}
        self._silent: dict[tuple[str, int], Prepared] = {}
        """What is prepared for `judge`, by topic and source."""
        self._execution = Execution(self.interpreter, on_fault)
        self._agenda = Agenda(self._monitors, self._execution, patience, deadlines)
        self.began: tuple[str, ...] = ()
        self._broken = False
        for comparison in (
            comparison
            for specification in compiled.specifications
            for comparison in specification.comparisons
        ):
            for left, right in (comparison.when_true, comparison.when_false):
                self.interpreter.variables |= {left: math.inf, right: 0.0}
        self._index()
        self._lanes = Lanes()
        if fast is not None:
            self._lanes = fast.lanes(compiled, self.interpreter, self._monitors, self._agenda.when_due)
            for group in self.groups:
                group.home = group.monitors[0].home
        # What is replaced goes at once: a garbage collector that had to look for it would hold up all messages.
        for part in (self._agenda, self.interpreter):
            weakref.finalize(self, part.let_go).atexit = False

    @classmethod
    def of(
        cls,
        compiled: Compiled,
        on_fault: OnFault = "drop",
        patience: Patience = lambda: _never,
        *,
        fast: FastPath | None = None,
        trials: Collection[str] = (),
        trial_patience: Patience = lambda: _never,
        slices: int = LIMIT,
        deadlines: int = sys.maxsize,
        holder_of: HolderOf = no_holder,
    ) -> "MonitorSet":
        """Return the set of what was compiled. With one that is named in `trials`, all that share variables are tried.

        `patience()` is asked when something is due: it returns what says whether that has taken too long
        (`trial_patience` for those on trial). A parametric specification has at most so many `slices`.
        """
        tried = []
        for group in compiled.groups(trials):
            trial = cls(
                compiled.part(group),
                on_fault,
                trial_patience,
                slices=slices,
                deadlines=deadlines,
                holder_of=holder_of,
            )
            for monitor in trial._monitors:
                monitor.context.most = TRIAL_BUDGET
            tried.append(trial)
        return cls(
            compiled,
            on_fault,
            patience,
            tried,
            fast=fast,
            slices=slices,
            deadlines=deadlines,
            holder_of=holder_of,
        )

    # What there is

    @property
    def monitors(self) -> tuple[Monitor, ...]:
        """The running specifications, in order, with their state."""
        for monitor in self._monitors:
            monitor.come_home()
        return self._monitors

    @property
    def tried(self) -> tuple[Monitor, ...]:
        """The specifications on trial, with their state."""
        return tuple(monitor for trial in self.trials for monitor in trial.monitors)

    @property
    def topics(self) -> Mapping[str, str]:
        """The topics with events, and their message types."""
        return MappingProxyType(
            {
                step.event.topic: step.event.type
                for monitor in self._monitors
                for step in monitor.steps
                if step.event.part is None and step.event.topic and step.event.type
            }
        )

    @property
    def services(self) -> Mapping[str, str]:
        """The services with events, and their types."""
        return MappingProxyType(
            {
                step.event.topic: step.event.service_type
                for monitor in self._monitors
                for step in monitor.steps
                if step.event.topic and step.event.service_type
            }
        )

    @property
    def publications(self) -> Mapping[str, str]:
        """The topics that specifications publish, or would if they were not on trial, and their message types."""
        sets = (self, *self.trials)
        return MappingProxyType(
            {
                publication.topic: publication.type
                for part in sets
                for publication in part.compiled.publications
            }
        )

    def published_by(self, file: str) -> frozenset[str]:
        """The topics that the specifications of a file publish."""
        return frozenset(
            publication.topic
            for publication in self.compiled.publications
            if publication.position.file == file
        )

    def md5sum(self, message_type: str) -> str:
        """The md5sum of a message type as the specifications understand it."""
        return self.compiled.messages.definitions.md5sum(message_type)

    @property
    def definitions(self) -> Definitions:
        """The definitions that the specifications were compiled against."""
        return self.compiled.messages.definitions

    def wants(self, topic: str) -> bool:
        """Whether an enabled monitor has an event on this topic."""
        return topic in self.steps

    def taps(self, topic: str) -> bool:
        """Whether messages on this topic may be copied into `tapped`."""
        return topic in self._tapped_ways

    def type_of(self, topic: str, *, tried: bool = False) -> str | None:
        """The message type of a topic that `wants`; None where none does, or (unless `tried`) only on trial."""
        steps = self.steps.get(topic, ())
        return next((step.event.type for step in steps if tried or not isinstance(step, _Tap)), None)

    def stamped(self, topic: str) -> bool:
        """Whether the messages of a topic begin with a `std_msgs/Header`, as their type is known here."""
        return self.compiled.is_stamped(self.type_of(topic, tried=True))

    def service_type_of(self, service: str, *, tried: bool = False) -> str | None:
        """The type of a service with an enabled event; None of another, or (unless `tried`) where it is on trial."""
        for part in ("request", "response"):
            for step in self.steps.get(way_of(service, part), ()):
                if tried or not isinstance(step, _Tap):
                    return step.event.service_type
        return None

    def limit_time(self, clock: Callable[[], float], seconds: float) -> None:
        """Bound the processor time that a message may take, over all monitors, by a clock that shows it (seconds).

        The message that takes longer is cut off: that is a fault. The same holds for a tick, a deadline, and for the
        monitors on trial.
        """
        for part in (self, *self.trials):
            part.interpreter.turn.limit(clock, seconds)

    def hurry(self, part: float) -> None:
        """Let messages take this part of the time that `limit_time` gives them."""
        self.interpreter.turn.part = part

    @property
    def late(self) -> bool:
        """Whether the last message, tick or deadline took all of its time."""
        return self.interpreter.turn.late()

    def explain_when(self, asked: Asked, tried: Asked) -> None:
        """Explain only verdicts that are asked for, by themselves and the source of the message; and those on trial."""
        self._execution.asked = asked
        for trial in self.trials:
            trial.explain_when(tried, tried)

    @property
    def area(self) -> memoryview | None:
        """Where to receive frames that walks take without a copy; None where there are no walks."""
        return self._lanes.area

    def contexts(self, topic: str) -> tuple[Context, ...]:
        """What the monitors of a topic have left of their budgets after a message of it."""
        return self._contexts.get(topic, ())

    def walker(self, topic: str) -> FastLane | None:
        """The walk for messages on this topic, or `way_of` a service; None if there is none."""
        return self._lanes.of_topic.get(topic) if topic in self.steps and not self.taps(topic) else None

    def walks(self, walker: FastLane, time_ns: int) -> bool:
        """Whether walks may be used now: nothing is due, no monitor waits for its first message or could not begin."""
        return not self._agenda.has_come(time_ns) and not self._broken and walker.ready()

    def monitor(self, name: str) -> Monitor:
        """A running specification by name; raises KeyError."""
        for monitor in self._monitors:
            if monitor.name == name:
                return monitor
        raise KeyError(name)

    def value(self, name: str, variable: str) -> Any:
        """What a shared variable of a running specification is now; raises KeyError."""
        monitor = self.monitor(name)
        monitor.come_home()
        return self.interpreter.variables[monitor.code.variables[variable]]

    def take_margins(self) -> Iterator[Margin]:
        """How close the comparisons of numbers came since this was asked last: of each that came up in this time, the
        nearest while it was true and the nearest while it was not.
        """
        variables = self.interpreter.variables
        for monitor in self.monitors:
            for number, comparison in enumerate(monitor.code.comparisons):
                for holds, sides in ((True, comparison.when_true), (False, comparison.when_false)):
                    left, right = (variables[name] for name in sides)
                    if not math.isinf(left):
                        variables[sides[0]] = math.inf
                        yield Margin(
                            monitor.name,
                            number,
                            comparison.position,
                            comparison.threshold,
                            holds,
                            left,
                            right,
                        )

    # What is done to them

    def start(
        self, time_ns: int, expected: frozenset[str] | None = None, *, restarted: bool = False
    ) -> Outcome:
        """Begin: first values, `init`, timers. Everything that `init` put out is in the outcome.

        `expected` are the topics that are known to carry messages (of a recording); a specification with events
        on one of them starts its timers with its first message. With `restarted`, specifications with the
        modifier `hold` block their topics until `resume`; none on trial does.
        """
        outcome = self._start(self._monitors, time_ns, expected)
        for monitor in self._monitors if restarted else ():
            monitor.held = monitor.code.hold
        return self._with_trials(outcome, [trial.start(time_ns, expected) for trial in self.trials])

    def state_of(self, group: Group) -> bytes:
        """The state of a group as data; of one that is too large, why it is not kept."""
        try:
            states = [
                kept_monitor(monitor, self.interpreter.variables, self._types[monitor.name])
                for monitor in group.monitors
            ]
            data = encoded(states)
        except StateTooLargeError as error:
            data = refused(str(error))
        group.changed = False
        if group.home is not None:
            group.home.left = False
        return data

    def slice_parts(self, group: Group) -> list[tuple[str, SliceParts]]:
        """Keep the slices of a group's parametric specifications by parts: what they have changed, by name."""
        sliced = [(monitor.name, monitor.slices) for monitor in group.monitors]
        return [(name, SliceParts(slices)) for name, slices in sliced if slices is not None]

    def recover(
        self, kept: Sequence[KeptGroup], lost: Mapping[str, str], time_ns: int, *, restarted: bool = False
    ) -> Outcome:
        """Begin where earlier processes ended: specifications go on with the state that was `kept`, the last of each.

        Those of which the state is `lost` (why; "": of all), or cannot be used, begin; they hold their topics if
        `hold_lost` says so. With `restarted`, those with the modifier `hold` hold them in any case.
        """
        states, slices, unread = states_of(kept)
        fresh, reasons = [], {**lost, **unread}
        for monitor in self._monitors:
            state = states.get(monitor.name)
            if state is None:
                fresh.append(monitor)
                if "" in lost:
                    reasons.setdefault(monitor.name, lost[""])
                continue
            try:
                if (state.identity, state.types) != (monitor.code.identity, self._types[monitor.name]):
                    raise ValueError(_CHANGED)
                restore(
                    monitor,
                    state,
                    slices[monitor.name],
                    self.interpreter.variables,
                    self.compiled,
                    time_ns=time_ns,
                )
            except ValueError as error:
                reasons[monitor.name] = str(error)
                fresh.append(monitor)
        self._index()
        outcome = self._start(fresh, time_ns, None)
        for monitor in fresh:
            if monitor.name in reasons:
                self.hold_lost(monitor, reasons[monitor.name])
        for monitor in self._monitors if restarted else ():
            monitor.held = monitor.held or monitor.code.hold
        return self._with_trials(outcome, [trial.start(time_ns) for trial in self.trials])

    def hold_lost(self, monitor: Monitor, why: str) -> None:
        """The monitor began again because its state is lost: it holds its topics if it is declared `hold`, or acts by a
        state and is not declared `begin`.
        """
        if monitor.code.hold or (monitor.name in self._guards and not monitor.code.begins):
            monitor.hold(why)

    def _start(self, monitors: Sequence[Monitor], time_ns: int, expected: frozenset[str] | None) -> Outcome:
        self.began = tuple(monitor.name for monitor in monitors)
        outcome = self._execution.begin(monitors, time_ns)
        for monitor in monitors:
            monitor.touch()
            if monitor.name in self._guards:
                self._beginnings[monitor.name] = shape(monitor, self.interpreter.variables)
            awaited = expected is not None and any(step.event.topic in expected for step in monitor.steps)
            for timer in monitor.timers:
                timer.due = None if awaited else time_ns + timer.period
        self._broken = any(monitor.broken for monitor in self._monitors)
        self._agenda.schedule()
        return outcome

    def succeed(
        self, before: "MonitorSet", time_ns: int, incomplete: Collection[str] = frozenset()
    ) -> Outcome:
        """Take the place of another set and start; `began` names the specifications that begin with this one.

        Specifications with the same text keep their state, `init` included, unless a message type that they use has
        another definition now. One that begins anew goes on holding its topics if it did and is still declared `hold`.
        What goes on trial, or comes from it, keeps its state as others do; on trial it holds no topic. Those that are
        `incomplete` have not seen all messages on trial: they begin anew when they are not on trial any more.
        """
        known = {
            monitor.name: (monitor, part.interpreter.variables)
            for part in (before, *before.trials)
            for monitor in part.monitors
        }
        departed = {monitor.name for monitor in before.monitors if before.has_departed(monitor)}
        self._beginnings |= before._beginnings
        others = _redefined(before.definitions, self.definitions)
        tried = [trial._follow(known, others, time_ns) for trial in self.trials]
        for monitor in self.tried:
            monitor.resume()
        known = {name: found for name, found in known.items() if name not in incomplete}
        outcome = self._follow(known, others, time_ns)
        for monitor in self._monitors:
            if monitor.name in departed.intersection(self.began):
                self.hold_lost(monitor, _CHANGED)
        was_tried, is_tried = ({monitor.name for monitor in part.tried} for part in (before, self))
        for monitor in (*self._monitors, *self.tried):
            if (monitor.name in was_tried) is not (monitor.name in is_tried):
                monitor.faults = 0
        return self._with_trials(outcome, tried)

    def _follow(
        self, known: Mapping[str, tuple[Monitor, Mapping[str, Any]]], redefined: frozenset[str], time_ns: int
    ) -> Outcome:
        fresh = []
        for monitor in self.monitors:
            earlier, variables = known.get(monitor.name, (None, {}))
            if (
                earlier is not None
                and earlier.code.identity == monitor.code.identity
                and (not redefined or redefined.isdisjoint(monitor.code.reached))
            ):
                self._take_over(monitor, earlier, variables)
            else:
                fresh.append(monitor)
        self._index()
        outcome = self._start(fresh, time_ns, None)
        for monitor in fresh:  # only an operator lets the topics go on
            if monitor.name in known and (earlier := known[monitor.name][0]).held:
                self.hold_lost(monitor, earlier.why_held)
        return outcome

    def has_departed(self, monitor: Monitor) -> bool:
        """Whether a monitor that guards is, or may be, in another state than that in which it began."""
        if monitor.name not in self._guards:
            return False
        beginning = self._beginnings.get(monitor.name)
        return beginning is None or shape(monitor, self.interpreter.variables) != beginning

    def _with_trials(self, outcome: Outcome, tried: Sequence[Outcome]) -> Outcome:
        outcome.tried = tried
        self.began += tuple(name for trial in self.trials for name in trial.began)
        return outcome

    def switch(self, enabled: Mapping[str, bool], time_ns: int) -> tuple[Monitor, ...]:
        """Let the events of monitors happen, or not, and leave unknown names out; the monitors that this changed.

        Time that passed meanwhile does not count: timers and properties with time bounds begin anew.
        """
        changed = [monitor for trial in self.trials for monitor in trial.switch(enabled, time_ns)]
        for monitor in self._monitors:
            wanted = enabled.get(monitor.name, monitor.enabled)
            if wanted is monitor.enabled:
                continue
            changed.append(monitor)
            monitor.come_home()
            monitor.touch()
            monitor.enabled = wanted
            if wanted:
                for timer in monitor.timers:
                    timer.due = time_ns + timer.period
                for running in monitor.properties:
                    if running.code.property.timed:
                        running.begin(time_ns)
                if monitor.slices is not None:
                    monitor.slices.restart(time_ns)
        if changed:
            self._index()
            self._agenda.schedule()
        return tuple(changed)

    def resume(self, name: str) -> None:
        """Let a held specification carry its topics again; raises KeyError."""
        monitor = self.monitor(name)
        monitor.resume()
        monitor.touch()

    # What happens

    def process(self, topic: str, buffer: Buffer, time_ns: int, sender: Sender = NOBODY) -> Outcome:
        """What is to be done with a message: the bytes of its fields, received at this time on this topic."""
        outcome, steps = Outcome(buffer, time_ns), self.steps.get(topic, ())
        if self._agenda.has_come(time_ns):
            outcome.before = self._agenda.advance(time_ns)
        if steps:
            self._execution.message(steps, buffer, outcome, sender)
            self._agenda.schedule()
        return outcome

    def judge(self, topic: str, buffer: Buffer, time_ns: int, sender: Sender = NOBODY) -> Outcome:
        """What `process` says, by the walk where that takes the message: as in the relay."""

        def silent(walker: FastLane) -> Prepared:
            key = topic, sender.source
            if key not in self._silent:
                told = [True] * len(walker.events)
                self._silent[key] = walker.prepare(loud=True, told=told, source=sender.source)
            return self._silent[key]

        taken = self.taken(topic, buffer, time_ns, silent)
        return self.process(topic, buffer, time_ns, sender) if taken is None else taken

    def taken(
        self,
        topic: str,
        buffer: Buffer,
        time_ns: int,
        prepare: Callable[[FastLane], Prepared],
        fuel: int = MESSAGE_FUEL,
    ) -> Outcome | None:
        """What `process` says of a message on a topic, or `way_of` a service, if its lane takes it (`FastLane.take`,
        with what `prepare` says, and so many instructions); None: nothing was done.
        """
        walker = self.walker(topic)
        if walker is None or not self.walks(walker, time_ns):
            return None
        return walker.take(buffer, time_ns, prepare(walker), fuel)

    def process_service(
        self, service: str, part: str, buffer: Buffer, time_ns: int, sender: Sender = NOBODY
    ) -> Outcome:
        """The same for the `request` or `response` (the `part`) of a service."""
        return self.process(way_of(service, part), buffer, time_ns, sender)

    @property
    def next_due(self) -> int | None:
        """When the next tick is due or the next deadline has passed; None if nothing is waited for."""
        return self._agenda.due

    def advance(self, time_ns: int) -> list[Outcome]:
        """Let the ticks up to this time and the deadlines before it happen, in the order of their times."""
        return self._agenda.advance(time_ns)

    # The set

    def _take_over(self, monitor: Monitor, before: Monitor, variables: Mapping[str, Any]) -> None:
        for name, code in monitor.code.variables.items():
            self.interpreter.variables[code] = variables[before.code.variables[name]]
        for running, old in zip(monitor.properties, before.properties, strict=True):
            running.run = old.run
            running.history = running.history.follow(old.history)
        if monitor.slices is not None and before.slices is not None:
            monitor.slices.take_over(before.slices)
            monitor.trail = before.trail
        for step, old_step in zip(monitor.steps, before.steps, strict=True):
            step.past, step.told = old_step.past, old_step.told
        for timer, ticking in zip(monitor.timers, before.timers, strict=True):
            timer.due, timer.ticked = ticking.due, ticking.ticked
        monitor.enabled, monitor.seen = before.enabled, before.seen
        monitor.held, monitor.why_held = before.held, before.why_held
        monitor.broken = before.broken
        monitor.faults = before.faults

    def _index(self) -> None:
        """Which steps a message on which topic, or part of a service, takes."""
        self._silent.clear()
        steps: dict[str, list[Step]] = {}
        standing = {monitor.name: monitor.steps for monitor in self._monitors if monitor.enabled}
        standing |= {trial.names[0]: self._taps(trial) for trial in self.trials}
        for step in (step for name in self.names for step in standing.get(name, ())):
            steps.setdefault(step.event.way or "", []).append(step)
        for found in steps.values():
            acting = [step for step in found if not isinstance(step, _Tap)]
            for place, step in enumerate(acting):
                step.first = not place or acting[place - 1].monitor is not step.monitor
            for step in found if acting else ():
                if isinstance(step, _Tap):
                    step.monitor = acting[0].monitor  # whose state has to come home
        self._tapped_ways = frozenset(
            way for way, found in steps.items() if any(isinstance(step, _Tap) for step in found)
        )
        self.steps = {way: tuple(found) for way, found in steps.items()}
        self._contexts = {
            way: tuple(step.monitor.context for step in found if step.first)
            for way, found in self.steps.items()
        }

    def _taps(self, trial: "MonitorSet") -> tuple[Step, ...]:
        """A tap for each topic and part of a service on which the trial has an enabled event."""
        return tuple(
            _Tap(found[0].monitor, found[0].event, 0, "", self._tap(trial, found[0].event))
            for found in trial.steps.values()
        )

    def _tap(self, trial: "MonitorSet", event: EventCode) -> Callable[[Message | None], bool]:
        resource, part, tapped = event.topic or "", event.part, self.tapped

        def tap(message: Message | None) -> bool:
            assert message is not None  # noqa: S101  no timer stands here
            tapped.append(Tapped(trial, resource, part, bytes(message.buffer), message.time))
            return False

        return tap


def _groups(compiled: Compiled, monitors: Sequence[Monitor]) -> Iterator[Group]:
    for found in groups(compiled.specifications):
        own = tuple(monitors[number] for number in found.specifications)
        ways = {step.event.way for monitor in own for step in monitor.steps if step.event.way is not None}
        group = Group(own, frozenset(ways))
        for monitor in own:
            monitor.group = group
        yield group


def _redefined(before: Definitions, after: Definitions) -> frozenset[str]:
    """The message types that are in both and not the same."""
    if before is after:
        return frozenset()
    both = set(before.message_types) & set(after.message_types)
    return frozenset(name for name in both if before.message(name) != after.message(name))
