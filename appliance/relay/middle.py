"""Monitors in the middle: the specifications in force, and what they do to messages, requests and replies.

A topic without an enabled event never comes here (`stands` is asked when something changes, not per message). For
the others a batch is walked frame by frame; what nobody changed or dropped leaves in the buffer it came in.

Invariants:
- Whatever goes wrong with a monitor, a defect of this program included, ends the way of that message and of nothing
  else: it is dropped and told.
- Specifications that cannot be taken change nothing; a relay that has none yet blocks everything then.
- One swap is between two messages. What monitors publish is not given to monitors.
- The clock of monitors never goes back and makes no leap: it is the time of the day when the relay started, and
  from there the monotonic clock.
- The relay always answers its supervisor: when monitors have taken `_LONGEST` seconds of processor time since the
  loop last came to its timers (they never do unless messages take them long), the messages until then are dropped.
"""

import struct
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from appliance.channel.messages import (
    MonitorRow,
    SpecificationsRefused,
    SpecificationsStated,
    SpecificationsTaken,
)
from appliance.relay.frames import Batch
from appliance.relay.loop import Loop, Timer
from appliance.relay.observations import SHOWN, Observations
from appliance.relay.report import Reporter
from appliance.ros.definitions import Definitions
from appliance.ros.errors import DefinitionError
from appliance.ros.standard import standard_definitions
from appliance.rosmop.engine import FAILING_AFTER, MonitorSet
from appliance.rosmop.monitor import Monitor
from appliance.rosmop.outcomes import Outcome
from appliance.rosmop.runtime.context import Published
from appliance.rosmop.syntax.errors import SpecificationError

_LENGTH = struct.Struct("<I")
_unpack_length = _LENGTH.unpack_from
_LONGEST = 2.0
_LOOK = 0.05
_AFTER_DEFECT = 1.0
_Place = tuple[str, str]


@dataclass(slots=True)
class _Counters:
    events: int = 0
    verdicts: int = 0
    drops: int = 0
    changes: int = 0


@dataclass(frozen=True, slots=True)
class Judged:
    """What becomes of a request or a reply: the body to pass on, or the reason why it is refused."""

    body: bytes
    refused: str | None = None


class Middle:
    """The monitors of one relay.

    `publish(published)` sends what a monitor publishes; `changed()` is called when other topics may be wanted.
    """

    def __init__(self, loop: Loop, reporter: Reporter) -> None:
        self._loop = loop
        self._reporter = reporter
        self._offset = time.time_ns() - time.monotonic_ns()
        self._set: MonitorSet | None = None
        self._stated: tuple[object, ...] = ()
        self._blocked = ""
        self._counters: dict[str, _Counters] = {}
        self._happened: dict[tuple[str, ...], int] = {}
        self._shown: set[_Place] = set()  # where a change of this second has been shown already
        self._spent = 0.0
        self._standard: Definitions | None = None
        self._timer: Timer | None = None
        self._due: int | None = None
        self.observations = Observations(loop, reporter, self._rows)
        self.publish: Callable[[Published], None] = lambda published: None  # noqa: ARG005 - set by the engine
        self.changed: Callable[[], None] = lambda: None

    # --- what control states ---

    def state(self, message: SpecificationsStated) -> None:
        """Take these specifications; what is in force already keeps its state."""
        stated = (message.files, message.definitions, message.on_fault)
        began: list[str] = []
        held: list[str] = []
        if self._set is None or stated != self._stated:
            try:
                began = self._take(message)
            except (SpecificationError, DefinitionError) as error:
                self._refuse(message.revision, error)
                return
            except Exception as error:  # noqa: BLE001  a defect must not end the relay: the last good set stays
                self._refuse(message.revision, error)
                return
            self._stated = stated
        if self._set is not None:
            now = self._now()
            for monitor in self._set.monitors:
                self._set.set_enabled(monitor.name, message.enabled.get(monitor.name, True), now)
            held = [monitor.name for monitor in self._set.monitors if monitor.held]
        self._schedule()
        self.changed()
        self._reporter.send(SpecificationsTaken(message.revision, began, held))

    def _take(self, message: SpecificationsStated) -> list[str]:
        if self._set is None and not message.files:
            self._blocked = ""
            return []
        if self._standard is None:
            self._standard = standard_definitions()
        definitions = self._standard.extended(Definitions.from_files(message.definitions))
        sources, now = dict(message.files), self._now()
        before = {} if self._set is None else {one.name: one.node for one in self._set.monitors}
        if self._set is None:
            following = MonitorSet.load(sources, definitions, message.on_fault)
            outcome = following.start(now, restarted=message.restarted)
        else:
            following, outcome = self._set.replaced(sources, definitions, now)
        self._set, self._blocked = following, ""
        began = [one.name for one in following.monitors if before.get(one.name) != one.node]
        self._counters = {
            one.name: _Counters() if one.name in began else self._counters.get(one.name, _Counters())
            for one in following.monitors
        }
        self._told(outcome, ("", ""))
        return began

    def _refuse(self, revision: int, error: Exception) -> None:
        findings = (
            [str(one) for one in error.findings] if isinstance(error, SpecificationError) else [str(error)]
        )
        if self._set is None:
            self._blocked = f"the specifications of revision {revision} could not be taken: {findings[0]}"
        self.changed()
        self._reporter.send(SpecificationsRefused(revision, findings[:100]))

    def switch(self, name: str, enabled: bool) -> None:
        """Let the events of a monitor happen, or not; an unknown name is fine (it is gone)."""
        if self._set is not None and any(one.name == name for one in self._set.monitors):
            self._set.set_enabled(name, enabled, self._now())
            self._schedule()
            self.changed()

    def resume(self, name: str) -> None:
        """Let the topics of a monitor that holds them go on."""
        if self._set is not None and any(one.name == name for one in self._set.monitors):
            self._set.resume(name)

    # --- what is asked when something changes ---

    def stands(self, topic: str) -> bool:
        """Whether messages of a topic go through here."""
        return bool(self._blocked) or (self._set is not None and self._set.wants(topic))

    def wants(self, topic: str) -> bool:
        """Whether a monitor wants a topic's messages even if nobody else does."""
        return self._set is not None and self._set.wants(topic)

    def objection(self, topic: str, header: Mapping[str, str]) -> str:
        """Why a publisher's messages cannot be understood by the monitors of its topic; empty when they can."""
        if self._set is None or not self._set.wants(topic):
            return ""
        name = self._set.topics[topic]
        return _other_definition(topic, name, self._set.md5sum(name), header)

    def service_objection(self, service: str, header: Mapping[str, str]) -> str:
        """The same of a service, by the header it answers with."""
        name = self._set.services.get(service) if self._set is not None else None
        if self._set is None or name is None or not self._service_stands(service):
            return ""
        return _other_definition(service, name, self._set.definitions.service_md5sum(name), header)

    def header_of(self, topic: str) -> dict[str, str] | None:
        """The connection header, without names, for what monitors publish on a topic; None if none does."""
        if self._set is None or topic not in self._set.publications:
            return None
        name = self._set.publications[topic]
        return {
            "type": name,
            "md5sum": self._set.md5sum(name),
            "message_definition": self._set.definitions.full_text(name),
            "latching": "0",
        }

    # --- messages ---

    def through(self, key: str, topic: str, batch: Batch) -> Batch | None:
        """The frames that go on, as the monitors leave them; None when none does."""
        view, place = batch.view, (key, topic)
        shown = place not in self._shown
        pieces: list[memoryview | bytes | bytearray] = []
        position = run = messages = last = length = 0
        spent = self._spent - time.thread_time()
        clock = self._loop.clock
        since = clock()
        while position < len(view):
            first = position + 4
            end = first + _unpack_length(view, position)[0]
            body = view[first:end]
            before = bytes(body[:SHOWN]) if shown else b""
            outcome = self._judge(place, body)
            result = outcome.result
            if result == "passed":
                last = length + position - run
                messages += 1
            else:
                self._tell_result(outcome, place, before, body)
                if result == "changed" and outcome.buffer is body:
                    last = length + position - run
                    messages += 1
                else:
                    if position > run:
                        pieces.append(view[run:position])
                        length += position - run
                    run = end
                    if result == "changed":
                        pieces += (_LENGTH.pack(len(outcome.buffer)), outcome.buffer)
                        last = length
                        length += 4 + len(outcome.buffer)
                        messages += 1
                shown = shown and place not in self._shown
            now = clock()
            if now - since > _LOOK:
                self._spent = spent + time.thread_time()
                since = now
            position = end
        self._spent = spent + time.thread_time()
        if self._due is not None or self._set_due is not None:
            self._schedule()
        if not pieces and not run:
            return batch
        if not messages:
            return None
        if position > run:
            pieces.append(view[run:position])
        return Batch(memoryview(b"".join(pieces)), messages, last, owned=True)

    def request(self, key: str, service: str, body: bytes) -> Judged:
        """What becomes of a request."""
        return self._service(key, service, "request", body)

    def response(self, key: str, service: str, body: bytes) -> Judged:
        """What becomes of the reply to a request."""
        return self._service(key, service, "response", body)

    def tick(self) -> None:
        """A second is over."""
        self._spent = 0.0
        self._shown.clear()
        self._count_events()
        self.observations.tick()

    def close(self) -> None:
        """The relay ends."""
        if self._timer is not None:
            self._timer.cancel()

    # --- one message ---

    def _judge(self, place: _Place, body: memoryview) -> Outcome:
        if self._blocked:
            return _dropped(body, self._blocked)
        if self._spent > _LONGEST:
            return _dropped(body, "the monitors take too long for their messages")
        if self._set is None:
            return Outcome(body)
        try:
            outcome = self._set.process(place[1], body, self._now())
        except Exception as error:  # noqa: BLE001  a defect of the monitors must not end the relay
            return self._defect(error, place, body)
        if outcome.events:
            events = tuple(outcome.events)
            self._happened[events] = self._happened.get(events, 0) + 1
        if outcome.verdicts or outcome.log or outcome.faults or outcome.published or outcome.before:
            self._told(outcome, place)
        return outcome

    def _service(self, key: str, service: str, part: str, body: bytes) -> Judged:
        place = (key, service)
        if self._blocked:
            return Judged(b"", self._blocked)
        if self._spent > _LONGEST:
            return Judged(b"", "the monitors take too long for their messages")
        if self._set is None or not self._service_stands(service):
            return Judged(body)
        before = time.thread_time()
        try:
            outcome = self._set.process_service(service, part, bytearray(body), self._now())
        except Exception as error:  # noqa: BLE001  a defect of the monitors must not end the relay
            outcome = self._defect(error, place, memoryview(body))
        else:
            if outcome.events:
                events = tuple(outcome.events)
                self._happened[events] = self._happened.get(events, 0) + 1
            self._told(outcome, place)
        self._spent += time.thread_time() - before
        self._schedule()
        if outcome.result == "passed":
            return Judged(body)
        self._tell_result(outcome, place, body[:SHOWN], memoryview(body))
        if outcome.result == "changed":
            return Judged(bytes(outcome.buffer))
        return Judged(b"", _refusal(outcome, part))

    def _service_stands(self, service: str) -> bool:
        return self._set is not None and any(
            monitor.enabled and step.event.topic == service and step.event.part is not None
            for monitor in self._set.monitors
            for step in monitor.steps
        )

    # --- what is told ---

    def _told(self, outcome: Outcome, place: _Place) -> None:
        """Tell what an outcome has besides its result, and publish what it publishes."""
        for earlier in outcome.before:
            self._told_timer(earlier)
        events = list(outcome.events)
        for verdict in outcome.verdicts:
            self._counter(verdict.monitor).verdicts += 1
            text = (
                f"property {verdict.property + 1} of {verdict.monitor} ({verdict.logic}): {verdict.category}"
            )
            self.observations.note(
                "verdict",
                verdict.monitor,
                place,
                outcome.time,
                text,
                distinction=f"{verdict.property} {verdict.category}",
                detail={
                    "property": verdict.property,
                    "logic": verdict.logic,
                    "category": verdict.category,
                    "events": events,
                },
                after=bytes(outcome.buffer[:SHOWN]),
                size=len(outcome.buffer),
            )
        for fault in outcome.faults:
            where = fault.position
            self.observations.note(
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
                    "events": events,
                },
                after=bytes(outcome.buffer[:SHOWN]),
                size=len(outcome.buffer),
            )
        for line in outcome.log:
            self.observations.note(
                "log",
                line.monitor,
                place,
                outcome.time,
                line.text,
                distinction=f"{line.level} {line.text}",
                detail={"level": line.level},
            )
        for published in outcome.published:
            self.observations.note(
                "publish",
                _monitor_of(outcome),
                ("", published.topic),
                outcome.time,
                f"{published.type} on {published.topic}",
                detail={"type": published.type, "events": events},
                after=published.data[:SHOWN],
                size=len(published.data),
            )
            self.publish(published)

    def _told_timer(self, outcome: Outcome) -> None:
        if outcome.events:
            events = tuple(outcome.events)
            self._happened[events] = self._happened.get(events, 0) + 1
        self._told(outcome, ("", ""))

    def _tell_result(self, outcome: Outcome, place: _Place, before: bytes, body: memoryview) -> None:
        """Tell a drop or a change."""
        monitor = _monitor_of(outcome)
        counter = self._counter(monitor)
        detail = {"events": list(outcome.events)}
        if outcome.result == "dropped":
            counter.drops += 1
            self.observations.note(
                "drop",
                monitor,
                place,
                outcome.time,
                outcome.reason or _why(outcome),
                detail=detail,
                before=before or bytes(body[:SHOWN]),
                size=len(body),
            )
            return
        counter.changes += 1
        after = bytes(outcome.buffer[:SHOWN])
        text = f"{monitor} changed a message"
        self.observations.note(
            "change",
            monitor,
            place,
            outcome.time,
            text,
            detail=detail,
            before=before,
            after=after,
            size=len(body),
        )
        self._shown.add(place)

    def _defect(self, error: Exception, place: _Place, body: memoryview) -> Outcome:
        text = f"a defect of rosrv, please report it: {type(error).__name__}: {error}"
        self.observations.note("fault", "", place, self._now(), text, distinction=type(error).__name__)
        return _dropped(body, text)

    def _counter(self, monitor: str) -> _Counters:
        return self._counters.setdefault(monitor, _Counters())

    def _count_events(self) -> None:
        for events, count in self._happened.items():
            for event in events:
                self._counter(event.partition(".")[0]).events += count
        self._happened.clear()

    def _rows(self) -> list[MonitorRow]:
        return [self._row(one) for one in self._set.monitors] if self._set is not None else []

    def _row(self, monitor: Monitor) -> MonitorRow:
        counters = self._counter(monitor.name)
        return MonitorRow(
            monitor.name,
            monitor.code.file,
            monitor.enabled,
            monitor.held,
            monitor.faults >= FAILING_AFTER,
            counters.events,
            counters.verdicts,
            counters.drops,
            counters.changes,
            monitor.faults,
        )

    # --- time ---

    def _now(self) -> int:
        return self._offset + time.monotonic_ns()

    @property
    def _set_due(self) -> int | None:
        return self._set.next_due if self._set is not None else None

    def _schedule(self) -> None:
        """See that `_advance` is called when the next tick or deadline is due, or earlier."""
        due = self._set_due
        if due is None or (self._due is not None and self._due <= due):
            return
        if self._timer is not None:
            self._timer.cancel()
        self._due = due
        self._timer = self._loop.after(max(0, due - self._now()) / 1e9, self._advance)

    def _advance(self) -> None:
        self._due = self._timer = None
        if self._set is None:
            return
        before = time.thread_time()
        try:
            for outcome in self._set.advance(self._now()):
                self._told_timer(outcome)
        except Exception as error:  # noqa: BLE001  a defect of the monitors must not end the relay
            self._defect(error, ("", ""), memoryview(b""))
            self._due = self._now() + int(_AFTER_DEFECT * 1e9)
            self._timer = self._loop.after(_AFTER_DEFECT, self._advance)
            return
        self._spent += time.thread_time() - before
        self._schedule()


def _dropped(body: memoryview, reason: str) -> Outcome:
    outcome = Outcome(body, time.time_ns())
    outcome.result, outcome.reason = "dropped", reason
    return outcome


def _monitor_of(outcome: Outcome) -> str:
    """The monitor that had the last word on a message."""
    if outcome.faults:
        return outcome.faults[-1].monitor
    if outcome.events:
        return outcome.events[-1].partition(".")[0]
    if outcome.timer:
        return outcome.timer.partition(".")[0]
    return (outcome.reason or "").partition(" ")[0] if outcome.reason and " holds " in outcome.reason else ""


def _why(outcome: Outcome) -> str:
    if outcome.faults:
        return f"fault in {outcome.faults[-1].monitor}: {outcome.faults[-1].text}"
    event = outcome.events[-1] if outcome.events else "a monitor"
    said = f": {outcome.log[-1].text}" if outcome.log else ""
    return f"{event} dropped it{said}"


def _refusal(outcome: Outcome, part: str) -> str:
    """What a client of a service reads."""
    if outcome.reason:
        return outcome.reason
    said = f": {outcome.log[-1].text}" if outcome.log and not outcome.faults else ""
    return f"the {part} is refused by the monitor {_monitor_of(outcome) or 'of this service'}{said}"


def _other_definition(resource: str, name: str, md5sum: str, header: Mapping[str, str]) -> str:
    found = header.get("md5sum", "")
    if found == md5sum:
        return ""
    theirs = header.get("type", "*")
    return (
        f"the specifications understand {resource} as [{name}/{md5sum}], its messages are [{theirs}/{found}];"
        " give the specifications the definition of the robot (msg/ beside them)"
    )
