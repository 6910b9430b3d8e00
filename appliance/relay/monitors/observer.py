"""What monitors did, counted and put into words for control: from outcomes to `observations`.

A drop is told of the monitor that dropped the message, a change of each monitor whose action changed its bytes. A
change that several made is one record, under the last of them, that names all; it counts once for each of them, and
once for the topic.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from appliance.channel.messages import MonitorRow
from appliance.relay.counts import Counts
from appliance.relay.monitors.margin_counts import Margins
from appliance.relay.monitors.observation_points import NOWHERE, Place, Senders, Sighting
from appliance.relay.monitors.observations import SHOWN, Observations
from rosmop.run.explanations import of_change, of_drop, of_fault, of_published, of_verdict
from rosmop.run.outcomes import Outcome, Verdict, named
from rosmop.runtime.action_context import LogLine, Published

if TYPE_CHECKING:
    from rosmop.run.monitor import Monitor

_EXPLAINED = 10


@dataclass(slots=True)
class _Counters:
    events: int = 0
    verdicts: int = 0
    drops: int = 0
    changes: int = 0
    missed: int = 0


class Observer:
    """Counts what monitors do, and tells the first of each second in full. `publish` sends what they publish.

    What those on trial would have done is told in kinds of its own, with `prefix`.
    """

    def __init__(
        self,
        observations: Observations,
        publish: Callable[[Published], None],
        margins: Margins,
        senders: Senders,
        prefix: str = "",
    ) -> None:
        self._margins = margins
        self.senders = senders
        self._explained = 0
        self._observations = observations
        self._publish = publish
        self._prefix = prefix
        self._counters: dict[str, _Counters] = {}
        self._happened: dict[tuple[str, ...], int] = {}
        self._again: dict[tuple[tuple[str, ...], Place], int] = {}
        self._shown: set[Place] = set()
        self._owed: list[Counts] = []

    def keep(self, names: list[str], began: list[str], time: int) -> None:
        """Other monitors are in force; those that began count anew, and not what happened to those before them."""
        self._sum_up(time)
        self._counters = {
            name: _Counters() if name in began else self._counters.get(name, _Counters()) for name in names
        }

    def shows(self, place: Place) -> bool:
        """Whether the next change at a place is told with the bytes before it."""
        return place not in self._shown

    def hides_drop(self, monitor: str, place: Place) -> bool:
        """Whether the next drop of a monitor at a place is only counted."""
        return self._observations.told("drop", monitor, place)

    def hides_verdict(self, verdict: Verdict, place: Place) -> bool:
        """Whether the next such verdict at a place is only counted."""
        return self._observations.told("verdict", verdict.monitor, place, named(verdict))

    def asks(self, verdict: Verdict, source: int) -> bool:
        """Whether a verdict is told in full, and so explained: as many as `_EXPLAINED` in a second are."""
        place = self.senders.place(source) or NOWHERE
        kind = f"{self._prefix}verdict"
        if (
            self._observations.told(kind, verdict.monitor, place, named(verdict))
            or self._explained >= _EXPLAINED
        ):
            return False
        self._explained += 1
        return True

    def owe(self, counts: Counts) -> None:
        """There are counts to be taken when the second is over."""
        counts.begun = True
        self._owed.append(counts)

    def told(self, outcome: Outcome, place: Place, sighting: Sighting | None = None) -> None:
        """Tell what an outcome has besides its result, and publish what it publishes."""
        for earlier in outcome.before:
            self.told(earlier, NOWHERE)
        if outcome.events:
            events = tuple(outcome.events)
            self._happened[events] = self._happened.get(events, 0) + 1
        self._verdicts(outcome, place, sighting)
        self._faults(outcome, place, sighting)
        for line in outcome.log:
            self.said(line, place, outcome.time, sighting)
        for number, published in enumerate(outcome.published):
            self._observations.note(
                f"{self._prefix}publish",
                published.monitor,
                _of_publication(place, published.topic),
                outcome.time,
                f"{published.type} on {published.topic}",
                detail={"because_of": place.resource, **of_published(outcome, number, self._who)},
                sighting=sighting,
                after=published.data[:SHOWN],
                size=len(published.data),
            )
            self._publish(published)

    def said(self, line: LogLine, place: Place, time: int, sighting: Sighting | None = None) -> None:
        """Tell a line of output."""
        self._observations.note(
            f"{self._prefix}log",
            line.monitor,
            place,
            time,
            line.text,
            distinction=f"{line.level} {line.text}",
            detail={"level": line.level},
            sighting=sighting,
        )

    def changed(
        self, outcome: Outcome, place: Place, before: bytes, size: int, sighting: Sighting | None = None
    ) -> None:
        """Tell a change with the bytes before and after; where one has been shown in this second it is counted."""
        if place in self._shown:
            key = (tuple(outcome.changed_by), place)
            self._again[key] = self._again.get(key, 0) + 1
            return
        self._shown.add(place)
        monitors = self._count_change(outcome.changed_by, 1)
        together = _together(outcome.changed_by)
        self._observations.note(
            f"{self._prefix}change",
            monitors[-1],
            place,
            outcome.time,
            f"{' and '.join(monitors)} changed a message",
            distinction=", ".join(together),
            shared={"changed_by": together} if together else {},
            detail=of_change(outcome, self._who),
            before=before,
            after=bytes(outcome.buffer[:SHOWN]),
            size=size,
            sighting=sighting,
        )

    def dropped(
        self, outcome: Outcome, place: Place, body: memoryview, sighting: Sighting | None = None
    ) -> None:
        """Tell a drop."""
        self._counter(outcome.dropped_by).drops += 1
        self._observations.note(
            f"{self._prefix}drop",
            outcome.dropped_by,
            place,
            outcome.time,
            outcome.reason or _why(outcome),
            detail=of_drop(outcome, self._who),
            before=bytes(body[:SHOWN]),
            size=len(body),
            sighting=sighting,
        )

    def defect(self, error: Exception, place: Place, time: int, sighting: Sighting | None = None) -> str:
        """Tell an exception that no action of a monitor explains; its words."""
        text = f"a defect of rosrv, please report it: {type(error).__name__}: {error}"
        self._observations.note(
            f"{self._prefix}fault", "", place, time, text, distinction=type(error).__name__, sighting=sighting
        )
        return text

    def missed(
        self, monitor: str, place: Place, time: int, text: str, sighting: Sighting | None = None
    ) -> None:
        """Tell that a monitor on trial was not given a message as others would be."""
        self._counter(monitor).missed += 1
        self._observations.note(
            f"{self._prefix}missed", monitor, place, time, text, distinction=text, sighting=sighting
        )

    @property
    def incomplete(self) -> frozenset[str]:
        """The monitors that missed something."""
        return frozenset(name for name, counters in self._counters.items() if counters.missed)

    def tick(self, time: int) -> None:
        """A second is over: sum up."""
        self._sum_up(time)
        self._shown.clear()
        self._explained = 0

    def _sum_up(self, time: int) -> None:
        self._settle()
        for events, count in self._happened.items():
            for event in events:
                self._counter(_monitor(event)).events += count
        self._happened.clear()
        for (events, place), count in self._again.items():
            monitors = self._count_change(events, count)
            together = _together(events)
            self._observations.add(
                f"{self._prefix}change",
                monitors[-1],
                place,
                time,
                count,
                distinction=", ".join(together),
                shared={"changed_by": together} if together else {},
            )
        self._again.clear()

    def _count_change(self, events: Sequence[str], count: int) -> list[str]:
        """Count messages that these events changed, once for each of their monitors; the monitors, in order."""
        monitors = list(dict.fromkeys(_monitor(event) for event in events))
        for monitor in monitors:
            self._counter(monitor).changes += count
        return monitors

    def _settle(self) -> None:
        """Take what lanes have counted: events, and drops and changes beyond the first."""
        for owed in self._owed:
            walker, place = owed.walker, owed.place
            counts, changed, told = owed.take()
            for number, count in enumerate(counts):
                events, monitor = walker.events[number], walker.monitors[number]
                self._happened[events] = self._happened.get(events, 0) + count.happened
                if count.dropped:
                    self._counter(monitor).drops += count.dropped
                    self._observations.add(
                        f"{self._prefix}drop", monitor, place, count.last_drop, count.dropped
                    )
            for verdict, (times, last) in zip(walker.verdicts, told, strict=True):
                if times:
                    self._counter(verdict.monitor).verdicts += times
                    self._observations.add(
                        f"{self._prefix}verdict",
                        verdict.monitor,
                        place,
                        last,
                        times,
                        distinction=named(verdict),
                        shared={"category": verdict.category},
                    )
            for writers, messages in changed.items():
                self._again[writers, place] = self._again.get((writers, place), 0) + messages
        self._owed.clear()

    def rows(self, monitors: Iterable[Monitor], time: int) -> list[MonitorRow]:
        """The state and counters of these monitors."""
        self._sum_up(time)
        return [self._row(monitor, time) for monitor in monitors]

    def _row(self, monitor: Monitor, time: int) -> MonitorRow:
        counters, slices = self._counter(monitor.name), monitor.slices
        return MonitorRow(
            monitor.name,
            monitor.code.file,
            monitor.enabled,
            monitor.held,
            monitor.failing,
            counters.events,
            counters.verdicts,
            counters.drops,
            counters.changes,
            monitor.faults,
            bool(self._prefix),
            counters.missed,
            self._margins.rows(monitor.name, time),
            slices.live if slices is not None else 0,
            slices.limit if slices is not None else 0,
        )

    def _verdicts(self, outcome: Outcome, place: Place, sighting: Sighting | None) -> None:
        for verdict in outcome.verdicts:
            self._counter(verdict.monitor).verdicts += 1
            self._observations.note(
                f"{self._prefix}verdict",
                verdict.monitor,
                place,
                outcome.time,
                named(verdict),
                distinction=named(verdict),
                shared={"category": verdict.category},
                detail=of_verdict(outcome, verdict, self._who),
                after=bytes(outcome.buffer[:SHOWN]),
                size=len(outcome.buffer),
                sighting=sighting,
            )

    def _faults(self, outcome: Outcome, place: Place, sighting: Sighting | None) -> None:
        for fault in outcome.faults:
            where = fault.position
            self._observations.note(
                f"{self._prefix}fault",
                fault.monitor,
                place,
                outcome.time,
                f"{where}: {fault.text}",
                distinction=str(where),
                detail=of_fault(outcome, fault, self._who),
                after=bytes(outcome.buffer[:SHOWN]),
                size=len(outcome.buffer),
                sighting=sighting,
            )

    def _who(self, source: int) -> dict[str, str]:
        place = self.senders.place(source)
        return {} if place is None else {"node": place.caller_id, "host": place.host, "on": place.resource}

    def _counter(self, monitor: str) -> _Counters:
        return self._counters.setdefault(monitor, _Counters())


def refusal(outcome: Outcome, part: str) -> str:
    """What the client of a service reads."""
    if outcome.reason:
        return outcome.reason
    said = f": {outcome.fatal.text}" if outcome.fatal is not None else _said(outcome)
    return f"the {part} is refused by the monitor {outcome.dropped_by}{said}"


def _why(outcome: Outcome) -> str:
    if outcome.fatal is not None:
        return f"fault in {outcome.fatal.monitor}: {outcome.fatal.text}"
    return f"{outcome.events[-1]} dropped it{_said(outcome)}"


def _said(outcome: Outcome) -> str:
    """What the monitor that dropped a message said last on it."""
    said = [line.text for line in outcome.log if line.monitor == outcome.dropped_by]
    return f": {said[-1]}" if said else ""


def _monitor(event: str) -> str:
    """The monitor of an event."""
    return event.partition(".")[0]


def _together(events: Sequence[str]) -> list[str]:
    """The events that changed a message, if it was more than one monitor."""
    return list(events) if _monitor(events[0]) != _monitor(events[-1]) else []


def _of_publication(place: Place, topic: str) -> Place:
    """Where a publication is told that comes of a message at a place."""
    return place._replace(key="", resource=topic)
