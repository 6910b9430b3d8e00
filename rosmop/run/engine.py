"""The running monitors: `MonitorSet` decides what happens to each message.

The caller gives the time, in nanoseconds, with every message; due ticks and deadlines (`timers.py`) happen
before it, or in `advance`, which the caller calls at `next_due`. A lane of the fast path (`fast_path.py`) has
the same results. Specifications in shadow mode are in separate sets (`shadows`), so that they do not affect
others; after a message is passed on, the caller gives its copies to them (`ShadowCopy.give`).
"""

import math
import sys
import weakref
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import msgspec

from rosmop.form import nodes
from rosmop.form.compiled import Compiled, EventCode, SpecificationCode, Withholding, channel_of
from rosmop.form.findings import Diagnostic
from rosmop.form.specification_groups import groups
from rosmop.run.execution import Asked, MonitorExecution, OnFault
from rosmop.run.fast_path import MESSAGE_FUEL, BatchOptions, FastLane, FastPath, Lanes, Tried
from rosmop.run.guards import guards_of
from rosmop.run.interpreter import Interpreter
from rosmop.run.monitor import MonitorGroup, MonitorInstance, Step, Tap, monitors_of
from rosmop.run.outcomes import NOBODY, SHADOW_BUDGET, Margin, MessageSender, Outcome
from rosmop.run.readout import Readout, read_out
from rosmop.run.slice_quota import HolderOf, no_holder
from rosmop.run.slices import LIMIT
from rosmop.run.state import (
    GroupSnapshot,
    encode,
    encode_refusal,
    kept_monitor,
    restore,
    shape,
    states_of,
    types_of,
)
from rosmop.run.state_of_runs import StateTooLargeError
from rosmop.run.state_of_slices import BUCKETS, SliceParts
from rosmop.run.timers import Agenda, Patience
from rosmop.runtime import safe_messages
from rosmop.runtime.action_context import Context
from rosmop.runtime.wire import Buffer, WireMessage
from rosmop.types.value_types import Value
from roswire.definitions import Definitions

# Measure how close comparisons of numbers came during a replay. Monitors in force do not measure this.


def begin_margins(monitors: Sequence[MonitorInstance], variables: dict[str, Any]) -> None:
    for monitor in monitors:
        for comparison in monitor.code.comparisons:
            for left, right in (comparison.when_true, comparison.when_false):
                variables |= {left: math.inf, right: 0.0}


def taken_margins(monitors: Sequence[MonitorInstance], variables: dict[str, Any]) -> Iterator[Margin]:
    for monitor in monitors:
        for number, comparison in enumerate(monitor.code.comparisons):
            for holds, sides in ((True, comparison.when_true), (False, comparison.when_false)):
                left, right = (variables[name] for name in sides)
                if not math.isinf(left):
                    variables[sides[0]] = math.inf
                    place = monitor.name, number, comparison.position, comparison.threshold
                    yield Margin(*place, holds, left, right)


GivenValues = Mapping[str, Mapping[str, bool | int | float | str]]

_CHANGED = "its text, or the definition of a message, has changed, and its state is lost"


def _never() -> bool:
    return False


class ShadowCopy(NamedTuple):
    """A copy of a message for specifications in shadow mode."""

    shadow: "MonitorSet"
    resource: str
    part: str | None
    data: bytes
    time: int
    altered: bool = False

    def give(self, sender: MessageSender = NOBODY) -> Outcome:
        sender = sender._replace(altered=self.altered)
        if self.part is None:
            return self.shadow.process(self.resource, self.data, self.time, sender)
        return self.shadow.process_service(self.resource, self.part, self.data, self.time, sender)


class KeptGroup:
    """A group of specifications, and its state as data that the caller keeps.

    The state is `base`, perhaps with newer `cells` of `size` bytes. Slices are in parts; `part_names` has the
    specification of each part.
    """

    def __init__(
        self,
        group: MonitorGroup,
        variables: Mapping[str, Value],
        types: Mapping[str, bytes],
        slices: Sequence[tuple[str, SliceParts]],
    ) -> None:
        self._group, self._variables, self._types = group, variables, types
        self._slices = [parts for _, parts in slices]
        self.names = [monitor.name for monitor in group.monitors]
        self.channels = group.channels
        self.part_names = [name for name, _ in slices for _ in range(BUCKETS)]

    @property
    def layout(self) -> bytes:
        return msgspec.msgpack.encode(None if self._group.home is None else self._group.home.names)

    @property
    def size(self) -> int:
        return 0 if self._group.home is None else self._group.home.size

    def cells(self) -> bytes | None:
        """Return the cells (empty if unchanged), or None if `base` and the parts must be kept."""
        if self._group.changed:
            return None
        return b"" if self._group.home is None else self._group.home.cells()

    def base(self) -> bytes:
        group = self._group
        try:
            data = encode([
                kept_monitor(monitor, self._variables, self._types[monitor.name]) for monitor in group.monitors
            ])  # fmt: skip
        except StateTooLargeError as error:
            data = encode_refusal(str(error))
        group.changed = False
        if group.home is not None:
            group.home.left = False
        return data

    def parts(self) -> list[bytes]:
        return [data for parts in self._slices for data in parts.all()]

    def changed_parts(self) -> dict[int, bytes]:
        return {
            place * BUCKETS + number: data
            for place, parts in enumerate(self._slices)
            for number, data in parts.changed_parts().items()
        }


class MonitorSet:
    """Specifications that run together."""

    def __init__(
        self,
        compiled: Compiled,
        on_fault: OnFault,
        patience: Patience,
        shadows: Sequence["MonitorSet"] = (),
        *,
        fast: FastPath | None = None,
        slices: int = LIMIT,
        deadlines: int = sys.maxsize,
        holder_of: HolderOf = no_holder,
    ) -> None:
        """Without `fast` the engine processes every message.

        At most `deadlines` deadlines of slices pass at a time. `holder_of(source)` is charged for slices
        (`slice_quota.py`).
        """
        shadowed = {name for shadow in shadows for name in shadow.names}
        self.names: tuple[str, ...] = tuple(specification.name for specification in compiled.specifications)
        compiled = compiled.part(frozenset(self.names).difference(shadowed)) if shadowed else compiled
        self.shadows = shadows
        self.tapped: list[ShadowCopy] = []
        self._tapped_ways: frozenset[str] = frozenset()
        self.warnings: tuple[Diagnostic, ...] = compiled.warnings
        self.compiled = compiled
        contexts = {specification.context: specification.name for specification in compiled.specifications}
        self.interpreter = Interpreter(
            compiled.functions, compiled.sites, compiled.types, contexts, compiled.messages
        )
        self.on_fault: OnFault = on_fault
        self.patience = patience
        self._monitors = monitors_of(compiled, self.interpreter, 0, slices, holder_of)
        self.interpreter.variables |= {
            given.code: given.default for one in compiled.specifications for given in one.givens
        }
        begin_margins(self._monitors, self.interpreter.variables)
        self.groups = tuple(_groups(compiled, self._monitors))
        self._guards = guards_of(compiled)
        self._stopping = frozenset(_stopping(compiled))
        self._holds = True
        self._types = types_of(compiled)
        self._beginnings: dict[str, bytes] = {}
        self.steps: dict[str, tuple[Step, ...]] = {}
        self._place_of = {name: place for place, name in enumerate(self.names)}
        self._places: dict[str, list[int]] = {}
        self._contexts: dict[str, tuple[Context, ...]] = {}
        self._withheld: dict[str, list[tuple[MonitorInstance, Withholding]]] = {}
        self._silent: dict[str, BatchOptions] = {}
        self._execution = MonitorExecution(self.interpreter, on_fault, self._guards)
        self._agenda = Agenda(self._monitors, self._execution, patience, deadlines)
        self.began: tuple[str, ...] = ()
        self._restarted: Outcome | None = None
        self._broken: frozenset[str] = frozenset()
        self._index()
        self._lanes = Lanes()
        if fast is not None:
            self._lanes = fast.lanes(compiled, self.interpreter, self._monitors, self._agenda.when_due)
            for group in self.groups:
                group.home = group.monitors[0].home
        # Replaced parts are freed at once: a search by the garbage collector would delay all messages.
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
        shadows: Collection[str] = (),
        shadow_patience: Patience = lambda: _never,
        slices: int = LIMIT,
        deadlines: int = sys.maxsize,
        holder_of: HolderOf = no_holder,
    ) -> "MonitorSet":
        """Return a set in which `shadows`, and specifications that share variables with them, are in shadow mode.

        When something is due, `patience()` (in shadow mode: `shadow_patience()`) returns a function that
        returns whether the work takes too long. A parametric specification has at most `slices` slices.
        """
        shadowed = []
        for group in compiled.groups(shadows):
            shadow = cls(
                compiled.part(group),
                on_fault,
                shadow_patience,
                slices=slices,
                deadlines=deadlines,
                holder_of=holder_of,
            )
            shadow._holds = False
            for monitor in shadow._monitors:
                monitor.context.most = SHADOW_BUDGET
            shadowed.append(shadow)
        return cls(
            compiled,
            on_fault,
            patience,
            shadowed,
            fast=fast,
            slices=slices,
            deadlines=deadlines,
            holder_of=holder_of,
        )

    # Queries

    @property
    def monitors(self) -> tuple[MonitorInstance, ...]:
        for monitor in self._monitors:
            monitor.move_to_python()
        return self._monitors

    @property
    def shadowed(self) -> tuple[MonitorInstance, ...]:
        return tuple(monitor for shadow in self.shadows for monitor in shadow.monitors)

    @property
    def topics(self) -> Mapping[str, str]:
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
        sets = (self, *self.shadows)
        return MappingProxyType(
            {
                publication.topic: publication.type
                for part in sets
                for publication in part.compiled.publications
            }
        )

    def published_by(self, file: str) -> frozenset[str]:
        return frozenset(
            publication.topic
            for publication in self.compiled.publications
            if publication.position.file == file
        )

    def md5sum(self, message_type: str) -> str:
        return self.compiled.messages.definitions.md5sum(message_type)

    @property
    def definitions(self) -> Definitions:
        return self.compiled.messages.definitions

    def wants(self, topic: str) -> bool:
        return topic in self.steps

    def taps(self, topic: str) -> bool:
        return topic in self._tapped_ways

    def may_withhold(self, topic: str) -> bool:
        return topic in self._withheld

    def withheld_from(self, topic: str) -> tuple[str, ...]:
        return tuple(
            network
            for monitor, one in self._withheld.get(topic, ())
            if monitor.blocks or self._is_true(monitor, one.condition)
            for network in one.networks
        )

    def withholds(self, monitor: MonitorInstance) -> bool:
        return monitor.enabled and any(
            monitor.blocks or self._is_true(monitor, one.condition) for one in monitor.code.withholdings
        )

    def _is_true(self, monitor: MonitorInstance, variable: str) -> bool:
        if monitor.home is not None:
            return monitor.home.is_true(variable)
        return bool(self.interpreter.variables[variable])

    def type_of(self, topic: str, *, shadowed: bool = False) -> str | None:
        """Return None if the topic has no enabled event. Shadow mode counts only if `shadowed`."""
        steps = self.steps.get(topic, ())
        return next((step.event.type for step in steps if shadowed or not isinstance(step, Tap)), None)

    def is_stamped(self, topic: str) -> bool:
        return self.compiled.is_stamped(self.type_of(topic, shadowed=True))

    def service_type_of(self, service: str, *, shadowed: bool = False) -> str | None:
        for part in ("request", "response"):
            for step in self.steps.get(channel_of(service, part), ()):
                if shadowed or not isinstance(step, Tap):
                    return step.event.service_type
        return None

    def limit_time(self, clock: Callable[[], float], seconds: float) -> None:
        """Bound the processor time of all monitors together for one message; `clock` returns seconds.

        A monitor that exceeds the bound faults. It also holds for ticks, deadlines, and monitors in shadow
        mode.
        """
        self.interpreter.turn.limit(clock, seconds)
        for shadow in self.shadows:  # other messages wait for it
            shadow.interpreter.turn.limit(clock, seconds, 0)

    def hurry(self, part: float) -> None:
        self.interpreter.turn.part = part

    @property
    def late(self) -> bool:
        return self.interpreter.turn.late()

    def name_senders(self, names: Callable[[int], tuple[str, str]]) -> None:
        """Set how the host and the caller id of a source are found; source 0 has neither."""

        def encode(source: int) -> tuple[bytes, bytes]:
            host, caller = names(source) if source else ("", "")
            return host.encode(), caller.encode()

        for part in (self, *self.shadows):
            part.interpreter.turn.names = encode

    def explain_when(self, asked: Asked, shadowed: Asked) -> None:
        """Explain a verdict only if `asked` (in shadow mode: `shadowed`) is true for the message's source."""
        self._execution.asked = asked
        for shadow in self.shadows:
            shadow.explain_when(shadowed, shadowed)

    @staticmethod
    def channel_of(service: str, part: str) -> str:
        return channel_of(service, part)

    @property
    def area(self) -> memoryview | None:
        """Return the memory to receive frames in, so that lanes need no copy, or None without lanes."""
        return self._lanes.area

    def contexts(self, topic: str) -> tuple[Context, ...]:
        return self._contexts.get(topic, ())

    def lane(self, topic: str) -> FastLane | None:
        return self._lanes.of_topic.get(topic) if topic in self.steps and not self.taps(topic) else None

    def lane_ready(self, lane: FastLane, time_ns: int) -> bool:
        """Return whether the fast lane may take the next batch."""
        return not self._agenda.has_come(time_ns) and lane.topic not in self._broken and lane.ready()

    def monitor(self, name: str) -> MonitorInstance:
        for monitor in self._monitors:
            if monitor.name == name:
                return monitor
        raise KeyError(name)

    def value(self, name: str, variable: str) -> Any:
        monitor = self.monitor(name)
        monitor.move_to_python()
        return self.interpreter.variables[monitor.code.variables[variable]]

    def read_out(self, name: str, time_ns: int) -> Readout | None:
        """Return the variables of a monitor, also of one in shadow mode, or None if there is none of this name.

        The state stays where it is, so messages are as fast as before.
        """
        for part in (self, *self.shadows):
            for monitor in part._monitors:
                if monitor.name == name:
                    if monitor.home is not None:
                        monitor.home.show()
                    compiled = part.compiled
                    known = part.interpreter.variables
                    return read_out(monitor.code, known, compiled.types, compiled.messages, time_ns)
        return None

    def take_margins(self) -> Iterator[Margin]:
        """Yield the closest true and false results of comparisons since the last call, if compiled with `margins`."""
        return taken_margins(self.monitors, self.interpreter.variables)

    @staticmethod
    def topics_of(monitors: Iterable[MonitorInstance]) -> frozenset[str]:
        return frozenset(
            step.event.topic for monitor in monitors for step in monitor.steps if step.event.topic
        )

    def replaced_topics(self, before: "MonitorSet | None") -> frozenset[str]:
        """Return the topics of all monitors, in either set, that do not continue unchanged after `succeed`.

        Those in shadow mode count if they have begun.
        """
        earlier = before.monitors if before is not None else ()
        present = {monitor.name for monitor in self._monitors}  # `names` also has those in shadow mode
        kept = {monitor.name for monitor in earlier}.intersection(present) - set(self.began)
        tried = (one for one in self.shadowed if one.name in self.began)
        return self.topics_of((*(one for one in (*earlier, *self._monitors) if one.name not in kept), *tried))

    # Changes

    def start(
        self, time_ns: int, expected: frozenset[str] | None = None, *, restarted: bool = False
    ) -> Outcome:
        """Start, and return the output of `init`.

        A specification with events on a topic in `expected`, which is known to carry messages, starts its timers at
        its first message. With `restarted`, specifications declared `hold` block their topics until `resume`, except
        in shadow mode.
        """
        outcome = self._start(self._monitors, time_ns, expected)
        for monitor in self._monitors if restarted else ():
            monitor.held = monitor.code.hold
            monitor.start_anew()
        self._agenda.schedule()
        return self._with_shadows(outcome, [shadow.start(time_ns, expected) for shadow in self.shadows])

    def kept_groups(self) -> "list[KeptGroup]":
        """Return the groups, and note changes of slices from now on."""
        return [
            KeptGroup(group, self.interpreter.variables, self._types, _slice_parts(group))
            for group in self.groups
        ]

    def recover(
        self, kept: Sequence[GroupSnapshot], lost: Mapping[str, str], time_ns: int, *, restarted: bool = False
    ) -> Outcome:
        """Start with the state of earlier processes: for each specification, the last state in `kept`.

        A specification restarts if its state is unusable, or `lost` (reasons by name, where "" means all).
        `hold_lost` decides whether it holds its topics. With `restarted`, specifications declared `hold`
        always hold them.
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
        for monitor in self._monitors:
            monitor.held = monitor.held or (restarted and monitor.code.hold)
            monitor.start_anew()
        self._agenda.schedule()
        return self._with_shadows(outcome, [shadow.start(time_ns) for shadow in self.shadows])

    def hold_lost(self, monitor: MonitorInstance, why: str) -> None:
        if self.holds_if_lost(monitor.code):
            self.hold(monitor, why)

    def hold(self, monitor: MonitorInstance, why: str) -> None:
        """Drop the messages on the monitor's topics, and send its safe messages, until `resume`."""
        monitor.touch()
        monitor.hold(why)
        self._agenda.schedule()

    def acting(self) -> list[str]:
        """Return the enabled specifications that may stop, change or withhold messages."""
        return [monitor.name for monitor in self._monitors if monitor.enabled and _acts(monitor)]

    def judges(self, topic: str) -> list[str]:
        """Return the specifications with an enabled event on a topic."""
        steps = self.steps.get(topic, ())
        return list(dict.fromkeys(step.monitor.name for step in steps if not isinstance(step, Tap)))

    def holds(self, topic: str) -> bool:
        """Return whether a specification drops the messages of a topic because it cannot judge them now."""
        monitors = (step.monitor for step in self.steps.get(topic, ()) if not isinstance(step, Tap))
        return any(monitor.blocks and topic in monitor.held_channels for monitor in monitors)

    def unfit(self) -> str:
        """Return why one of the specifications that may stop, change or withhold messages cannot judge now, or an
        empty text. Those in shadow mode do not count.
        """
        for monitor in self._monitors:
            if not _acts(monitor):
                continue
            if not monitor.enabled:
                return f"{monitor.name} is disabled"
            if monitor.held:
                return f"{monitor.name} holds its topics{f': {monitor.why_held}' if monitor.why_held else ''}"
            if monitor.broken:
                return f"{monitor.name}: its initial values or `init` faulted"
            if awaits := monitor.awaits:
                return f"{monitor.name} waits until it hears {awaits}"
        return ""

    def stoppers(self, topic: str) -> list[str]:
        return [monitor.name for monitor in self._monitors if monitor.enabled and topic in monitor.safes]

    def is_safe(self, topic: str, data: bytes) -> bool:
        senders = [one.safes[topic] for one in self._monitors if one.enabled and topic in one.safes]
        return any(safe_messages.is_safe(sender.safe, data) for sender in senders)

    def sends_safe(self, name: str, topic: str, data: bytes | bytearray | memoryview) -> bool:
        """Whether these bytes are the safe message of this monitor for the topic."""
        return any(
            one.name == name and topic in one.safes and safe_messages.is_safe(one.safes[topic].safe, data)
            for one in self._monitors
        )

    def safe_message(self, name: str, topic: str, time_ns: int) -> bytes | None:
        """Return the safe message of a specification for a topic, as it is sent at a time; None if it has none."""
        sender = self.monitor(name).safes.get(topic)
        return None if sender is None else safe_messages.to_bytes(sender.safe, time_ns)

    def only_stops(self, event: str) -> bool:
        """Whether the event, named `specification.event`, changes messages only to the safe message."""
        return event in self._stopping

    def stop(self, topic: str) -> None:
        """Send the safe messages until a message comes on the topic."""
        for monitor in self._monitors:
            if monitor.enabled and topic in monitor.safes:
                monitor.starting[topic] = "an operator stopped it"
        self._agenda.schedule()

    def holds_if_lost(self, code: SpecificationCode) -> bool:
        return code.hold or (bool(code.acts_on) and code.name in self._guards.names and not code.begins)

    def identity(self, code: SpecificationCode) -> bytes:
        return code.identity + self._types[code.name]

    def _start(
        self, monitors: Sequence[MonitorInstance], time_ns: int, expected: frozenset[str] | None
    ) -> Outcome:
        self.began = tuple(monitor.name for monitor in monitors)
        for monitor in monitors:
            monitor.move_to_python()
        outcome = self._execution.begin(monitors, time_ns)
        for monitor in monitors:
            monitor.touch()
            if monitor.name in self._guards.names:
                self._beginnings[monitor.name] = shape(monitor, self.interpreter.variables)
            awaited = expected is not None and any(step.event.topic in expected for step in monitor.steps)
            for timer in monitor.timers:
                timer.due = None if awaited else time_ns + timer.period
        self._broken = frozenset().union(
            *(group.channels for group in self.groups if any(one.broken for one in group.monitors))
        )
        if outcome.published:
            self._judge_published(outcome)
        self._agenda.schedule()
        return outcome

    def succeed(
        self, before: "MonitorSet", time_ns: int, incomplete: Collection[str] = frozenset()
    ) -> Outcome:
        """Replace another set between two messages. `began` names the specifications that start with this set.

        Specifications with the same text keep their state, even into and out of shadow mode, without another
        `init`. They restart if the definition of a message type has changed, or if they leave shadow mode and
        are `incomplete`, because they missed messages there. A specification that restarts still holds its
        topics if it is still declared `hold`; in shadow mode it holds none.
        """
        known = {
            monitor.name: (monitor, part.interpreter.variables)
            for part in (before, *before.shadows)
            for monitor in part.monitors
        }
        departed = {monitor.name for monitor in before.monitors if before.has_departed(monitor)}
        self._beginnings |= before._beginnings
        others = _redefined_types(before.definitions, self.definitions)
        shadowed = [shadow._follow(known, others, time_ns) for shadow in self.shadows]
        for monitor in self.shadowed:
            monitor.resume()
        known = {name: found for name, found in known.items() if name not in incomplete}
        outcome = self._follow(known, others, time_ns)
        for monitor in self._monitors:
            if monitor.name in departed.intersection(self.began):
                self.hold_lost(monitor, _CHANGED)
        was_tried, is_tried = ({monitor.name for monitor in part.shadowed} for part in (before, self))
        for monitor in (*self._monitors, *self.shadowed):
            if (monitor.name in was_tried) is not (monitor.name in is_tried):
                monitor.faults = 0
                if monitor.name in was_tried:
                    monitor.start_anew()
        self._agenda.schedule()
        return self._with_shadows(outcome, shadowed)

    def _follow(
        self,
        known: Mapping[str, tuple[MonitorInstance, Mapping[str, Value]]],
        redefined: frozenset[str],
        time_ns: int,
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
        for monitor in fresh:
            if monitor.name in known and self._holds:
                earlier = known[monitor.name][0]
                monitor.start_anew()
                if earlier.held:  # only an operator may release the topics
                    self.hold_lost(monitor, earlier.why_held)
        return outcome

    def has_departed(self, monitor: MonitorInstance) -> bool:
        if monitor.name not in self._guards.names:
            return False
        beginning = self._beginnings.get(monitor.name)
        return beginning is None or shape(monitor, self.interpreter.variables) != beginning

    def _with_shadows(self, outcome: Outcome, shadowed: Sequence[Outcome]) -> Outcome:
        outcome.shadowed = shadowed
        self.began += tuple(name for shadow in self.shadows for name in shadow.began)
        return outcome

    def switch(self, enabled: Mapping[str, bool], time_ns: int) -> tuple[MonitorInstance, ...]:
        """Enable or disable monitors, ignoring unknown names; return the monitors that changed.

        The time while a monitor is disabled does not count: its timers, and its properties with time bounds, restart.
        A monitor that is declared `begin` begins again (`take_restarted`), unless it has slices, because it has missed
        messages. Enabled monitors send their safe messages until the next message on the topic.
        """
        fresh = []
        changed = [monitor for shadow in self.shadows for monitor in shadow.switch(enabled, time_ns)]
        for monitor in self._monitors:
            wanted = enabled.get(monitor.name, monitor.enabled)
            if wanted is monitor.enabled:
                continue
            changed.append(monitor)
            monitor.move_to_python()
            monitor.touch()
            monitor.enabled = wanted
            monitor.starting.clear()
            if wanted:
                for timer in monitor.timers:
                    timer.due = time_ns + timer.period
                for running in monitor.properties:
                    if running.code.property.timed:
                        running.begin(time_ns)
                if monitor.slices is not None:
                    monitor.slices.restart(time_ns)
                elif monitor.code.begins:
                    fresh.append(monitor)
        if fresh:
            self._restarted = self._start_again(fresh, time_ns)
        for monitor in self._monitors:
            if self._holds and monitor.enabled and monitor in changed:
                monitor.start_anew()
        if changed:
            self._index()
            self._agenda.schedule()
        return tuple(changed)

    def take_restarted(self) -> Outcome | None:
        """Return the outcome of monitors that have begun again because they were enabled."""
        outcome, self._restarted = self._restarted, None
        return outcome

    def give(self, values: GivenValues) -> None:
        """Set given constants, and all others to their defaults, without resetting the state.

        Unknown names, and values outside their ranges, are ignored, because the caller has checked them.
        """
        for part in (self, *self.shadows):
            for monitor in part._monitors:
                wanted = values.get(monitor.name, {})
                present = part.interpreter.variables
                for given in monitor.code.givens:
                    value = wanted.get(given.name, given.default)
                    value = given.to_type(value if given.holds(value) else given.default)
                    if present[given.code] != value:
                        monitor.move_to_python()
                        monitor.touch()
                        present[given.code] = value

    def resume(self, name: str) -> None:
        monitor = self.monitor(name)
        monitor.resume()
        monitor.touch()
        for topic in monitor.safes:
            self._execution.forget_events(monitor, topic)
        self._agenda.schedule()

    # Events

    def process(
        self,
        topic: str,
        buffer: Buffer,
        time_ns: int,
        sender: MessageSender = NOBODY,
        *,
        tried: Tried = "",
    ) -> Outcome:
        """Process a message; `tried` is what became of it in the topic's lane, if that has got it before."""
        outcome, steps = Outcome(buffer, time_ns), self.steps.get(topic, ())
        if self._agenda.has_come(time_ns):
            outcome.before = self.advance(time_ns)
        if steps:
            ticked = len(outcome.before)
            lane = None if topic in self._broken or sender.altered else self._lanes.of_topic.get(topic)
            if lane is not None and tried == "left" and lane.whole(buffer):
                lane = None
            over = tried == "over"
            if lane is None or not self._execution.in_module(lane, steps, outcome, sender, over=over):
                self._execution.message(steps, buffer, outcome, sender)
            for deadline in outcome.before[ticked:]:
                self._follow_up(deadline)
            self._follow_up(outcome)
            self._agenda.schedule()
        return outcome

    def judge(self, topic: str, buffer: Buffer, time_ns: int, sender: MessageSender = NOBODY) -> Outcome:
        def silent(lane: FastLane) -> BatchOptions:
            # Not by source: in a recording, each message has its own.
            if topic not in self._silent:
                self._silent[topic] = lane.prepare(loud=True, told=[True] * len(lane.events))
            return self._silent[topic]._replace(source=sender.source)

        lane = self.lane(topic)
        if lane is None or not self.lane_ready(lane, time_ns):
            return self.process(topic, buffer, time_ns, sender)
        taken = lane.process_message(buffer, time_ns, silent(lane))
        if taken is not None:
            return taken
        return self.process(topic, buffer, time_ns, sender, tried="over" if lane.exhausted else "left")

    def process_fast(
        self,
        topic: str,
        buffer: Buffer,
        time_ns: int,
        prepare: Callable[[FastLane], BatchOptions],
        fuel: int = MESSAGE_FUEL,
    ) -> Outcome | None:
        """Return None, and do nothing, unless a lane accepts the message. The topic may be `channel_of` a service."""
        lane = self.lane(topic)
        if lane is None or not self.lane_ready(lane, time_ns):
            return None
        return lane.process_message(buffer, time_ns, prepare(lane), fuel)

    def process_service(
        self, service: str, part: str, buffer: Buffer, time_ns: int, sender: MessageSender = NOBODY
    ) -> Outcome:
        return self.process(channel_of(service, part), buffer, time_ns, sender)

    @property
    def next_due(self) -> int | None:
        return self._agenda.due

    def advance(self, time_ns: int) -> list[Outcome]:
        outcomes = self._agenda.advance(time_ns, self._follow_up)
        self._agenda.schedule()
        return outcomes

    def _follow_up(self, outcome: Outcome) -> None:
        if outcome.faults:
            self._after_faults(outcome)
        if outcome.doubtful:
            self._begin_again([self.monitor(name) for name in outcome.doubtful], outcome)
        if outcome.published:
            self._judge_published(outcome)
        published, faults = len(outcome.published), len(outcome.faults)
        if outcome.timer is not None and self._execution.conclude(outcome):
            self._judge_published(outcome, published)
            if len(outcome.faults) > faults:
                self._after_faults(outcome, faults)

    def _judge_published(self, outcome: Outcome, first: int = 0) -> None:
        """Process published messages with the monitors after their publisher, and the messages that those publish.

        A message that a remedy publishes at a deadline is also processed by its own monitor if that is
        `ordered`. There is still no loop: all other messages only go to later monitors, and new deadlines are
        later than the message.
        """
        judged: dict[int, Outcome] = {}
        for number, message in enumerate(outcome.published[first:], first):
            if message.is_call:
                continue
            places, own = self._places.get(message.topic, ()), self._place_of[message.monitor]
            due = (outcome.timer or "").endswith(".deadline") and self.monitor(message.monitor).code.ordered
            behind = self.steps.get(message.topic, ())[(bisect_left if due else bisect_right)(places, own) :]
            if behind:
                judged[number] = one = Outcome(bytearray(message.data), outcome.time)
                self._execution.message(behind, one.buffer, one, NOBODY, published=True)
                self._follow_up(one)
        if judged:
            outcome.judged = {**outcome.judged, **judged}

    def _after_faults(self, outcome: Outcome, first: int = 0) -> None:
        """Note monitors that cannot judge, because an event that keeps their state up to date has faulted.

        A monitor declared `begin` starts again; any other keeps its state and holds its topics (not in shadow mode).
        Bytes that are not a message belong to no slice, so they end none: its deadlines go on.
        """
        for fault in outcome.faults[first:] if self.on_fault == "drop" else ():
            monitors = [
                self.monitor(name) for name in self._guards.depending[fault.monitor] if fault.outdates
            ]
            holding = [
                one for one in monitors if self._holds and not one.held and self.holds_if_lost(one.code)
            ]
            for monitor in holding:
                self.hold(monitor, f"an event that it depends on had a fault: {fault.position}: {fault.text}")
            outcome.began_holding = (*outcome.began_holding, *(one.name for one in holding))
            if any(one.code.begins for one in monitors):
                again = dict.fromkeys([fault.monitor, *(one.name for one in monitors if one.code.begins)])
                fresh = [one for one in map(self.monitor, again) if one.slices is None or not fault.malformed]
                self._begin_again(fresh, outcome)
                for name in again if self._holds else ():
                    self.monitor(name).start_anew()

    def _begin_again(self, monitors: Sequence[MonitorInstance], outcome: Outcome) -> None:
        outcome.before = [*outcome.before, self._start_again(monitors, outcome.time)]
        for monitor in monitors if self._holds else ():
            monitor.start_anew()

    def _start_again(self, monitors: Sequence[MonitorInstance], time_ns: int) -> Outcome:
        """Start monitors again; each hears its topics first from the node from which it had them before."""
        began = self.began
        outcome = self._start(monitors, time_ns, None)
        self.began = began
        for monitor in monitors:
            monitor.await_sources()
        return outcome

    # The set

    def _take_over(
        self, monitor: MonitorInstance, before: MonitorInstance, variables: Mapping[str, Value]
    ) -> None:
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
        monitor.held, monitor.why_held, monitor.starting = before.held, before.why_held, before.starting
        for topic, sender in monitor.safes.items():
            sender.due = before.safes[topic].due
        for topic, source in monitor.sources.items():
            source.follow(before.sources[topic])
        monitor.broken = before.broken
        monitor.faults = before.faults

    def _index(self) -> None:
        self._silent.clear()
        steps: dict[str, list[Step]] = {}
        standing = {monitor.name: monitor.steps for monitor in self._monitors if monitor.enabled}
        standing |= {shadow.names[0]: self._taps(shadow) for shadow in self.shadows}
        places: dict[str, list[int]] = {}
        for place, step in (
            (place, step) for place, name in enumerate(self.names) for step in standing.get(name, ())
        ):
            steps.setdefault(step.event.channel or "", []).append(step)
            places.setdefault(step.event.channel or "", []).append(place)
        self._places = places
        for found in steps.values():
            acting = [step for step in found if not isinstance(step, Tap)]
            for place, step in enumerate(acting):
                step.first = not place or acting[place - 1].monitor is not step.monitor
            for step in found if acting else ():
                if isinstance(step, Tap):
                    step.monitor = acting[0].monitor  # its state must be copied back to Python
        self._tapped_ways = frozenset(
            channel for channel, found in steps.items() if any(isinstance(step, Tap) for step in found)
        )
        self.steps = {channel: tuple(found) for channel, found in steps.items()}
        self._withheld = {}
        for monitor in self._monitors if self._holds else ():
            for withholding in monitor.code.withholdings if monitor.enabled else ():
                self._withheld.setdefault(withholding.topic, []).append((monitor, withholding))
        self._contexts = {
            channel: tuple(step.monitor.context for step in found if step.first)
            for channel, found in self.steps.items()
        }

    def _taps(self, shadow: "MonitorSet") -> tuple[Step, ...]:
        return tuple(
            Tap(found[0].monitor, found[0].event, 0, "", self._tap(shadow, found[0].event))
            for found in shadow.steps.values()
        )

    def _tap(self, shadow: "MonitorSet", event: EventCode) -> Callable[[WireMessage | None], bool]:
        resource, part, tapped = event.topic or "", event.part, self.tapped

        def tap(message: WireMessage | None) -> bool:
            assert message is not None  # noqa: S101  taps exist only for messages
            tapped.append(
                ShadowCopy(shadow, resource, part, bytes(message.buffer), message.time, message.altered)
            )
            return False

        return tap


def _stopping(compiled: Compiled) -> Iterator[str]:
    for code in compiled.specifications:
        for event in code.events:
            parts = [*nodes.walk(compiled.functions[event.function])]
            writes = any(isinstance(part, nodes.WriteBack) and part.writes for part in parts)
            if not writes and any(isinstance(part, nodes.StopMessage) for part in parts):
                yield f"{code.name}.{event.name}"


def _acts(monitor: MonitorInstance) -> bool:
    return bool(monitor.code.acts_on or monitor.safes or monitor.code.withholdings)


def _slice_parts(group: MonitorGroup) -> list[tuple[str, SliceParts]]:
    sliced = [(monitor.name, monitor.slices) for monitor in group.monitors]
    return [(name, SliceParts(slices)) for name, slices in sliced if slices is not None]


def _groups(compiled: Compiled, monitors: Sequence[MonitorInstance]) -> Iterator[MonitorGroup]:
    for found in groups(compiled.specifications):
        own = tuple(monitors[number] for number in found.specifications)
        channels = {
            step.event.channel for monitor in own for step in monitor.steps if step.event.channel is not None
        }
        group = MonitorGroup(own, frozenset(channels))
        for monitor in own:
            monitor.group = group
        yield group


def _redefined_types(before: Definitions, after: Definitions) -> frozenset[str]:
    if before is after:
        return frozenset()
    both = set(before.message_types) & set(after.message_types)
    return frozenset(name for name in both if before.message(name) != after.message(name))
