"""What monitors did, counted and put into words for control: from outcomes to `observations`."""

from collections.abc import Callable
from dataclasses import dataclass

from appliance.channel.messages import MonitorRow
from appliance.relay.counts import Counts
from appliance.relay.observations import SHOWN, Observations
from appliance.rosmop.monitor import Monitor
from appliance.rosmop.outcomes import Outcome
from appliance.rosmop.runtime.context import Published

Place = tuple[str, str]
"""Where something happened: the key of an incarnation, and its topic or service."""


@dataclass(slots=True)
class _Counters:
    events: int = 0
    verdicts: int = 0
    drops: int = 0
    changes: int = 0


class Telling:
    """Counts what monitors do, and tells the first of each second in full. `publish` sends what they publish."""

    def __init__(self, observations: Observations, publish: Callable[[Published], None]) -> None:
        self._observations = observations
        self._publish = publish
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

    def owe(self, counts: Counts) -> None:
        """There are counts to be taken when the second is over."""
        self._owed.append(counts)

    def told(self, outcome: Outcome, place: Place) -> None:
        """Tell what an outcome has besides its result, and publish what it publishes."""
        for earlier in outcome.before:
            self.told(earlier, ("", ""))
        if outcome.events:
            events = tuple(outcome.events)
            self._happened[events] = self._happened.get(events, 0) + 1
        self._verdicts(outcome, place)
        self._faults(outcome, place)
        for line in outcome.log:
            self._observations.note(
                "log",
                line.monitor,
                place,
                outcome.time,
                line.text,
                distinction=f"{line.level} {line.text}",
                detail={"level": line.level},
            )
        for published in outcome.published:
            self._observations.note(
                "publish",
                monitor_of(outcome),
                ("", published.topic),
                outcome.time,
                f"{published.type} on {published.topic}",
                detail={"type": published.type, "events": list(outcome.events)},
                after=published.data[:SHOWN],
                size=len(published.data),
            )
            self._publish(published)

    def changed_again(self, outcome: Outcome, place: Place) -> None:
        """A change at a place where one has been shown in this second: it is counted."""
        key = (tuple(outcome.events), place)
        self._again[key] = self._again.get(key, 0) + 1

    def changed(self, outcome: Outcome, place: Place, before: bytes, size: int) -> None:
        """Tell a change with the bytes before and after."""
        self._shown.add(place)
        monitor = monitor_of(outcome)
        self._counter(monitor).changes += 1
        self._observations.note(
            "change",
            monitor,
            place,
            outcome.time,
            f"{monitor} changed a message",
            detail={"events": list(outcome.events)},
            before=before,
            after=bytes(outcome.buffer[:SHOWN]),
            size=size,
        )

    def dropped(self, outcome: Outcome, place: Place, body: memoryview) -> None:
        """Tell a drop."""
        monitor = monitor_of(outcome)
        self._counter(monitor).drops += 1
        self._observations.note(
            "drop",
            monitor,
            place,
            outcome.time,
            outcome.reason or _why(outcome),
            detail={"events": list(outcome.events)},
            before=bytes(body[:SHOWN]),
            size=len(body),
        )

    def defect(self, error: Exception, place: Place, time: int) -> str:
        """Tell an exception that no action of a monitor explains; its words."""
        text = f"a defect of rosrv, please report it: {type(error).__name__}: {error}"
        self._observations.note("fault", "", place, time, text, distinction=type(error).__name__)
        return text

    def tick(self, time: int) -> None:
        """A second is over: sum up."""
        self._sum_up(time)
        self._shown.clear()

    def _sum_up(self, time: int) -> None:
        self._settle()
        for events, count in self._happened.items():
            for event in events:
                self._counter(event.partition(".")[0]).events += count
        self._happened.clear()
        for (events, place), count in self._again.items():
            monitor = events[-1].partition(".")[0] if events else ""
            self._counter(monitor).changes += count
            self._observations.add("change", monitor, place, time, count)
        self._again.clear()

    def _settle(self) -> None:
        """Take what lanes have counted: events, and drops and changes beyond the first."""
        for owed in self._owed:
            walker, place = owed.walker, owed.place
            for number, count in enumerate(owed.take()):
                events, monitor = walker.events[number], walker.monitors[number]
                self._happened[events] = self._happened.get(events, 0) + count.happened
                if count.changed:
                    self._again[events, place] = self._again.get((events, place), 0) + count.changed
                if count.dropped:
                    self._counter(monitor).drops += count.dropped
                    self._observations.add("drop", monitor, place, count.last_drop, count.dropped)
        self._owed.clear()

    def row(self, monitor: Monitor) -> MonitorRow:
        """The state and counters of one monitor."""
        counters = self._counter(monitor.name)
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
        )

    def _verdicts(self, outcome: Outcome, place: Place) -> None:
        for verdict in outcome.verdicts:
            self._counter(verdict.monitor).verdicts += 1
            name = f"property {verdict.property + 1} of {verdict.monitor} ({verdict.logic})"
            self._observations.note(
                "verdict",
                verdict.monitor,
                place,
                outcome.time,
                f"{name}: {verdict.category}",
                distinction=f"{verdict.property} {verdict.category}",
                detail={
                    "property": verdict.property,
                    "logic": verdict.logic,
                    "category": verdict.category,
                    "events": list(outcome.events),
                },
                after=bytes(outcome.buffer[:SHOWN]),
                size=len(outcome.buffer),
            )

    def _faults(self, outcome: Outcome, place: Place) -> None:
        for fault in outcome.faults:
            where = fault.position
            self._observations.note(
                "fault",
                fault.monitor,
                place,
                outcome.time,
                f"{where}: {fault.text}",
                distinction=str(where),
                detail={
                    "file": where.file,
                    "line": where.line,
                    "column": where.column,
                    "text": fault.text,
                    "values": dict(fault.values),
                    "events": list(outcome.events),
                },
                after=bytes(outcome.buffer[:SHOWN]),
                size=len(outcome.buffer),
            )

    def _counter(self, monitor: str) -> _Counters:
        return self._counters.setdefault(monitor, _Counters())


def monitor_of(outcome: Outcome) -> str:
    """The monitor that had the last word on a message."""
    if outcome.faults:
        return outcome.faults[-1].monitor
    if outcome.events:
        return outcome.events[-1].partition(".")[0]
    if outcome.timer:
        return outcome.timer.partition(".")[0]
    return outcome.reason.partition(" ")[0] if outcome.reason and " holds " in outcome.reason else ""


def refusal(outcome: Outcome, part: str) -> str:
    """What the client of a service reads."""
    if outcome.reason:
        return outcome.reason
    said = f": {outcome.log[-1].text}" if outcome.log and not outcome.faults else ""
    return f"the {part} is refused by the monitor {monitor_of(outcome) or 'of this service'}{said}"


def _why(outcome: Outcome) -> str:
    if outcome.faults:
        return f"fault in {outcome.faults[-1].monitor}: {outcome.faults[-1].text}"
    event = outcome.events[-1] if outcome.events else "a monitor"
    said = f": {outcome.log[-1].text}" if outcome.log else ""
    return f"{event} dropped it{said}"
