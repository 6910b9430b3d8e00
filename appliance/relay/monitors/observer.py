"""Count the actions of monitors, and turn outcomes into reports to control (`observations`).

A change by several monitors is one record under the last of them, but counts for each of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from msgspec.structs import replace

from appliance.base.varying_numbers import without_numbers
from appliance.channel.messages import MonitorRow
from appliance.relay.monitors.fast_path_counts import FastPathCounts
from appliance.relay.monitors.observation_points import NOWHERE, ObservationPoint, ObservedMessage, Senders
from appliance.relay.monitors.observations import LONGEST_TEXT, SHOWN, Observations
from rosmop.run.outcomes import (
    Outcome,
    Verdict,
    label_of,
    of_change,
    of_drop,
    of_fault,
    of_published,
    of_verdict,
)

if TYPE_CHECKING:
    from rosmop.run.engine import MonitorSet
    from rosmop.run.outcomes import Published

_EXPLAINED = 10
CAUSE = "stopped: "
"""The beginning of a line that has the cause of a stop."""
_SILENCE = "no message "
_LINE_NS = 2_000_000_000
"""How long a monitor's last cause explains its next stop; it is printed when it changes, or once a second."""
_MAX_STOPPING = 1000
_PUBLISHERS = 8
"""The most publishers that the report of a stop names."""


@dataclass
class _Second:
    """The points that this second's reports show, and the number of reports with causes."""

    shown: set[ObservationPoint] = field(default_factory=set)
    explained: int = 0


class Observer:
    """Counts and reports actions of monitors. The kinds of reports begin with `prefix`, which marks shadow mode."""

    def __init__(
        self,
        observations: Observations,
        publish: Callable[[Published], None],
        senders: Senders,
        prefix: str = "",
        *,
        held: Callable[[], None] = lambda: None,
        now: Callable[[], int] = lambda: 0,
        bound: float = math.inf,
        publishers: Callable[[str], Sequence[ObservationPoint]] = lambda _topic: (),
    ) -> None:
        """`held()` is called when monitors have begun to hold their topics.

        `now()` is the monitors' time. A tick is late `bound` seconds after it was due.
        `publishers(topic)` returns the nodes that publish a topic now.
        """
        self._held, self._now, self._bound = held, now, bound
        self._publishers = publishers
        self.failed = ""
        """The last fault, or delay beyond the bound, of a monitor that acts, since `take_failed`."""
        self._monitors: MonitorSet | None = None
        self.senders = senders
        self._second = _Second()
        self._observations = observations
        self._publish = publish
        self._prefix = prefix
        self._counters: dict[str, MonitorRow] = {}
        self._happened: dict[tuple[str, ...], int] = {}
        self._again: dict[tuple[tuple[str, ...], ObservationPoint, bool], int] = {}
        self._stopping: dict[tuple[tuple[str, ...], ObservationPoint], bool] = {}
        """Whether the last change that was compared, by its events and point, was a stop: the module only counts."""
        self._causes: dict[str, tuple[int, str]] = {}
        self._unjudged: dict[str, dict[str, tuple[int, str]]] = {}
        """By monitor and topic that it observes: when a message was last over its budget, and in words."""
        self._owed: list[FastPathCounts] = []

    def take(self, monitors: MonitorSet) -> None:
        self._monitors = monitors

    def keep(self, names: list[str], began: list[str], time: int) -> None:
        self._sum_up(time)
        for known in (self._causes, self._unjudged):
            for name in known.keys() - {*names}:
                del known[name]
        self._counters = {name: MonitorRow(name) if name in began else self._counter(name) for name in names}

    def shows(self, point: ObservationPoint) -> bool:
        return point not in self._second.shown

    def hides_drop(self, monitor: str, point: ObservationPoint) -> bool:
        return self._observations.was_reported("drop", monitor, point)

    def hides_verdict(self, verdict: Verdict, point: ObservationPoint) -> bool:
        return self._observations.was_reported("verdict", verdict.monitor, point, label_of(verdict))

    def asks(self, verdict: Verdict, source: int) -> bool:
        """Return whether to explain a verdict: at most `_EXPLAINED` a second, of those reported in full."""
        point = self.senders.point(source) or NOWHERE
        kind = f"{self._prefix}verdict"
        if (
            self._observations.was_reported(kind, verdict.monitor, point, label_of(verdict))
            or self._second.explained >= _EXPLAINED
        ):
            return False
        self._second.explained += 1
        return True

    def count_times(
        self, monitors: Iterable[str], what: str, count: int, longest: float, late: int | None = None
    ) -> None:
        """Count what monitors did; `longest` is the longest delay in seconds, `late` the number beyond the bound."""
        beyond = count * (longest > self._bound) if late is None else late
        for name in monitors:
            row = self._counter(name)
            row.timed += count
            row.late += beyond
            row.latest = max(row.latest, longest)
            if beyond and self._acts(name):
                self.failed = (
                    f"{name}: {what} came {longest * 1e3:.0f} ms late (limit {self._bound * 1e3:g} ms)"
                )

    def take_failed(self) -> str:
        failed, self.failed = self.failed, ""
        return failed

    def collect_later(self, counts: FastPathCounts) -> None:
        counts.begun = True
        self._owed.append(counts)

    def report(
        self, outcome: Outcome, point: ObservationPoint, observed: ObservedMessage | None = None
    ) -> None:
        """Publish an outcome's messages before reporting anything: a stop must not wait for a report."""
        self._send(outcome)
        self._report(outcome, point, observed)

    def _report(
        self, outcome: Outcome, point: ObservationPoint, observed: ObservedMessage | None = None
    ) -> None:
        for earlier in outcome.before:
            self._report(earlier, NOWHERE)
        if outcome.began_holding:
            self._held()
        if outcome.events:
            events = tuple(outcome.events)
            self._happened[events] = self._happened.get(events, 0) + 1
        self._verdicts(outcome, point, observed)
        self._faults(outcome, point, observed)
        for line in outcome.log:
            if line.text.startswith(CAUSE):  # also with a command to stand, which a stop does not change
                self._causes[line.monitor] = outcome.time, line.text.removeprefix(CAUSE)
            self.report_line(
                line.monitor, line.level, line.text, point=point, time=outcome.time, observed=observed
            )
        for number, published in enumerate(outcome.published):
            self._on_publication(outcome, number, point, observed)
            if (judged := outcome.judged.get(number)) is not None:
                self._judged(judged, _of_publication(point, published.topic), published.data)

    def _on_publication(
        self, outcome: Outcome, number: int, point: ObservationPoint, observed: ObservedMessage | None
    ) -> None:
        published = outcome.published[number]
        kind = f"{self._prefix}{'call' if published.is_call else 'publish'}"
        target = _of_publication(point, published.topic)
        safe = self._is_safe(published.monitor, published.topic, published.data)
        if outcome.repeated:
            self._observations.add(
                kind, published.monitor, target, outcome.time, 1, first=outcome.time, safe=safe
            )
            return
        self._observations.note(
            kind,
            published.monitor,
            target,
            outcome.time,
            f"{published.type} on {published.topic}",
            safe=safe,
            detail={
                "because_of": point.resource,
                **of_published(outcome, number, self._who),
                **(self._cause(outcome, published.monitor, published.topic) if safe else {}),
            },
            observed=observed,
            after=published.data[:SHOWN],
            size=len(published.data),
        )

    def _is_safe(self, monitor: str, topic: str, data: bytes | bytearray | memoryview) -> bool:
        monitors = self._monitors
        return not self._prefix and monitors is not None and monitors.sends_safe(monitor, topic, data)

    def _acts(self, monitor: str) -> bool:
        return bool(self._monitors and not self._prefix and monitor in self._monitors.acting())

    def _only_stops(self, event: str) -> bool:
        return bool(self._monitors and not self._prefix and self._monitors.only_stops(event))

    def _cause(self, outcome: Outcome, monitor: str, topic: str) -> Mapping[str, object]:
        """Return why a monitor stops a topic, and its publishers, if a timer led to it."""
        cause = self._words(outcome, monitor, topic)
        nodes = [] if outcome.timer is None else self._publishers(topic)[:_PUBLISHERS]
        found: list[dict[str, object]] = [{"node": node.caller_id, "host": node.host} for node in nodes]
        if outcome.timer is not None and not nodes and (last := self.senders.last(topic)) is not None:
            found = [{"node": last.caller_id, "host": last.host, "ended": True}]
        return {**({"cause": cause} if cause else {}), **({"publishers": found} if found else {})}

    def _words(self, outcome: Outcome, monitor: str, topic: str) -> str:
        """Return the cause of a stop: a fault, why the monitor cannot judge, or its own line."""
        assert self._monitors is not None  # noqa: S101  they have stopped it
        instance = self._monitors.monitor(monitor)
        faults = [fault.text for fault in outcome.faults if fault.monitor == monitor]
        own = own_cause(outcome, monitor)
        if faults:
            return f"a message of {topic} could not be judged: {faults[-1]}"
        if instance.held or instance.broken:
            why = f": {instance.why_held}" if instance.why_held else ""
            return (
                f"it holds its topics until an operator resumes it{why}"
                if instance.held
                else "its start had a fault"
            )
        awaited = {
            on: f"no readable message from {', '.join(self._sender(node, on) for node in source.awaited)} on {on}"
            " since the guard began again"
            for on, source in sorted(instance.sources.items(), key=lambda each: not each[1].unreadable)
            if source.awaited
        }
        said, cause = self._causes.get(monitor, (-_LINE_NS, ""))
        waits = instance.blocks or topic in instance.starting
        if own or (not waits and outcome.time - said <= _LINE_NS):
            self._causes[monitor] = outcome.time, own or cause  # the stop goes on
            return self._unread(own or cause, monitor, outcome.time, awaited)
        if awaited:
            return next(iter(awaited.values()))
        return f"no command on {topic} since {instance.starting[topic]}" if topic in instance.starting else ""

    def _unread(self, cause: str, monitor: str, time: int, awaited: Mapping[str, str]) -> str:
        """Return a cause, or, if it is a silence of a topic whose messages were not read or judged, that instead."""
        over = {on: why for on, (at, why) in self._unjudged.get(monitor, {}).items() if time - at <= _LINE_NS}
        found = [why for on, why in {**over, **awaited}.items() if on in cause.split()]
        return found[0] if found and cause.startswith(_SILENCE) else cause

    def _sender(self, node: str, topic: str) -> str:
        if node == "\0":
            return "further nodes"
        point = self.senders.last(topic, node) if node else None
        return f"{node or 'a monitor'} of {point.host}" if point is not None else node or "a monitor"

    def _send(self, outcome: Outcome) -> None:
        for earlier in outcome.before:
            self._send(earlier)
        for published in outcome.sent_messages():
            self._publish(published)
        if outcome.timer is not None and not self._prefix:
            self.count_times([_monitor(outcome.timer)], "a tick", 1, (self._now() - outcome.time) / 1e9)
        for judged in outcome.judged.values():
            self._send(judged)

    def _judged(self, judged: Outcome, point: ObservationPoint, data: bytes) -> None:
        self._report(judged, point)
        if judged.result == "dropped":
            self.dropped(judged, point, memoryview(data))
        elif judged.result == "changed":
            self.changed(judged, point, data[:SHOWN], len(data))

    def report_line(
        self,
        monitor: str,
        level: str,
        text: str,
        *,
        point: ObservationPoint,
        time: int,
        observed: ObservedMessage | None = None,
    ) -> None:
        self._observations.note(
            f"{self._prefix}log",
            monitor,
            point,
            time,
            text,
            distinction=f"{level} {without_numbers(text[:LONGEST_TEXT])}",
            shared={"level": level},
            detail={"level": level},
            observed=observed,
        )

    def changed(
        self,
        outcome: Outcome,
        point: ObservationPoint,
        before: bytes,
        size: int,
        observed: ObservedMessage | None = None,
    ) -> None:
        events = tuple(outcome.changed_by)
        safe = self._is_safe(_monitor(events[-1]), point.resource, outcome.buffer)
        if len(self._stopping) >= _MAX_STOPPING:
            self._stopping.clear()
        self._stopping[events, point] = safe
        explained = safe and own_cause(outcome, _monitor(events[-1]))
        if point in self._second.shown and not explained:
            self._again[events, point, safe] = self._again.get((events, point, safe), 0) + 1
            return
        self._second.shown.add(point)
        monitors = self._count_change(events, 1)
        together = _together(events)
        self._observations.note(
            f"{self._prefix}change",
            monitors[-1],
            point,
            outcome.time,
            _of_change(monitors),
            distinction=", ".join(together),
            safe=safe,
            shared={"changed_by": together} if together else {},
            detail={
                **of_change(outcome, self._who),
                **(self._cause(outcome, monitors[-1], point.resource) if safe else {}),
            },
            before=before,
            after=bytes(outcome.buffer[:SHOWN]),
            size=size,
            observed=observed,
        )

    def dropped(
        self,
        outcome: Outcome,
        point: ObservationPoint,
        body: memoryview,
        observed: ObservedMessage | None = None,
    ) -> None:
        self._counter(outcome.dropped_by).drops += 1
        self._observations.note(
            f"{self._prefix}drop",
            outcome.dropped_by,
            point,
            outcome.time,
            outcome.reason or _why(outcome),
            only_number=True,  # the fast path does not know the texts of further drops
            detail=of_drop(outcome, self._who),
            before=bytes(body[:SHOWN]),
            size=len(body),
            observed=observed,
        )

    def defect(
        self, error: Exception, point: ObservationPoint, time: int, observed: ObservedMessage | None = None
    ) -> str:
        text = f"a defect of rosrv, please report it: {type(error).__name__}: {error}"
        self._observations.note(
            f"{self._prefix}fault", "", point, time, text, distinction=type(error).__name__, observed=observed
        )
        return text

    def call_failed(self, monitor: str, service: str, time: int, text: str) -> None:
        self._observations.note(
            f"{self._prefix}fault", monitor, ObservationPoint("", service), time, text, distinction=text
        )

    def missed(
        self,
        monitor: str,
        point: ObservationPoint,
        time: int,
        text: str,
        observed: ObservedMessage | None = None,
    ) -> None:
        self._counter(monitor).missed += 1
        self._observations.note(
            f"{self._prefix}missed", monitor, point, time, text, distinction=text, observed=observed
        )

    @property
    def incomplete(self) -> frozenset[str]:
        return frozenset(name for name, counters in self._counters.items() if counters.missed)

    def tick(self, time: int) -> None:
        self._sum_up(time)
        self._second = _Second()

    def _sum_up(self, time: int) -> None:
        self._settle()
        for events, count in self._happened.items():
            for event in events:
                self._counter(_monitor(event)).events += count
        self._happened.clear()
        for (events, point, safe), count in self._again.items():
            monitors = self._count_change(events, count)
            together = _together(events)
            self._observations.add(
                f"{self._prefix}change",
                monitors[-1],
                point,
                time,
                count,
                text=_of_change(monitors),
                distinction=", ".join(together),
                shared={"changed_by": together} if together else {},
                safe=safe,
            )
        self._again.clear()

    def _count_change(self, events: Sequence[str], count: int) -> list[str]:
        monitors = list(dict.fromkeys(_monitor(event) for event in events))
        for monitor in monitors:
            self._counter(monitor).changes += count
        return monitors

    def _settle(self) -> None:
        for owed in self._owed:
            lane, point = owed.lane, owed.point
            dropped, changed, told = owed.take()
            for events, count in zip(lane.events, lane.take_events(), strict=True):
                self._happened[events] = self._happened.get(events, 0) + count
            for monitor, (times, first, last) in zip(lane.monitors, dropped, strict=True):
                if times:
                    self._counter(monitor).drops += times
                    self._observations.add(f"{self._prefix}drop", monitor, point, last, times, first=first)
            for verdict, (times, first, last) in zip(lane.verdicts, told, strict=True):
                if times:
                    self._counter(verdict.monitor).verdicts += times
                    self._observations.add(
                        f"{self._prefix}verdict",
                        verdict.monitor,
                        point,
                        last,
                        times,
                        text=label_of(verdict),
                        first=first,
                        distinction=label_of(verdict),
                        shared={"category": verdict.category},
                    )
            for writers, messages in changed.items():
                key = writers, point, self._stopping.get((writers, point), self._only_stops(writers[-1]))
                self._again[key] = self._again.get(key, 0) + messages
        self._owed = [owed for owed in self._owed if owed.begun]

    def rows(self, monitors: MonitorSet, time: int) -> list[MonitorRow]:
        self._sum_up(time)
        return [
            replace(
                self._counter(monitor.name),
                file=monitor.code.file,
                failing=monitor.failing,
                faults=monitor.faults,
                shadow=bool(self._prefix),
                slices=monitor.slices.live if monitor.slices is not None else 0,
                slice_limit=monitor.slices.limit if monitor.slices is not None else 0,
                withholds=not self._prefix and monitors.withholds(monitor),
                awaits=monitor.awaits,
            )
            for monitor in (monitors.shadowed if self._prefix else monitors.monitors)
        ]

    def _verdicts(self, outcome: Outcome, point: ObservationPoint, observed: ObservedMessage | None) -> None:
        for verdict in outcome.verdicts:
            self._counter(verdict.monitor).verdicts += 1
            self._observations.note(
                f"{self._prefix}verdict",
                verdict.monitor,
                point,
                outcome.time,
                label_of(verdict),
                distinction=label_of(verdict),
                shared={"category": verdict.category},
                detail=of_verdict(outcome, verdict, self._who),
                after=bytes(outcome.buffer[:SHOWN]),
                size=len(outcome.buffer),
                observed=observed,
            )

    def _faults(self, outcome: Outcome, point: ObservationPoint, observed: ObservedMessage | None) -> None:
        for fault in outcome.faults:
            where = fault.position
            if fault.over and not self._prefix:
                who, on = self._sender(point.caller_id, point.resource), point.resource
                why = f"a message of {who} on {on} was not judged: {fault.text}"
                self._unjudged.setdefault(fault.monitor, {})[on] = outcome.time, why
            if self._acts(fault.monitor):
                self.failed = f"{fault.monitor} had a fault: {where}: {fault.text}"
            self._observations.note(
                f"{self._prefix}fault",
                fault.monitor,
                point,
                outcome.time,
                f"{where}: {fault.text}",
                distinction=str(where),
                detail=of_fault(outcome, fault, self._who),
                after=bytes(outcome.buffer[:SHOWN]),
                size=len(outcome.buffer),
                observed=observed,
            )

    def _who(self, source: int) -> dict[str, str]:
        point = self.senders.point(source)
        return {} if point is None else {"node": point.caller_id, "host": point.host, "on": point.resource}

    def _counter(self, monitor: str) -> MonitorRow:
        return self._counters.setdefault(monitor, MonitorRow(monitor))


def dropped_outcome(body: memoryview, now: int, reason: str) -> Outcome:
    outcome = Outcome(body, now)
    outcome.result, outcome.reason = "dropped", reason
    return outcome


def refusal(outcome: Outcome, part: str) -> str:
    if outcome.reason:
        return outcome.reason
    said = f": {outcome.fatal.text}" if outcome.fatal is not None else _said(outcome)
    return f"the {part} is dropped by the monitor {outcome.dropped_by}{said}"


def own_cause(outcome: Outcome, monitor: str) -> str:
    """Return the last line of a monitor in an outcome, of those with a cause if there are any."""
    lines = [line.text for line in outcome.log if line.monitor == monitor]
    causes = [line.removeprefix(CAUSE) for line in lines if line.startswith(CAUSE)]
    return (causes or lines or [""])[-1]


def _why(outcome: Outcome) -> str:
    if outcome.fatal is not None:
        return f"fault in {outcome.fatal.monitor}: {outcome.fatal.text}"
    return f"{outcome.events[-1]} dropped it{_said(outcome)}"


def _said(outcome: Outcome) -> str:
    said = [line.text for line in outcome.log if line.monitor == outcome.dropped_by]
    return f": {said[-1]}" if said else ""


def _of_change(monitors: Sequence[str]) -> str:
    return f"{' and '.join(monitors)} changed a message"


def _monitor(event: str) -> str:
    return event.partition(".")[0]


def _together(events: Sequence[str]) -> list[str]:
    return list(events) if _monitor(events[0]) != _monitor(events[-1]) else []


def _of_publication(point: ObservationPoint, topic: str) -> ObservationPoint:
    return point._replace(key="", resource=topic)
