"""The running monitors: a message goes in, what is to be done with it comes out. No I/O, no clock.

Theory of operation:

1. `MonitorSet.load` compiles files; `start` gives the variables their first values. A file that is wrong
   changes nothing: the set in force stays.
2. `process` gives a message to the events on its topic, specification by specification in the order they were
   given, event by event in source order. After the action of an event that did not drop the message, every
   property of its specification steps, and the handlers of the categories it is in run. What drops the message
   ends its way; what faults drops it, too, or with `on_fault="pass"` is passed over.
3. Time is what the caller says: nanoseconds, with every message. Ticks (`every`) up to and including the time of
   a message, and deadlines before it, happen first; `process` returns them in `before`. While no message comes,
   the caller calls `advance` when `next_due` has come; a deadline may have been put off since. Ticks that take longer
   than the caller's `patience` allows are left out, and that is logged; deadlines wait for the next time.
4. `walker` offers, for most topics, a walk that does what `process` does to many messages at once (`walks.py`), as
   far as these need nothing that is recorded or explained. Its results differ in nothing but the time that they take.
5. `replaced` makes the set that follows: one swap between two messages. Specifications whose text is the same
   keep their variables and runs.
6. Of a parametric specification each slice that an event belongs to takes its turn, with its own state
   (`slices.py`), as if there were a specification for each.
7. Specifications on trial are sets of their own (`trials`), one for those that share variables: nothing that one does
   or uses up is seen by others. Where the first of such a set would stand among the others, a copy of the message as
   it is there is left in `tapped`; the caller gives it to them when the message is passed on (`Tapped.give`), and what
   comes of it is what would have been done. The copies for one set are given in their order.
"""

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

from appliance.ros.definitions import Definitions
from appliance.rosmop.compile.events import EventCode
from appliance.rosmop.compile.program import connected
from appliance.rosmop.compile.specification import Compiled, compile_files, findings_of
from appliance.rosmop.faults import explain
from appliance.rosmop.logics.interface import Categories, RunFaultError
from appliance.rosmop.monitor import Handler, Monitor, RunningProperty, Step, Timer, monitors_of
from appliance.rosmop.outcomes import DROPPED, Fault, Outcome, Verdict
from appliance.rosmop.positions import Finding, Position
from appliance.rosmop.reach import reached, redefined
from appliance.rosmop.runtime.context import FOLDED_NS, Context, FaultError, LogLine
from appliance.rosmop.runtime.wire import Buffer, Message
from appliance.rosmop.slices import LIMIT, Key, Slice
from appliance.rosmop.syntax import tree
from appliance.rosmop.syntax.errors import SpecificationError
from appliance.rosmop.syntax.parser import parse
from appliance.rosmop.walks import Walker, Walks, walks_of
from appliance.rosmop.why import NOBODY, Bound, Sender, of_slice

OnFault = Literal["drop", "pass"]
Patience = Callable[[], Callable[[], bool]]
Asked = Callable[[Verdict, int], bool]

TRIAL_BUDGET = 100_000
"""Instructions that a specification on trial may spend on one message: what waits meanwhile waits some milliseconds."""

EXPLAINED = 20
"""Verdicts of slices that are explained of those which one message brings about: each takes a millisecond."""

MAX_TICKS = 100_000
"""Ticks of one timer between two messages; a clock that jumps further leaves the rest out, and says so."""


def _never() -> bool:
    return False


def _come_home(monitor: Monitor) -> None:
    """Before Python looks at a monitor's state, or that of others on its topics, it is with Python."""
    if monitor.home is not None:
        monitor.home.leave()


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
        files: Sequence[tree.File],
        on_fault: OnFault,
        patience: Patience,
        trials: Sequence["MonitorSet"] = (),
        *,
        slices: int = LIMIT,
    ) -> None:
        """`files` are all in their order; what is on trial in them is compiled in `trials`."""
        self.files = tuple(files)
        self.trials = trials
        self.tapped: list[Tapped] = []
        self._tapped_topics: frozenset[str] = frozenset()
        self.warnings: tuple[Finding, ...] = compiled.warnings
        self.compiled = compiled
        self._turn = compiled.turn
        self.on_fault: OnFault = on_fault
        self.patience = patience
        nodes = {node.name: node for file in files for node in file.specifications}
        self._order = tuple(nodes)
        self._monitors = monitors_of(
            compiled, [nodes[specification.name] for specification in compiled.specifications], 0, slices
        )
        self.steps: dict[str, tuple[Step, ...]] = {}
        self._contexts: dict[str, tuple[Context, ...]] = {}
        self._requests: dict[tuple[str, str], tuple[Step, ...]] = {}
        self._due: int | None = None
        self.began: tuple[str, ...] = ()
        self._asked: Asked | None = None
        self._sender = NOBODY
        self._bound: Bound | None = None
        self._explains = True
        self._timed = False
        self._walks = Walks()
        self._broken = False
        for comparison in (
            comparison
            for specification in compiled.specifications
            for comparison in specification.comparisons
        ):
            for left, right in (comparison.when_true, comparison.when_false):
                compiled.namespace |= {left: math.inf, right: 0.0}
        self._index()

    @classmethod
    def load(
        cls,
        sources: Mapping[str, str],
        definitions: Definitions,
        on_fault: OnFault = "drop",
        patience: Patience = lambda: _never,
        *,
        trials: Collection[str] = (),
        trial_patience: Patience = lambda: _never,
        margins: bool = False,
        slices: int = LIMIT,
    ) -> "MonitorSet":
        """Compile files (name to text) in this order; raises `SpecificationError` with all that is wrong.

        `patience()` is asked when something is due: what says whether that has taken too long (`trial_patience` for
        those on trial). With one that is named in `trials`, all that share variables with it are on trial. With
        `margins` they note how close comparisons of numbers come (`take_margins`). A parametric specification has at
        most so many `slices`.
        """
        files: list[tree.File] = []
        findings: list[Finding] = []
        for name, text in sources.items():
            try:
                files.append(parse(text, name))
            except SpecificationError as error:
                findings += error.findings
        if findings:
            raise SpecificationError([*findings, *findings_of(files, definitions)])
        compiled = compile_files(files, definitions, margins=margins)
        uses = {specification.name: specification.uses for specification in compiled.specifications}
        groups = [group for group in sharing(uses) if not group.isdisjoint(trials)]
        if not groups:
            return cls(compiled, files, on_fault, patience, slices=slices)
        tried = []
        for group in groups:
            own = _part(files, group)
            trial = cls(
                compile_files(own, definitions, margins=margins), own, on_fault, trial_patience, slices=slices
            )
            for monitor in trial._monitors:
                monitor.context.most = TRIAL_BUDGET
            tried.append(trial)
        others = compile_files(_part(files, set(uses).difference(*groups)), definitions, margins=margins)
        return cls(
            replace(others, warnings=compiled.warnings), files, on_fault, patience, tried, slices=slices
        )

    # What there is

    @property
    def monitors(self) -> tuple[Monitor, ...]:
        """The running specifications, in order, with their state."""
        for monitor in self._monitors:
            _come_home(monitor)
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
        return topic in self._tapped_topics

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
            for step in self._requests.get((service, part), ()):
                if tried or not isinstance(step, _Tap):
                    return step.event.service_type
        return None

    def write_module(self) -> None:
        """Write the module that `walker` offers the walks of."""
        self._walks = walks_of(self.compiled, self._monitors, self._when_due)

    def explain_when(self, asked: Asked, tried: Asked) -> None:
        """Explain only verdicts that are asked for, by themselves and the source of the message; and those on trial."""
        self._asked = asked
        for trial in self.trials:
            trial.explain_when(tried, tried)

    @property
    def area(self) -> memoryview | None:
        """Where to receive frames that walks take without a copy; None where there are no walks."""
        return self._walks.area

    def contexts(self, topic: str) -> tuple[Context, ...]:
        """What the monitors of a topic have left of their budgets after a message of it."""
        return self._contexts.get(topic, ())

    def walker(self, topic: str) -> Walker | None:
        """The walk for messages on this topic; None if there is none."""
        return self._walks.of_topic.get(topic) if topic in self.steps and not self.taps(topic) else None

    def walks(self, walker: Walker, time_ns: int) -> bool:
        """Whether walks may be used now: nothing is due, no monitor waits for its first message or could not begin."""
        return (self._due is None or self._due > time_ns) and not self._broken and walker.ready()

    def monitor(self, name: str) -> Monitor:
        """A running specification by name; raises KeyError."""
        for monitor in self._monitors:
            if monitor.name == name:
                return monitor
        raise KeyError(name)

    def value(self, name: str, variable: str) -> Any:
        """What a shared variable of a running specification is now; raises KeyError."""
        monitor = self.monitor(name)
        _come_home(monitor)
        return self.compiled.namespace[monitor.code.variables[variable]]

    def take_margins(self) -> Iterator[Margin]:
        """How close the comparisons of numbers came since this was asked last: of each that came up in this time, the
        nearest while it was true and the nearest while it was not.
        """
        namespace = self.compiled.namespace
        for monitor in self.monitors:
            for number, comparison in enumerate(monitor.code.comparisons):
                for holds, sides in ((True, comparison.when_true), (False, comparison.when_false)):
                    left, right = (namespace[name] for name in sides)
                    if not math.isinf(left):
                        namespace[sides[0]] = math.inf
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
        outcome = self._start(self._monitors, time_ns, expected, restarted=restarted)
        return self._with_trials(outcome, [trial.start(time_ns, expected) for trial in self.trials])

    def _start(
        self, monitors: Sequence[Monitor], time_ns: int, expected: frozenset[str] | None, *, restarted: bool
    ) -> Outcome:
        outcome = Outcome(time=time_ns)
        self._turn.now = time_ns
        self.began = tuple(monitor.name for monitor in monitors)
        self._begin(monitors, time_ns, outcome)
        for monitor in monitors:
            monitor.held = restarted and monitor.code.hold
            awaited = expected is not None and any(step.event.topic in expected for step in monitor.steps)
            for timer in monitor.timers:
                timer.due = None if awaited else time_ns + timer.period
        self._broken = any(monitor.broken for monitor in self._monitors)
        self._collect(outcome)
        self._schedule()
        return outcome

    def replaced(
        self, sources: Mapping[str, str], definitions: Definitions, time_ns: int
    ) -> tuple["MonitorSet", Outcome]:
        """The set that takes this one's place, started.

        Specifications with the same text keep their state, `init` included, unless a message type that they use has
        another definition now. One that begins anew goes on holding its topics if it did and is still declared
        `hold`. Raises `SpecificationError`, and nothing changed.
        """
        following = MonitorSet.load(sources, definitions, self.on_fault, self.patience)
        return following, following.succeed(self, time_ns)

    def succeed(
        self, before: "MonitorSet", time_ns: int, incomplete: Collection[str] = frozenset()
    ) -> Outcome:
        """Take the place of another set, as `replaced` says; `began` names those that begin with this one.

        What goes on trial, or comes from it, keeps its state as others do; on trial it holds no topic. Those that are
        `incomplete` have not seen all messages on trial: they begin anew when they are not on trial any more.
        """
        known = {
            monitor.name: (monitor, part.compiled)
            for part in (before, *before.trials)
            for monitor in part.monitors
        }
        others = redefined(before.definitions, self.definitions)
        tried = [trial._follow(known, others, time_ns) for trial in self.trials]
        for monitor in self.tried:
            monitor.held = False
        known = {name: found for name, found in known.items() if name not in incomplete}
        outcome = self._follow(known, others, time_ns)
        was_tried, is_tried = ({monitor.name for monitor in part.tried} for part in (before, self))
        for monitor in (*self._monitors, *self.tried):
            if (monitor.name in was_tried) is not (monitor.name in is_tried):
                monitor.faults = 0
        return self._with_trials(outcome, tried)

    def _follow(
        self, known: Mapping[str, tuple[Monitor, Compiled]], redefined: frozenset[str], time_ns: int
    ) -> Outcome:
        fresh = []
        for monitor in self.monitors:
            earlier, compiled = known.get(monitor.name, (None, self.compiled))
            if (
                earlier is not None
                and earlier.node == monitor.node
                and (not redefined or redefined.isdisjoint(reached(monitor.node, self.definitions)))
            ):
                self._take_over(monitor, earlier, compiled)
            else:
                fresh.append(monitor)
        self._index()
        outcome = self._start(fresh, time_ns, None, restarted=False)
        for monitor in fresh:  # only an operator lets the topics go on
            monitor.held = monitor.code.hold and monitor.name in known and known[monitor.name][0].held
        return outcome

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
            _come_home(monitor)
            monitor.enabled = wanted
            if wanted:
                for timer in monitor.timers:
                    timer.due = time_ns + timer.period
                for running in monitor.properties:
                    if running.code.property.timed:
                        running.begin(time_ns)
        if changed:
            self._index()
            self._schedule()
        return tuple(changed)

    def resume(self, name: str) -> None:
        """Let a held specification carry its topics again; raises KeyError."""
        self.monitor(name).held = False

    # What happens

    def process(self, topic: str, buffer: Buffer, time_ns: int, sender: Sender = NOBODY) -> Outcome:
        """What is to be done with a message: the bytes of its fields, received at this time on this topic."""
        return self._process(self.steps.get(topic, ()), buffer, time_ns, sender)

    def judge(self, topic: str, buffer: Buffer, time_ns: int, sender: Sender = NOBODY) -> Outcome:
        """What `process` says, by the walk where that takes the message: as in the relay."""
        walker = self.walker(topic)
        walks = walker is not None and self.walks(walker, time_ns)
        taken = walker.take(buffer, time_ns, sender.source) if walker is not None and walks else None
        if taken is None:
            return self.process(topic, buffer, time_ns, sender)
        outcome = Outcome(buffer, time_ns)
        outcome.events, outcome.log = taken
        return outcome

    def process_service(
        self, service: str, part: str, buffer: Buffer, time_ns: int, sender: Sender = NOBODY
    ) -> Outcome:
        """The same for the `request` or `response` (the `part`) of a service."""
        return self._process(self._requests.get((service, part), ()), buffer, time_ns, sender)

    @property
    def next_due(self) -> int | None:
        """When the next tick is due or the next deadline has passed; None if nothing is waited for."""
        return self._due

    def advance(self, time_ns: int) -> list[Outcome]:
        """Let the ticks up to this time and the deadlines before it happen, in the order of their times."""
        self._sender = NOBODY
        outcomes: list[Outcome] = []
        ticks: dict[int, int] = {}
        over = self.patience()
        self._schedule()  # walks may have moved deadlines on
        while self._due is not None and self._due <= time_ns:
            timer = self._next_timer()
            deadline = self._next_deadline()
            if timer is not None and timer.due is not None and (deadline is None or timer.due <= deadline[0]):
                if timer.due > time_ns:
                    break
                outcomes.append(self._tick(timer, time_ns, ticks))
            elif deadline is not None and deadline[0] < time_ns:
                outcomes.append(self._expire(deadline[1], deadline[2]))
            else:
                break
            self._schedule()
            if self._due is not None and self._due <= time_ns and over():
                outcomes.append(self._leave_out(time_ns))
                self._schedule()
                break
        return outcomes

    # One message

    def _process(self, steps: tuple[Step, ...], buffer: Buffer, time_ns: int, sender: Sender) -> Outcome:
        outcome = Outcome(buffer, time_ns)
        if self._due is not None and self._due <= time_ns:
            outcome.before = self.advance(time_ns)
        if not steps:
            return outcome
        _come_home(steps[0].monitor)
        self._turn.now = time_ns
        self._sender = sender
        message = Message(buffer, time_ns)
        writers: tuple[tuple[Step, Sequence[int]], ...] = ()
        for step in steps:
            if step.first:
                monitor = step.monitor
                monitor.context.budget = monitor.context.most
                if (not monitor.seen or monitor.held) and self._first(monitor, message, outcome):
                    outcome.dropped_by = monitor.name
                    break
            if (self._happen if step.key is None else self._happen_in_slices)(step, message, outcome):
                outcome.dropped_by = step.monitor.name
                break
            if message.touched:
                sites = [site for bit, site in enumerate(message.marks) if message.touched >> bit & 1]
                message.touched = 0
                writers = (*writers, (step, sites))
        self._finish(message, writers, outcome)
        return outcome

    def _happen(self, step: Step, message: Message, outcome: Outcome) -> bool:
        """Give the message to an event; whether it was dropped."""
        try:
            has_happened = step.function(message)
        except Exception as error:  # noqa: BLE001  whatever it is, it is a fault of this action and is recorded
            if self.compiled.module.has_begun(step.event.action_line, error):
                outcome.events = (*outcome.events, step.name)
            self._fault(error, step.monitor, step.event.position, outcome)
            self._block(message, outcome)
            return message.dropped
        if not has_happened:
            if message.past:
                self._past(step, message)
            return False
        outcome.events = (*outcome.events, step.name)
        if message.dropped:
            return True
        if step.monitor.properties:
            self._step_properties(step, message, message.time, outcome)
            return message.dropped
        return False

    def _happen_in_slices(self, step: Step, message: Message, outcome: Outcome) -> bool:
        """Give the message to an event of a parametric specification; whether it was dropped."""
        assert step.key is not None  # noqa: S101  who asks has looked
        try:
            found = step.key(message)
        except Exception as error:  # noqa: BLE001  the bytes are not of its type
            self._fault(error, step.monitor, step.event.position, outcome)
            self._block(message, outcome)
            return message.dropped
        if not found:
            if message.past:
                self._past(step, message)
            return False

        key = (True,) if found is True else tuple(found)
        self._bound = Bound(step.index, step.event.binds, key, message.time, self._sender, step.event.creates)
        happened = step.monitor.slices.step(step.index, key)  # type: ignore[union-attr]  # who has a key has slices
        if happened is not None:
            if happened:
                step.monitor.trail.append(self._bound)
                outcome.events = (*outcome.events, step.name)
            return False

        def act(outcome: Outcome, message: Message | None) -> bool:
            assert message is not None  # noqa: S101  each has one
            if not step.event.plain:
                return self._happen(step, message, outcome)
            outcome.events = (*outcome.events, step.name)
            self._step_properties(step, message, message.time, outcome)
            return message.dropped

        self._each(step, key, message, outcome, act)
        return message.dropped

    def _each(
        self,
        step: Step,
        key: Key,
        message: Message | None,
        outcome: Outcome,
        act: Callable[[Outcome, Message | None], bool],
    ) -> None:
        """Let an event happen in each slice that it belongs to, until one has dropped the message.

        In a slice that lacks a parameter it happens to a copy of the message, and what it puts out is not put out.
        """
        slices = step.monitor.slices
        assert slices is not None  # noqa: S101  who asks has looked
        whole, seeds = slices.targets(step.event, key)
        refused, why = slices.refused, slices.why
        before, verdicts, faults = outcome.events, [*outcome.verdicts], [*outcome.faults]
        names: Sequence[str] = before
        turn, dropped, reached = self._turn, False, 0
        if len(whole) + len(seeds) > 1:
            try:
                step.monitor.context.spend(len(whole) + len(seeds), -1)
            except FaultError as error:
                self._fault(error, step.monitor, step.event.position, outcome)
                self._block(message, outcome)
                return
        for slice_ in whole:
            outcome.events, outcome.verdicts, outcome.faults = before, (), ()
            self._explains = len(verdicts) < EXPLAINED
            dropped = self._in_slice(step.monitor, slice_, outcome, message, act)
            if outcome.events is not before:
                names, reached = outcome.events, reached + 1
            verdicts += outcome.verdicts  # many slices: a tuple would be copied with each
            faults += outcome.faults
            if dropped:
                break
        self._explains = False  # of seeds nothing is told
        for slice_ in () if dropped else seeds:
            unseen = Outcome(time=outcome.time)
            lines, published, looked = len(turn.log), len(turn.published), {**turn.looked}
            copied = None if message is None else Message(bytes(message.buffer), message.time)
            self._in_slice(step.monitor, slice_, unseen, copied, act)
            reached += bool(unseen.events)
            del turn.log[lines:], turn.published[published:]
            turn.looked = looked
            faults += unseen.faults
        self._explains = True
        trail = step.monitor.trail
        if 0 < reached < len(whole) + len(seeds) and trail and trail[-1] is self._bound:
            trail[-1] = self._bound._replace(everywhere=False)
        outcome.events, outcome.verdicts, outcome.faults = names, tuple(verdicts), tuple(faults)
        if refused is not None and not dropped:
            self._refuse_slice(step, refused, why, message, outcome)

    def _in_slice(
        self,
        monitor: Monitor,
        slice_: Slice,
        outcome: Outcome,
        message: Message | None,
        act: Callable[[Outcome, Message | None], bool],
    ) -> bool:
        """Make the slice the state of the monitor and let the event happen; whether the message was dropped."""
        slices = monitor.slices
        assert slices is not None  # noqa: S101  it has a slice
        for running, run in zip(monitor.properties, slices.select(slice_), strict=True):
            running.run = run
        before, monitor.slice = outcome.events, slice_
        dropped = act(outcome, message)
        runs = tuple(running.run for running in monitor.properties)
        slices.settle(slice_, runs, happened=outcome.events is not before)
        return dropped

    def _refuse_slice(
        self,
        step: Step,
        binding: Mapping[str, object],
        why: str,
        message: Message | None,
        outcome: Outcome,
    ) -> None:
        """There can be no slice of what an event binds: that is a fault."""
        monitor = step.monitor
        monitor.faults += 1
        text = f"{why}: {step.name} is not monitored for this binding"
        outcome.faults = (*outcome.faults, Fault(monitor.name, step.event.position, text, binding))
        self._block(message, outcome)

    def _finish(
        self, message: Message, writers: tuple[tuple[Step, Sequence[int]], ...], outcome: Outcome
    ) -> None:
        turn = self._turn
        if turn.log or turn.published or turn.looked:
            self._collect(outcome)
        if message.dropped:
            outcome.result = "dropped"
            outcome.overwritten = message.overwritten
            if outcome.fatal is not None:
                outcome.dropped_at = outcome.fatal.position
            elif message.cause is not None:
                outcome.dropped_at = self.compiled.module.sites[message.cause].position
        elif message.changed:
            outcome.result = "changed"
            outcome.buffer = message.buffer
            sites = self.compiled.module.sites
            outcome.changed_by = tuple([step.name for step, _ in writers])
            outcome.changed_at = tuple([sites[site].position for _, at in writers for site in at])
        if self._timed:
            self._schedule()

    def _first(self, monitor: Monitor, message: Message, outcome: Outcome) -> bool:
        """A message for a monitor that has seen none yet, or that holds its topics; whether it was dropped."""
        if monitor.held:
            outcome.reason = f"{monitor.name} holds its topics until it is resumed"
        elif monitor.broken and self.on_fault == "drop":
            outcome.reason = f"{monitor.name} could not begin: its first values or `init` faulted"
        if outcome.reason is not None:
            outcome.dropped_at = monitor.node.position
            message.dropped = True
            return True
        monitor.seen = True
        for timer in monitor.timers:
            if not timer.ticked:
                timer.due = message.time + timer.period
        return False

    def _step_properties(self, step: Step, message: Message | None, time_ns: int, outcome: Outcome) -> None:
        trail = step.monitor.trail
        if (
            self._bound is not None
            and step.monitor.slices is not None
            and (not trail or trail[-1] is not self._bound)
        ):
            trail.append(self._bound)
        for running in step.monitor.properties:
            try:
                if step.monitor.slices is None:
                    categories = running.history.step(running.run, step.index, time_ns, self._sender)
                else:
                    categories = running.run.step(step.index, time_ns)
            except RunFaultError as error:
                self._fault(error, step.monitor, running.code.property.source.origin, outcome)
                self._block(message, outcome)
                continue
            if categories:
                self._tell(step.monitor, running, categories, message, outcome)

    def _tell(
        self,
        monitor: Monitor,
        running: RunningProperty,
        categories: Categories,
        message: Message | None,
        outcome: Outcome,
        *,
        in_order_told: bool = False,
    ) -> None:
        """Run the handlers of these categories, in source order (after a deadline: in the order they are told)."""
        handlers = [(category, handler) for category, handler in running.handlers if category in categories]
        if in_order_told:
            handlers.sort(key=lambda pair: categories.index(pair[0]))
        self._turn.reset = False
        for category, handler in handlers:
            verdict = self._verdict(monitor, running, category)
            outcome.verdicts = (*outcome.verdicts, verdict)
            published, dropped = len(self._turn.published), message is not None and message.dropped
            self._handle(monitor, handler, message, running, outcome)
            made = [*range(published, len(self._turn.published))]
            if message is not None and message.dropped and not dropped:
                made.append(DROPPED)
            if made:
                outcome.handling = {**outcome.handling, **dict.fromkeys(made, verdict)}
        if self._turn.reset:
            running.begin(self._turn.now)

    def _verdict(self, monitor: Monitor, running: RunningProperty, category: str) -> Verdict:
        source, index = running.code.property.source, running.index
        slices, slice_ = monitor.slices, monitor.slice
        binding = {} if slices is None or slice_ is None else slices.binding(slice_)
        verdict = Verdict(monitor.name, index, source.logic, category, source, binding=binding)
        if self._asked is not None and not self._asked(verdict, self._sender.source):
            return verdict
        if slices is None or slice_ is None:
            return replace(verdict, why=running.history.explain(category))
        if not self._explains:
            return verdict
        why = of_slice(running.code.property, monitor.trail, slices.values(slice_), category)
        return replace(verdict, why=why)

    def _handle(
        self,
        monitor: Monitor,
        handler: Handler,
        message: Message | None,
        running: RunningProperty,
        outcome: Outcome,
    ) -> None:
        try:
            handler(message)
        except Exception as error:  # noqa: BLE001  whatever it is, it is a fault of this handler and is recorded
            self._fault(error, monitor, running.code.property.source.origin, outcome)
            self._block(message, outcome)

    def _block(self, message: Message | None, outcome: Outcome) -> None:
        """What the last fault does to the message."""
        if message is not None and self.on_fault == "drop":
            message.dropped = True
            outcome.fatal = outcome.faults[-1]

    def _fault(self, error: Exception, monitor: Monitor, otherwise: Position, outcome: Outcome) -> None:
        fault: Fault = explain(error, self.compiled.module, monitor.name, otherwise)
        monitor.faults += 1
        outcome.faults = (*outcome.faults, fault)

    def _past(self, step: Step, message: Message) -> None:
        """Count an event that did not happen, and tell it once in a while."""
        step.past += 1
        now = message.time
        if step.told is None or now - step.told >= FOLDED_NS:
            _, index, count = message.past or (0, 0, 0)
            times = "" if step.past == 1 else f" ({step.past} times)"
            text = f"{step.name} did not happen: index {index} is past the end of {count} elements{times}"
            self._turn.log.append(LogLine("WARN", text, step.monitor.name))
            step.told, step.past = now, 0
        message.past = None

    def _collect(self, outcome: Outcome) -> None:
        turn = self._turn
        outcome.log, outcome.published, outcome.looked = turn.log, turn.published, turn.looked
        outcome.sites = self.compiled.module.sites
        turn.log, turn.published, turn.looked = [], [], {}

    # Time

    def _tick(self, timer: Timer, time_ns: int, ticks: dict[int, int]) -> Outcome:
        step = timer.step
        _come_home(step.monitor)
        due = timer.due or 0
        outcome = Outcome(time=due)
        outcome.timer = step.name
        self._turn.now = due
        step.monitor.context.begin()
        timer.ticked = True
        timer.due = due + timer.period

        def act(outcome: Outcome, message: Message | None) -> bool:
            outcome.events = (step.name,)
            try:
                step.function(message)
            except Exception as error:  # noqa: BLE001  whatever it is, it is a fault of this action and is recorded
                self._fault(error, step.monitor, step.event.position, outcome)
            else:
                self._step_properties(step, message, due, outcome)
            return False

        if step.monitor.slices is None:
            act(outcome, None)
        else:
            self._bound = Bound(step.index, (), (True,), due, NOBODY, step.event.creates)
            self._each(step, (True,), None, outcome, act)
            outcome.events = (step.name,)
        ticks[id(timer)] = ticks.get(id(timer), 0) + 1
        if ticks[id(timer)] >= MAX_TICKS and timer.due <= time_ns:
            self._skip_ticks(timer, time_ns, "the time has made a leap")
        self._collect(outcome)
        return outcome

    def _leave_out(self, time_ns: int) -> Outcome:
        """No tick up to this time happens any more."""
        outcome = Outcome(time=time_ns)
        for monitor in self._monitors:
            for timer in monitor.timers:
                if monitor.enabled and timer.due is not None and timer.due <= time_ns:
                    self._skip_ticks(timer, time_ns, "they take too long")
        self._collect(outcome)
        return outcome

    def _skip_ticks(self, timer: Timer, time_ns: int, reason: str) -> None:
        due = timer.due or 0
        left_out = (time_ns - due) // timer.period + 1
        timer.due = due + left_out * timer.period
        text = f"{left_out} ticks of {timer.step.name} are left out: {reason}"
        self._turn.log.append(LogLine("WARN", text, timer.step.monitor.name))

    def _expire(self, monitor: Monitor, running: RunningProperty) -> Outcome:
        _come_home(monitor)
        deadline = running.run.deadline or 0
        word = "timeout" if running.code.property.logic == "tfsm" else "deadline"
        outcome = Outcome(time=deadline)
        outcome.timer = f"{monitor.name}.{word}"
        self._turn.now = deadline
        monitor.context.begin()
        categories = running.history.expire(running.run)
        self._tell(monitor, running, categories, None, outcome, in_order_told=True)
        self._collect(outcome)
        return outcome

    def _next_timer(self) -> Timer | None:
        timers = [
            timer
            for monitor in self._monitors
            if monitor.enabled
            for timer in monitor.timers
            if timer.due is not None
        ]
        return min(timers, key=lambda timer: timer.due or 0, default=None)

    def _when_due(self, *, anew: bool) -> int | None:
        if anew:
            self._schedule()
        return self._due

    def _next_deadline(self) -> tuple[int, Monitor, RunningProperty] | None:
        found: tuple[int, Monitor, RunningProperty] | None = None
        for monitor in self._monitors:
            if monitor.enabled:
                for running in monitor.properties:
                    if running.code.property.timed:
                        _come_home(monitor)
                    deadline = running.run.deadline
                    if deadline is not None and (found is None or deadline < found[0]):
                        found = (deadline, monitor, running)
        return found

    def _schedule(self) -> None:
        """Work out when something is due next. A deadline has passed only after its last nanosecond."""
        if not self._timed:
            return
        timer, deadline = self._next_timer(), self._next_deadline()
        times = [timer.due] if timer is not None and timer.due is not None else []
        if deadline is not None:
            times.append(deadline[0] + 1)
        self._due = min(times, default=None)

    # The set

    def _begin(self, monitors: Sequence[Monitor], time_ns: int, outcome: Outcome) -> None:
        """Constants, first values, `init`: each for all before the next, as one may read another's variables."""
        for monitor in monitors:
            monitor.context.begin()
            for running in monitor.properties:
                running.begin(time_ns)
        self._begin_variables(monitors, outcome)
        for monitor in monitors:
            if monitor.slices is not None:
                codes = [running.code for running in monitor.properties]
                monitor.slices.begin(codes, tuple(running.run for running in monitor.properties))

    def _begin_variables(self, monitors: Sequence[Monitor], outcome: Outcome) -> None:
        beginning = list(monitors)
        for stage in range(3):
            for monitor in tuple(beginning):
                try:
                    self.compiled.namespace[monitor.code.start[stage]]()
                except Exception as error:  # noqa: BLE001  whatever it is, it is a fault of its beginning and is recorded
                    self._fault(error, monitor, monitor.node.position, outcome)
                    monitor.broken = True
                    beginning.remove(monitor)

    def _take_over(self, monitor: Monitor, before: Monitor, compiled: Compiled) -> None:
        for name, code in monitor.code.variables.items():
            self.compiled.namespace[code] = compiled.namespace[before.code.variables[name]]
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
        monitor.enabled, monitor.held, monitor.seen = before.enabled, before.held, before.seen
        monitor.broken = before.broken
        monitor.faults = before.faults

    def _index(self) -> None:
        """Which steps a message on which topic takes."""
        steps: dict[str, list[Step]] = {}
        requests: dict[tuple[str, str], list[Step]] = {}
        standing = {monitor.name: monitor.steps for monitor in self._monitors if monitor.enabled}
        standing |= {trial._order[0]: self._taps(trial) for trial in self.trials}
        for step in (step for name in self._order for step in standing.get(name, ())):
            topic, part = step.event.topic or "", step.event.part
            if part is None:
                steps.setdefault(topic, []).append(step)
            else:
                requests.setdefault((topic, part), []).append(step)
        for found in (*steps.values(), *requests.values()):
            acting = [step for step in found if not isinstance(step, _Tap)]
            for place, step in enumerate(acting):
                step.first = not place or acting[place - 1].monitor is not step.monitor
            for step in found if acting else ():
                if isinstance(step, _Tap):
                    step.monitor = acting[0].monitor  # whose state has to come home
        self._tapped_topics = frozenset(
            topic for topic, found in steps.items() if any(isinstance(step, _Tap) for step in found)
        )
        self.steps = {topic: tuple(found) for topic, found in steps.items()}
        self._requests = {key: tuple(found) for key, found in requests.items()}
        self._contexts = {
            topic: tuple(step.monitor.context for step in found if step.first)
            for topic, found in self.steps.items()
        }
        self._timed = any(
            monitor.timers or any(running.code.property.timed for running in monitor.properties)
            for monitor in self._monitors
        )

    def _taps(self, trial: "MonitorSet") -> tuple[Step, ...]:
        """A tap for each topic and part of a service on which the trial has an enabled event."""
        return tuple(
            _Tap(found[0].monitor, found[0].event, 0, "", self._tap(trial, found[0].event))
            for found in (*trial.steps.values(), *trial._requests.values())
        )

    def _tap(self, trial: "MonitorSet", event: EventCode) -> Callable[[Message | None], bool]:
        resource, part, tapped = event.topic or "", event.part, self.tapped

        def tap(message: Message | None) -> bool:
            assert message is not None  # noqa: S101  no timer stands here
            tapped.append(Tapped(trial, resource, part, bytes(message.buffer), message.time))
            return False

        return tap


def sharing(uses: Mapping[str, Collection[str]]) -> list[set[str]]:
    """Specifications by those that share variables, however indirectly; `uses` says whose each one uses."""
    names = list(uses)
    return [
        {names[number] for number in group} for group in connected([(name, *uses[name]) for name in names])
    ]


def _part(files: Sequence[tree.File], names: Collection[str]) -> list[tree.File]:
    """The files with these of their specifications only."""
    return [
        replace(
            file,
            specifications=tuple(
                specification for specification in file.specifications if specification.name in names
            ),
        )
        for file in files
    ]
