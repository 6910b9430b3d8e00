"""Process one message, tick or deadline: events, properties, handlers, faults.

For formulas (`CompiledProperty.suppresses`) a dropped message does not count: in all specifications they undo their
steps, so that their trace has only messages that subscribers saw. Variables, output and other properties keep the
effects. `STOP;`, and a fault of a monitor with a safe message on the topic, replace the message: formulas undo their
steps, and the events after this one process the safe message.
"""

import struct
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import partial
from math import inf
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

from rosmop.form.findings import Position
from rosmop.form.sites import Site, showing
from rosmop.logics.interface import Categories, CostlyRun, RunFaultError
from rosmop.logics.pattern import TimedPattern
from rosmop.run.explain import Bound, of_slice
from rosmop.run.fast_path import FastLane
from rosmop.run.guards import Guards
from rosmop.run.interpreter import Interpreter, LastFailure
from rosmop.run.monitor import Handler, MonitorInstance, RunningProperty, SafeSender, Step, Tap
from rosmop.run.origins import Origin
from rosmop.run.outcomes import DROPPED, FUEL_PER_SECOND, NOBODY, Fault, MessageSender, Outcome, Verdict
from rosmop.run.slices import Key, Slice, Slices, of_nan
from rosmop.runtime import safe_messages
from rosmop.runtime.action_context import (
    FOLDED_NS,
    FaultError,
    LogLine,
    MalformedError,
    OverBudgetError,
    Published,
)
from rosmop.runtime.wire import Buffer, WireMessage
from roswire.counted import counted

OnFault = Literal["drop", "pass"]
Asked = Callable[[Verdict, int], bool]

EXPLAINED = 3
"""The most explained verdicts of slices for one message, or one call with deadlines; each takes a millisecond."""

SLICE_SECONDS = 50e-6

TICK_BUDGET = 2_000


class Due(NamedTuple):
    """A deadline whose remedy has been called, and its categories and its verdict if the due message came."""

    monitor: MonitorInstance
    running: RunningProperty
    slice_: Slice | None
    categories: Categories
    verdict: Verdict


class MonitorExecution:
    """Runs events, properties and handlers on the state of monitors."""

    def __init__(self, interpreter: Interpreter, on_fault: OnFault, guards: Guards) -> None:
        """A fault of an event's function in `guards.judging` only drops the message."""
        self._guards = guards
        self._function: str | None = None
        """The function of the event that runs, or None for a tick or deadline."""
        self.on_fault: OnFault = on_fault
        self.asked: Asked | None = None
        """Chooses the verdicts to explain, given the source of the message; None chooses all."""
        self._interpreter = interpreter
        self._turn = interpreter.turn
        self._sender = NOBODY
        self._bound: Bound | None = None
        self._explains = True
        self._taking_back: dict[int, Callable[[], None]] = {}
        self._trailed: dict[MonitorInstance, int] = {}
        self._copies = False
        self._passed: int | None = None
        self._due: dict[int, Due] = {}
        """The deadlines whose remedies have been called, by the identity of their outcomes (`conclude`)."""

    def begin(self, monitors: Sequence[MonitorInstance], time_ns: int) -> Outcome:
        """Start monitors in common stages (constants, first values, `init`), as one may read another's variables."""
        outcome = Outcome(time=time_ns)
        self._turn.now, self._turn.until = time_ns, inf  # no time limit: operators wait for it
        for monitor in monitors:
            monitor.context.begin()
            for running in monitor.properties:
                running.begin(time_ns)
        self._begin_variables(monitors, outcome)
        for monitor in monitors:
            if monitor.slices is not None:
                codes = [running.code for running in monitor.properties]
                monitor.slices.begin(codes, tuple(running.run for running in monitor.properties))
        self.collect(outcome)
        return outcome

    def message(
        self,
        steps: Sequence[Step],
        buffer: Buffer,
        outcome: Outcome,
        sender: MessageSender,
        *,
        published: bool = False,
    ) -> None:
        """Process a message received at the time of the outcome.

        A message that a monitor has `published` has only the rest of the time of the message that caused it.
        """
        steps[0].monitor.move_to_python()
        steps[0].monitor.touch()
        self._turn.now, self._turn.source = outcome.time, sender.source
        if not published:
            self._turn.begin()
        # An explanation names the source of a message, however the message was changed on its way.
        self._sender = sender._replace(altered=False) if sender.altered else sender
        self._taking_back.clear()
        self._trailed.clear()
        message = WireMessage(
            buffer, outcome.time, steps[0].event.channel, altered=published or sender.altered
        )
        passing: MonitorInstance | None = None
        writers: tuple[tuple[Step, Sequence[int]], ...] = ()
        heard: tuple[tuple[MonitorInstance, Origin], ...] = ()
        for step in steps:
            if step.first:
                monitor = step.monitor
                monitor.context.begin()
                monitor.starting.pop(message.channel or "", None)
                source = monitor.sources.get(message.channel or "")
                if source is not None and (source.waits or source.speakers):
                    if not source.hears(self._node()):
                        passing = monitor
                        continue
                    heard = (*heard, (monitor, source))
                if (not monitor.seen or monitor.blocks) and self._first(monitor, message, outcome):
                    if not message.dropped:
                        passing = monitor
                        continue
                    outcome.dropped_by = monitor.name
                    break
            if step.monitor is passing and not isinstance(step, Tap):
                continue
            self._function, faults = step.event.function, len(outcome.faults)
            if (self._happen if step.key is None else self._happen_in_slices)(step, message, outcome):
                outcome.dropped_by = step.monitor.name
                break
            if message.touched:
                sites = [site for bit, site in enumerate(message.marks) if message.touched >> bit & 1]
                message.touched = 0
                writers = (*writers, (step, sites))
                message.event_ended()
            if message.stopped is not None:
                writers = (*writers, (step, [message.stopped]))
                self._replaced(message)
            passing = self._exhausted(step, outcome.faults[faults:]) or passing
        if heard or outcome.faults:
            self._note_nodes(steps, heard, message.channel or "", outcome)
        self._finish(message, writers, outcome)

    def _exhausted(self, step: Step, faults: Sequence[Fault]) -> MonitorInstance | None:
        """Return the monitor if the message exceeded its budget. Later monitors have the same time again."""
        if not any(fault.over for fault in faults):
            return None
        self._turn.begin()
        return step.monitor

    def in_module(
        self, lane: FastLane, steps: Sequence[Step], outcome: Outcome, sender: MessageSender, *, over: bool
    ) -> bool:
        """Judge a message that the lane was not `ready` for; return False, and do nothing, if the engine has to.

        If it is `over` the fuel of all monitors together, each one has that fuel for itself, and those that it does not
        suffice for have a fault.
        """
        self._sender, turn = sender, self._turn
        turn.now, turn.source = outcome.time, sender.source
        acting = [step.monitor for step in steps if step.first]
        admitted = self._admit(acting, lane.topic)
        if admitted is None:
            return False
        judging, heard = admitted
        whole = FUEL_PER_SECOND * (0.01 if turn.clock is None else turn.seconds * turn.part)
        judge = partial(lane.judge, outcome.buffer, outcome.time, source=sender.source, fuel=int(whole))
        if judging and not over:
            found = judge(judging)
            if found is None and not lane.exhausted:
                return False
            over = found is None
            outcome.events, outcome.log = ((), ()) if found is None else (found.events, found.log)
        if judging and over:
            if turn.clock is None or any(lane.topic in monitor.code.acts_on for monitor in judging):
                return False
            for monitor in judging:
                alone = judge([monitor]) if len(judging) > 1 else None
                if alone is None:
                    self._on_excess(monitor, lane.topic, outcome)
                    continue
                outcome.events = (*outcome.events, *alone.events)
                outcome.log = [*outcome.log, *alone.log]
        for monitor in acting:
            monitor.starting.pop(lane.topic, None)
        for monitor in judging:
            self._see(monitor, outcome.time)
        steps[0].monitor.touch()
        if heard or outcome.faults:
            self._note_nodes(steps, heard, lane.topic, outcome)
        for tap in (step for step in steps if isinstance(step, Tap)):
            tap.function(WireMessage(outcome.buffer, outcome.time, lane.topic))
        return True

    def _admit(
        self, monitors: Sequence[MonitorInstance], channel: str
    ) -> tuple[list[MonitorInstance], list[tuple[MonitorInstance, Origin]]] | None:
        """Return the monitors that judge a message, and those that awaited it; None if one drops it unjudged."""
        node = self._node()
        judging: list[MonitorInstance] = []
        heard: list[tuple[MonitorInstance, Origin]] = []
        for monitor in monitors:
            source = monitor.sources.get(channel)
            if source is not None and not (source.waits or source.speakers):
                source = None
            if source is not None and not source.hears(node):
                continue
            judges, reason = self._judges(monitor, channel)
            if reason is not None:
                return None
            heard += [] if source is None else [(monitor, source)]
            judging += [monitor] if judges else []
        return judging, heard

    def _on_excess(self, monitor: MonitorInstance, channel: str, outcome: Outcome) -> None:
        """Note that a message of an observed topic, of which the monitor has seen nothing, is over its budget.

        The state is that of the message before. It counts on if the ages of all events of the topic do.
        """
        events = [step.event for step in monitor.steps if step.event.channel == channel]
        ages = all(f"age({event.name})" in monitor.code.variables for event in events)
        kept = ages and {*self._guards.depending[monitor.name]} <= {monitor.name}
        text = self._turn.too_late
        if kept:
            text += f"; {monitor.name} goes on with what it knew before, until that is too old"
        monitor.faults += 1
        fault = Fault(monitor.name, events[0].position, text, {}, outdates=not kept, over=True)
        outcome.faults = (*outcome.faults, fault)

    def _note_nodes(
        self,
        steps: Sequence[Step],
        heard: Sequence[tuple[MonitorInstance, Origin]],
        channel: str,
        outcome: Outcome,
    ) -> None:
        node, faulty = self._node(), {fault.monitor for fault in outcome.faults}
        for monitor, awaited in heard:
            if monitor.name not in faulty and not monitor.broken and not awaited.read(node):
                outcome.doubtful = (*outcome.doubtful, monitor.name)
        unreadable = {fault.monitor for fault in outcome.faults if fault.malformed and fault.outdates}
        for step in steps if self.on_fault == "drop" else ():
            source = step.monitor.sources.get(channel)
            if step.first and source is not None and step.monitor.name in unreadable:
                source.doubt(node)

    def tick(self, step: Step, time_ns: int) -> Outcome:
        self._sender, self._function = NOBODY, None
        self._taking_back.clear()
        step.monitor.move_to_python()
        step.monitor.touch()
        outcome = Outcome(time=time_ns)
        outcome.timer = step.name
        self._turn.now = time_ns
        self._turn.begin()
        step.monitor.context.begin()

        def act(outcome: Outcome, message: WireMessage | None) -> bool:
            outcome.events = (step.name,)
            try:
                step.function(message)
            except Exception as error:  # noqa: BLE001  any exception is a recorded fault of this action
                self._fault(error, step.monitor, step.event.position, outcome)
            else:
                self._step_properties(step, message, time_ns, outcome)
            return False

        if step.monitor.slices is None:
            act(outcome, None)
        else:
            self._bound = Bound(step.index, (), (True,), time_ns, NOBODY, step.event.creates)
            self._each(step, (True,), None, outcome, act)
            outcome.events = (step.name,)
        return outcome

    def send_safe(self, monitor: MonitorInstance, sender: SafeSender, time_ns: int) -> Outcome:
        safe = sender.safe
        outcome = Outcome(time=time_ns)
        outcome.timer, outcome.repeated = f"{monitor.name}.safe", sender.due is not None
        data = safe_messages.to_bytes(safe, time_ns)
        outcome.published = [Published(monitor.name, safe.topic, safe.type, data, safe.site)]
        outcome.sites = self._interpreter.sites
        sender.due = time_ns + safe.period_ns
        self._turn.now = time_ns
        self._turn.begin()
        self.forget_events(monitor, safe.topic)
        return outcome

    def forget_events(self, monitor: MonitorInstance, topic: str) -> None:
        """Forget when the monitor's events on a topic happened, because a safe message has taken their place."""
        if monitor.slices is not None:
            return
        monitor.move_to_python()
        monitor.touch()
        for step in monitor.steps:
            happened = monitor.code.variables.get(f"age({step.event.name})")
            if happened is not None and step.event.channel == topic:
                self._interpreter.variables[happened] = -1

    def _node(self) -> str:
        return self._turn.names(self._sender.source)[1].decode(errors="replace")

    def expire(
        self, monitor: MonitorInstance, running: RunningProperty | None, *, explains: bool
    ) -> list[Outcome]:
        """Process the deadline of a property or, without `running`, the first deadline of a slice.

        A slice's verdict is explained only if `explains`.
        """
        self._sender, self._bound, self._function = NOBODY, None, None
        monitor.move_to_python()
        monitor.touch()
        if running is None:
            assert monitor.slices is not None  # noqa: S101  only parametric monitors get None
            self._explains = explains
            outcomes = self._expire_in_slice(monitor, monitor.slices.due)
            self._explains = True
            return outcomes
        outcome = self._expiry(monitor, running.run.deadline or 0, running)
        self._expired(monitor, running, running.history.expire(running.run), outcome)
        self.collect(outcome)
        return [outcome]

    def _expiry(self, monitor: MonitorInstance, deadline: int, running: RunningProperty) -> Outcome:
        word = "timeout" if running.code.property.logic == "tfsm" else "deadline"
        outcome = Outcome(time=deadline)
        outcome.timer = f"{monitor.name}.{word}"
        self._turn.now = deadline
        self._turn.begin()
        monitor.context.begin()
        return outcome

    def _expire_in_slice(self, monitor: MonitorInstance, slice_: Slice) -> list[Outcome]:
        slices = monitor.slices
        assert slices is not None  # noqa: S101  it has a slice
        deadline = slice_.deadline or 0
        number = next(place for place, run in enumerate(slice_.runs) if run.deadline == deadline)
        running = monitor.properties[number]
        outcome = self._expiry(monitor, deadline, running)

        def act(outcome: Outcome, _: WireMessage | None) -> bool:
            self._passed = deadline
            self._expired(monitor, running, running.run.expire(), outcome)
            self._passed = None
            return False

        if not slices.is_whole(slice_):
            self._in_seed(monitor, slice_, outcome, None, act)()
            self.collect(outcome)
            self.conclude(outcome)  # the messages of a seed are discarded
            return []
        commit = self._in_slice(monitor, slice_, outcome, None, act)
        if id(outcome) not in self._due:
            commit()
        else:  # the slice does not end before its deadline is concluded
            slice_.runs, slice_.values = tuple(one.run for one in monitor.properties), slices.own()
        self.collect(outcome)
        return [outcome]

    def _expired(
        self, monitor: MonitorInstance, running: RunningProperty, categories: Categories, outcome: Outcome
    ) -> None:
        """Tell the categories of a deadline, or call its remedy, whose messages all monitors process before."""
        if running.remedy is None:
            self._tell(monitor, running, categories, None, outcome, in_order_told=True)
            return
        verdict, first = self._verdict(monitor, running, categories[0]), len(self._turn.published)
        self._handle(monitor, running.remedy.publish, None, running, outcome)
        outcome.handling = dict.fromkeys(range(first, len(self._turn.published)), verdict)
        slice_ = monitor.slice if monitor.slices is not None else None
        self._due[id(outcome)] = Due(monitor, running, slice_, categories, verdict)

    def conclude(self, outcome: Outcome) -> bool:
        """Judge a deadline with a remedy, once all monitors have processed its messages; return False for any other.

        If the due message did not come, the deadline violates the property.
        """
        if (due := self._due.pop(id(outcome), None)) is None:
            return False
        monitor, running, slice_, categories, verdict = due
        turn, slices = self._turn, monitor.slices
        monitor.move_to_python()
        monitor.touch()
        self._sender, self._bound, self._function = NOBODY, None, None
        turn.now = outcome.time
        turn.begin()
        monitor.context.begin()
        turn.log, turn.published, turn.looked = [*outcome.log], [*outcome.published], {**outcome.looked}

        def act(outcome: Outcome, _: WireMessage | None) -> bool:
            seed = slices is not None and slice_ is not None and not slices.is_whole(slice_)
            if seed or self._is_answered(monitor, running, slice_, outcome):
                known = {verdict.category: verdict}
                self._tell(monitor, running, categories, None, outcome, in_order_told=True, known=known)
                return False
            assert isinstance(running.code.property, TimedPattern)  # noqa: S101  only it has remedies
            running.code.property.refuse(running.run)
            violated = replace(verdict, category="violation")
            handling = outcome.handling.items()
            outcome.handling = {key: violated if one is verdict else one for key, one in handling}
            if "violation" in running.code.handlers:
                known = {"violation": violated}
                self._tell(monitor, running, ("violation",), None, outcome, known=known)
            else:
                outcome.verdicts = (*outcome.verdicts, violated)
            return False

        if slices is None or slice_ is None:
            act(outcome, None)
        elif slices.is_whole(slice_):
            slices.revive(slice_)
            self._in_slice(monitor, slice_, outcome, None, act)()
        else:
            self._in_seed(monitor, slice_, outcome, None, act)()
        self.collect(outcome)
        return True

    def _is_answered(
        self, monitor: MonitorInstance, running: RunningProperty, slice_: Slice | None, outcome: Outcome
    ) -> bool:
        """Whether subscribers got a message, as monitors left it, that the awaited event accepts."""
        remedy = running.remedy
        assert remedy is not None  # noqa: S101  the caller checks this
        for sent in outcome.sent_messages():
            if sent.is_call or sent.topic != remedy.event.topic:
                continue
            message = WireMessage(sent.data, outcome.time, sent.topic)
            try:
                if not remedy.accepts(message):
                    continue
                key: Any = remedy.key(message) if remedy.key is not None else True
            except Exception as error:  # noqa: BLE001  any exception is a recorded fault of the event
                self._fault(error, monitor, remedy.event.position, outcome)
                continue
            if slice_ is None or monitor.slices is None:
                return True
            bound = zip(remedy.event.binds, of_nan((True,) if key is True else tuple(key))[1:], strict=True)
            values = monitor.slices.values(slice_)
            if all(values[number] is value or values[number] == value for number, value in bound):
                return True
        return False

    def _catch_up(self, monitor: MonitorInstance, behind: Sequence[Slice], outcome: Outcome) -> None:
        turn, go_on = self._turn, monitor.context.put_off()
        kept = turn.log, turn.published, turn.looked, self._sender, self._bound, self._function
        turn.log, turn.published, turn.looked = [], [], {}
        before = [*outcome.before]
        self._sender, self._function, self._explains = NOBODY, None, len(behind) <= EXPLAINED
        for slice_ in behind:
            while not slice_.gone and (deadline := slice_.deadline) is not None and deadline < outcome.time:
                before += self._expire_in_slice(monitor, slice_)
        outcome.before, turn.now, self._explains = before, outcome.time, True
        turn.log, turn.published, turn.looked, self._sender, self._bound, self._function = kept
        go_on()

    def warn(self, monitor: MonitorInstance, text: str) -> None:
        self._turn.log.append(LogLine("WARN", text, monitor.name))

    def collect(self, outcome: Outcome) -> None:
        turn = self._turn
        outcome.log, outcome.published, outcome.looked = turn.log, turn.published, turn.looked
        outcome.sites = self._interpreter.sites
        turn.log, turn.published, turn.looked = [], [], {}

    # One event

    def _happen(self, step: Step, message: WireMessage, outcome: Outcome) -> bool:
        try:
            has_happened = step.function(message)
        except Exception as error:  # noqa: BLE001  any exception is a recorded fault of this action
            if self._interpreter.had_happened(error):
                outcome.events = (*outcome.events, step.name)
            self._fault(error, step.monitor, step.event.position, outcome)
            self._block(step.monitor, message, outcome)
            return message.dropped
        if not has_happened:
            if message.past:
                self._past(step, message)
            return False
        outcome.events = (*outcome.events, step.name)
        if message.dropped or message.stopped is not None:
            return message.dropped
        if step.monitor.properties:
            self._step_properties(step, message, message.time, outcome)
            return message.dropped
        return False

    def _happen_in_slices(self, step: Step, message: WireMessage, outcome: Outcome) -> bool:
        assert step.key is not None  # noqa: S101  the caller checks this
        try:
            found = step.key(message)
        except Exception as error:  # noqa: BLE001  the bytes do not fit the message type
            self._fault(error, step.monitor, step.event.position, outcome)
            self._block(step.monitor, message, outcome)
            return message.dropped
        if not found:
            if message.past:
                self._past(step, message)
            return False

        key = (True,) if found is True else tuple(found)
        self._bound = Bound(step.index, step.event.binds, key, message.time, self._sender, step.event.creates)
        slices = step.monitor.slices
        assert slices is not None  # noqa: S101  a step with a key has slices
        if step.event.plain and (slice_ := slices.at(key)) is not None:
            self._mark_slice(slices, slice_)
        if step.event.plain and (happened := slices.step(step.index, key)) is not None:
            if happened:
                self._append_to_trail(step.monitor, self._bound)
                outcome.events = (*outcome.events, step.name)
            return False

        def act(outcome: Outcome, message: WireMessage | None) -> bool:
            assert message is not None  # noqa: S101  each event here has a message
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
        message: WireMessage | None,
        outcome: Outcome,
        act: Callable[[Outcome, WireMessage | None], bool],
    ) -> None:
        """Run an event in each of its slices, until one drops the message.

        A message that exceeds its budget before the last slice has happened in no slice. At a tick each slice has its
        own budget.
        """
        monitor, slices, turn = step.monitor, step.monitor.slices, self._turn
        assert slices is not None  # noqa: S101  the caller checks this
        try:
            found = self._targets(step, slices, key, outcome)
        except OverBudgetError as error:
            self._fault(error, monitor, step.event.position, outcome)
            self._block(monitor, message, outcome)
            return
        refused, why = slices.refused, slices.why
        before, earlier, lines, published = (
            outcome.events, (outcome.verdicts, outcome.faults), len(turn.log), len(turn.published),
        )  # fmt: skip
        events, verdicts, faults = before, [*outcome.verdicts], [*outcome.faults]
        throttled = {**monitor.context.throttled}
        several, reached = len(found) > 1, 0
        commits: list[Callable[[], None]] = []
        self._copies = several and message is not None
        turn.until += SLICE_SECONDS * len(found)
        for slice_ in found:
            outcome.events, outcome.verdicts, outcome.faults = before, (), ()
            self._explains = len(verdicts) < EXPLAINED
            if several and message is None:
                turn.begin()
                monitor.context.begin(TICK_BUDGET)
            commits.append(self._in_one(step, slice_, outcome, message, act))
            if several and message is not None and (cut := _over(outcome.faults)):
                self._cut(monitor, found[: len(commits)])
                del turn.log[lines:], turn.published[published:]
                monitor.context.throttled = throttled
                outcome.events, (outcome.verdicts, outcome.faults) = before, earlier
                outcome.faults = (*outcome.faults, *cut)
                return
            faults += outcome.faults
            verdicts += outcome.verdicts  # for many slices: a tuple would be copied each time
            if outcome.events is not before:
                reached += 1
                events = outcome.events if slices.is_whole(slice_) else events
            if message is None:
                commits.pop()()
            elif message.dropped or message.stopped is not None:
                break
        self._copies = False
        for commit in commits:
            commit()
        self._explains = True
        trail = monitor.trail
        if 0 < reached < len(found) and trail and trail[-1] is self._bound:
            trail[-1] = self._bound._replace(everywhere=False)
        outcome.events, outcome.verdicts, outcome.faults = events, tuple(verdicts), tuple(faults)
        if text := slices.report_forgotten(outcome.time):
            self.warn(monitor, text)
        if refused is not None and (message is None or not message.dropped):
            self._refuse_slice(step, refused, why, message, outcome)

    def _targets(self, step: Step, slices: Slices, key: Key, outcome: Outcome) -> Sequence[Slice]:
        targets = slices.targets(step.event, key, outcome.time, self._sender.source)
        if slices.behind:
            self._catch_up(step.monitor, slices.behind, outcome)
            targets = slices.targets(step.event, key, outcome.time, self._sender.source)
        return targets

    def _cut(self, monitor: MonitorInstance, begun: Sequence[Slice]) -> None:
        """Undo what a message did to formulas; the runs of other properties are copies, which are not stored."""
        for slice_ in begun:
            if (take_back := self._taking_back.pop(id(slice_), None)) is not None:
                take_back()
        if monitor.trail and monitor.trail[-1] is self._bound:
            monitor.trail.pop()
            self._trailed[monitor] -= 1
        self._copies, self._explains = False, True

    def _in_one(
        self,
        step: Step,
        slice_: Slice,
        outcome: Outcome,
        message: WireMessage | None,
        act: Callable[[Outcome, WireMessage | None], bool],
    ) -> Callable[[], None]:
        slices = step.monitor.slices
        assert slices is not None  # noqa: S101  it has a slice
        if message is not None:
            self._mark_slice(slices, slice_)
        if (after := slices.quiet(step.index, slice_)) is not None:
            outcome.events = (*outcome.events, step.name)
            self._note(step.monitor)
            return partial(slices.stand, slice_, after)
        if slices.is_whole(slice_):
            return self._in_slice(step.monitor, slice_, outcome, message, act)
        return self._in_seed(step.monitor, slice_, outcome, message, act)

    def _in_seed(
        self,
        monitor: MonitorInstance,
        slice_: Slice,
        outcome: Outcome,
        message: WireMessage | None,
        act: Callable[[Outcome, WireMessage | None], bool],
    ) -> Callable[[], None]:
        """Run an event in a slice that lacks a parameter, which gets a copy of the message; its output is discarded."""
        turn, explains = self._turn, self._explains
        lines, published, looked = len(turn.log), len(turn.published), {**turn.looked}
        throttled = {**monitor.context.throttled}
        copied = message and WireMessage(
            bytes(message.buffer), message.time, message.channel, altered=message.altered
        )
        self._explains = False
        commit = self._in_slice(monitor, slice_, outcome, copied, act)
        self._explains = explains
        del turn.log[lines:], turn.published[published:]
        monitor.context.throttled = throttled
        turn.looked, outcome.verdicts, outcome.fatal = looked, (), None
        return commit

    def _in_slice(
        self,
        monitor: MonitorInstance,
        slice_: Slice,
        outcome: Outcome,
        message: WireMessage | None,
        act: Callable[[Outcome, WireMessage | None], bool],
    ) -> Callable[[], None]:
        slices = monitor.slices
        assert slices is not None  # noqa: S101  it has a slice
        for running, run in zip(monitor.properties, slices.select(slice_), strict=True):
            copies = self._copies and not running.code.property.suppresses  # the others have marks
            running.run = copy(run) if copies else run
        before, monitor.slice = outcome.events, slice_
        act(outcome, message)
        runs = tuple(running.run for running in monitor.properties)
        return partial(slices.settle, slice_, runs, slices.own(), happened=outcome.events is not before)

    def _refuse_slice(
        self,
        step: Step,
        binding: Mapping[str, object],
        why: str,
        message: WireMessage | None,
        outcome: Outcome,
    ) -> None:
        monitor = step.monitor
        monitor.faults += 1
        text = f"{why}: {step.name} is not monitored for this binding"
        outcome.faults = (*outcome.faults, Fault(monitor.name, step.event.position, text, binding))
        self._block(monitor, message, outcome)

    def _finish(
        self, message: WireMessage, writers: tuple[tuple[Step, Sequence[int]], ...], outcome: Outcome
    ) -> None:
        turn = self._turn
        if turn.log or turn.published or turn.looked:
            self.collect(outcome)
        if message.dropped:
            self._take_back()
            outcome.result = "dropped"
            outcome.overwritten = message.overwritten
            if outcome.fatal is not None:
                outcome.dropped_at = outcome.fatal.position
            elif message.cause is not None:
                outcome.dropped_at = self._interpreter.sites[message.cause].position
        elif message.changed:
            outcome.result = "changed"
            outcome.buffer = message.buffer
            sites = self._interpreter.sites
            outcome.changed_by = tuple([step.name for step, _ in writers])
            outcome.changed_at = tuple([sites[site].position for _, at in writers for site in at])

    def _first(self, monitor: MonitorInstance, message: WireMessage, outcome: Outcome) -> bool:
        """Whether the monitor does not judge the message, because it holds its topics or failed to start.

        It then drops all messages except the safe message, on the topics on which it acts. Messages that it only
        observes pass, and keep its state up to date, unless it has none.
        """
        judges, outcome.reason = self._judges(monitor, message.channel or "")
        if outcome.reason is not None:
            sender = monitor.safes.get(message.channel or "")
            if sender is not None and safe_messages.is_safe(sender.safe, message.buffer):
                outcome.reason = None
                return True
            outcome.dropped_at = monitor.code.position
            message.dropped = True
            return True
        if judges:
            self._see(monitor, message.time)
        return not judges

    def _judges(self, monitor: MonitorInstance, channel: str) -> tuple[bool, str | None]:
        """Return whether the monitor judges messages of the channel, and if it drops them, why."""
        broken = monitor.broken and self.on_fault == "drop"
        if channel not in monitor.held_channels:
            return not broken, None
        if monitor.held:
            why = f" ({monitor.why_held})" if monitor.why_held else ""
            return False, f"{monitor.name} holds its topics until it is resumed{why}"
        if monitor.blocks:
            return False, f"{monitor.name} holds its topics until it has heard {monitor.awaits}"
        if broken:
            return False, f"{monitor.name} could not start: its initial values or `init` faulted"
        return True, None

    def _see(self, monitor: MonitorInstance, time_ns: int) -> None:
        """Note that the monitor judges a message; before the first one, its timers do not run."""
        for timer in () if monitor.seen else monitor.timers:
            if not timer.ticked:
                timer.due = time_ns + timer.period
        monitor.seen = True

    def _note(self, monitor: MonitorInstance) -> None:
        if self._bound is not None and (not monitor.trail or monitor.trail[-1] is not self._bound):
            self._append_to_trail(monitor, self._bound)

    def _step_properties(
        self, step: Step, message: WireMessage | None, time_ns: int, outcome: Outcome
    ) -> None:
        if step.monitor.slices is not None:
            self._note(step.monitor)
        for running in step.monitor.properties:
            run = running.run
            try:
                if isinstance(run, CostlyRun):
                    self._turn.check()
                if step.monitor.slices is None:
                    if running.code.property.suppresses and id(run) not in self._taking_back:
                        self._taking_back[id(run)] = running.mark()
                    categories = running.history.step(run, step.index, time_ns, self._sender)
                else:
                    categories = run.step(step.index, time_ns)
            except (RunFaultError, OverBudgetError) as error:
                self._fault(error, step.monitor, running.code.property.source.origin, outcome)
                self._block(step.monitor, message, outcome)
                continue
            finally:
                if isinstance(run, CostlyRun):
                    self._turn.spent += run.work
            if categories:
                self._tell(step.monitor, running, categories, message, outcome)

    def _mark_slice(self, slices: Slices, slice_: Slice) -> None:
        if slices.suppresses and id(slice_) not in self._taking_back:
            self._taking_back[id(slice_)] = slices.mark(slice_)

    def _append_to_trail(self, monitor: MonitorInstance, bound: Bound) -> None:
        monitor.trail.append(bound)
        self._trailed[monitor] = self._trailed.get(monitor, 0) + 1

    def _take_back(self) -> None:
        for take_back in reversed(self._taking_back.values()):
            take_back()
        for monitor, entries in self._trailed.items():
            for place in range(max(-entries, -len(monitor.trail)), 0):
                monitor.trail[place] = monitor.trail[place]._replace(passed=False)

    def _tell(
        self,
        monitor: MonitorInstance,
        running: RunningProperty,
        categories: Categories,
        message: WireMessage | None,
        outcome: Outcome,
        *,
        in_order_told: bool = False,
        known: Mapping[str, Verdict] = MappingProxyType({}),
    ) -> None:
        handlers = [(category, handler) for category, handler in running.handlers if category in categories]
        if in_order_told:
            handlers.sort(key=lambda pair: categories.index(pair[0]))
        self._turn.reset = False
        for category, handler in handlers:
            verdict = known.get(category) or self._verdict(monitor, running, category)
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

    def _verdict(self, monitor: MonitorInstance, running: RunningProperty, category: str) -> Verdict:
        source, index = running.code.property.source, running.index
        slices, slice_ = monitor.slices, monitor.slice
        binding = {} if slices is None or slice_ is None else slices.binding(slice_)
        verdict = Verdict(monitor.name, index, source.logic, category, source, binding=binding)
        if self.asked is not None and not self.asked(verdict, self._sender.source):
            return verdict
        if self._turn.late():
            return verdict
        if slices is None or slice_ is None:
            return replace(verdict, why=running.history.explain(category))
        if not self._explains:
            return verdict
        why = of_slice(running.code.property, monitor.trail, slices.values(slice_), category, self._passed)
        return replace(verdict, why=why)

    def _handle(
        self,
        monitor: MonitorInstance,
        handler: Handler,
        message: WireMessage | None,
        running: RunningProperty,
        outcome: Outcome,
    ) -> None:
        try:
            handler(message)
        except Exception as error:  # noqa: BLE001  any exception is a recorded fault of this handler
            self._fault(error, monitor, running.code.property.source.origin, outcome)
            self._block(monitor, message, outcome)

    def _block(self, monitor: MonitorInstance, message: WireMessage | None, outcome: Outcome) -> None:
        """Drop or replace the message of a fault. One that is over its budget reaches others if it is only observed."""
        if message is None or self.on_fault != "drop":
            return
        if outcome.faults[-1].over and message.channel not in monitor.code.acts_on:
            return
        sender = monitor.safes.get(message.channel or "")
        if sender is not None:
            message.stop(sender.safe, sender.safe.site)
            self.forget_events(monitor, sender.safe.topic)
            return
        message.dropped = True
        outcome.fatal = outcome.faults[-1]

    def _replaced(self, message: WireMessage) -> None:
        """Continue with the safe message: for formulas, the replaced message has not happened.

        If earlier monitors have used up the time of the message, later ones have the same time again.
        """
        self._take_back()
        self._taking_back.clear()
        self._trailed.clear()
        message.event_ended()
        message.stopped = None
        if self._turn.late():
            self._turn.begin()

    def _fault(
        self, error: Exception, monitor: MonitorInstance, otherwise: Position, outcome: Outcome
    ) -> None:
        fault: Fault = _fault_of(error, self._interpreter, monitor.name, otherwise)
        # Bytes on an observed topic that are not a message may stand for one that would have changed the state; on
        # other topics they reach no subscriber.
        malformed, function = isinstance(error, MalformedError | struct.error), self._function
        outdates = function in self._guards.observing if malformed else function not in self._guards.judging
        fault = replace(
            fault, outdates=outdates, malformed=malformed, over=isinstance(error, OverBudgetError)
        )
        monitor.faults += 1
        outcome.faults = (*outcome.faults, fault)

    def _past(self, step: Step, message: WireMessage) -> None:
        step.past += 1
        now = message.time
        if step.told is None or now - step.told >= FOLDED_NS:
            _, index, count = message.past or (0, 0, 0)
            times = "" if step.past == 1 else f" ({step.past} times)"
            text = f"{step.name} did not happen: index {index} is past the end of {counted(count, 'element')}{times}"
            self.warn(step.monitor, text)
            step.told, step.past = now, 0
        message.past = None

    def _begin_variables(self, monitors: Sequence[MonitorInstance], outcome: Outcome) -> None:
        beginning = list(monitors)
        for stage in range(3):
            for monitor in tuple(beginning):
                try:
                    self._interpreter.function(monitor.code.start[stage])()
                except Exception as error:  # noqa: BLE001  any exception is a recorded fault of the start
                    self._fault(error, monitor, monitor.code.position, outcome)
                    monitor.broken = True
                    beginning.remove(monitor)


def _over(faults: Sequence[Fault]) -> list[Fault]:
    return [fault for fault in faults if fault.over]


def _fault_of(error: Exception, interpreter: Interpreter, monitor: str, otherwise: Position) -> Fault:
    failed = interpreter.failed if error is interpreter.failed.error else LastFailure()
    interpreter.failed = LastFailure()  # the error refers to its callers, and so to much other data
    site = interpreter.sites[failed.site] if failed.site >= 0 else Site(otherwise)
    values = {}
    for variable in site.variables:
        try:
            value = interpreter.value(variable.code, failed.variables)
        except KeyError:  # the variable has no value yet
            continue
        values[variable.name] = showing(variable.type)(value)
    return Fault(monitor, site.position, _text(error), values)


def _text(error: Exception) -> str:
    if isinstance(error, FaultError):
        return error.text
    if isinstance(error, RunFaultError):
        return str(error)
    if isinstance(error, MalformedError):
        return f"the bytes are not a message of this type: {error}"
    if isinstance(error, struct.error):
        return "the bytes are not a message of this type: it ends before its last field"
    return f"{type(error).__name__}: {error}"
