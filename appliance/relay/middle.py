"""Monitors in the middle: the specifications in force, and what they do to messages, requests and replies.

A topic without an enabled event never comes here (`stands` is asked when something changes, not per message). The
messages of a batch are taken many at a time where they need nothing but the common (`_walk`), one by one where there
is something to tell; what nobody changed or dropped leaves in the buffer it came in.

Invariants:
- Whatever goes wrong with a monitor, a defect of this program included, ends the way of that message and of nothing
  else: it is dropped and told.
- Specifications that cannot be taken change nothing; a relay that has none yet blocks everything then.
- One swap is between two messages. What monitors publish is not given to monitors.
- The clock of monitors never goes back and makes no leap: it is the time of the day when the relay started, and
  from there the monotonic clock. The messages of one batch have come at the same time.
- The relay always answers its supervisor: when monitors have taken `_LONGEST` seconds of processor time since the
  loop last came to its timers (they never do unless messages take them long), the messages until then are dropped.
"""

import struct
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from appliance.channel.messages import (
    SpecificationsRefused,
    SpecificationsStated,
    SpecificationsTaken,
)
from appliance.relay.compiling import Compiler, Result
from appliance.relay.frames import Batch
from appliance.relay.loop import Loop, Timer
from appliance.relay.observations import SHOWN, Observations
from appliance.relay.passage import Passage
from appliance.relay.report import Reporter
from appliance.relay.telling import Place, Telling, refusal
from appliance.rosmop.batch import Walker
from appliance.rosmop.engine import MonitorSet
from appliance.rosmop.outcomes import Outcome
from appliance.rosmop.runtime.context import Published

_LENGTH = struct.Struct("<I")
_unpack_length = _LENGTH.unpack_from
_LONGEST = 2.0
_LOOK_EVERY = 16  # messages
_MANY = 256  # messages
_AFTER_DEFECT = 1.0
_TOO_LONG = "the monitors take too long for their messages"


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
        self._stated: SpecificationsStated | None = None
        self._switches: dict[str, bool] = {}
        self._blocked = ""
        self._spent = 0.0
        self._timer: Timer | None = None
        self._due: int | None = None
        self._compiler = Compiler(loop, self._compiled)
        self.observations = Observations(
            loop,
            reporter,
            lambda: [self._telling.row(one) for one in self._set.monitors] if self._set is not None else [],
        )
        self.publish: Callable[[Published], None] = lambda published: None  # noqa: ARG005 - set by the engine
        self.changed: Callable[[], None] = lambda: None
        self._telling = Telling(self.observations, lambda published: self.publish(published))  # noqa: PLW0108 - set later

    # --- what control states ---

    def state(self, message: SpecificationsStated) -> None:
        """Take these specifications, at once or when they are compiled; the same as before keep their state."""
        self._switches = dict(message.enabled)
        if self._compiler.busy:
            self._compiler.later(message)
        elif self._stated is not None and not self._blocked and _same(message, self._stated):
            self._taken(message, [])
        elif self._stated is None or self._blocked:
            self._compiler.now(message)
        else:
            self._compiler.later(message)

    def _compiled(self, message: SpecificationsStated, result: Result) -> None:
        if isinstance(result, list):
            self._refuse(message, result)
            return
        before, now = self._set, self._now()
        outcome = (
            result.start(now, restarted=message.restarted) if before is None else result.succeed(before, now)
        )
        self._set, self._stated, self._blocked = result, message, ""
        began = list(result.began)
        for monitor in result.monitors:
            monitor.held = monitor.held or (
                monitor.code.hold and monitor.name in message.moved and monitor.name in began
            )
        self._telling.keep([one.name for one in result.monitors], began, now)
        self._telling.told(outcome, ("", ""))
        self._taken(message, began)

    def _taken(self, message: SpecificationsStated, began: list[str]) -> None:
        held: list[str] = []
        if self._set is not None:
            now = self._now()
            for monitor in self._set.monitors:
                self._set.set_enabled(monitor.name, self._switches.get(monitor.name, True), now)
            held = [monitor.name for monitor in self._set.monitors if monitor.held]
        self._schedule()
        self.changed()
        self._reporter.send(SpecificationsTaken(message.revision, began, held))

    def _refuse(self, message: SpecificationsStated, findings: list[str]) -> None:
        if self._set is None:
            reason = f"the specifications of revision {message.revision} could not be taken: {findings[0]}"
            self._blocked = reason
        self.changed()
        self._reporter.send(SpecificationsRefused(message.revision, findings[:100]))

    def switch(self, name: str, enabled: bool) -> None:
        """Let the events of a monitor happen, or not; an unknown name is fine (it is gone)."""
        self._switches[name] = enabled
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
        if self._set is None or name is None or not self._serves(service):
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
        monitors = self._set
        if self._blocked or monitors is None:
            return self._block(batch, (key, topic))
        passage = Passage(batch, (key, topic), self._now())
        walker = monitors.walker(topic)
        while passage.position < passage.end:
            if walker is None:
                self._one_by_one(monitors, passage, batch.messages)
            elif self._spent > _LONGEST or not self._walk(monitors, walker, passage):
                self._one_by_one(monitors, passage, passage.turns())
        if self._due is not None or monitors.next_due is not None:
            self._schedule()
        return passage.result()

    def _walk(self, monitors: MonitorSet, walker: Walker, passage: Passage) -> bool:
        """Take the messages that need nothing but the common; False if the next one needs more."""
        if not monitors.walks(walker, passage.time):
            return False
        telling, place, before = self._telling, passage.place, passage.position
        began = time.thread_time() if passage.messages > _MANY else None  # else too little to count
        try:
            walked = walker.walk(
                passage.view,
                before,
                passage.run,
                passage.pieces,
                stride=passage.stride,
                time_ns=passage.time,
                loud=walker.changes and telling.shows(place),
                told=[not telling.hides_drop(one, place) for one in walker.monitors] if walker.drops else (),
            )
        except Exception as error:  # noqa: BLE001  a defect of the loops must not end the relay
            telling.defect(error, place, passage.time)
            return False
        if began is not None:
            self._spent += time.thread_time() - began
        telling.walked(walker, walked, place, passage.time)
        passage.walked(walked.position, walked.run, sum(walked.dropped) if walker.drops else 0)
        return passage.position == passage.end

    def _one_by_one(self, monitors: MonitorSet, passage: Passage, count: int) -> None:
        """Give so many messages to the engine."""
        topic, place, now, telling = passage.place[1], passage.place, passage.time, self._telling
        view, position, end = passage.view, passage.position, passage.end
        process = monitors.process
        shows = telling.shows(place)
        looked = 0
        spent = self._spent - time.thread_time()
        while position < end and looked < count:
            first = position + 4
            following = first + _unpack_length(view, position)[0]
            body = view[first:following]
            before = bytes(body[:SHOWN]) if shows else b""
            try:
                outcome = (
                    process(topic, body, now) if self._spent <= _LONGEST else _dropped(body, now, _TOO_LONG)
                )
            except Exception as error:  # noqa: BLE001  a defect of the monitors must not end the relay
                outcome = _dropped(body, now, telling.defect(error, place, now))
            if outcome.events or outcome.log or outcome.faults or outcome.before:
                telling.told(outcome, place)
            result = outcome.result
            if result == "dropped":
                telling.dropped(outcome, place, body)
                passage.cut(position, following)
            elif result == "changed":
                if shows:
                    telling.changed(outcome, place, before, len(body))
                    shows = telling.shows(place)
                else:
                    telling.changed_again(outcome, place)
                if outcome.buffer is not body:
                    passage.replace(position, following, outcome.buffer)
            position = following
            looked += 1
            if not looked % _LOOK_EVERY or outcome.faults:
                self._spent = spent + time.thread_time()
        passage.position = position
        self._spent = spent + time.thread_time()

    def request(self, key: str, service: str, body: bytes) -> Judged:
        """What becomes of a request."""
        return self._service(key, service, "request", body)

    def response(self, key: str, service: str, body: bytes) -> Judged:
        """What becomes of the reply to a request."""
        return self._service(key, service, "response", body)

    def tick(self) -> None:
        """A second is over."""
        self._spent = 0.0
        self._telling.tick(self._now())
        self.observations.tick()

    def close(self) -> None:
        """The relay ends."""
        self._compiler.close()
        if self._timer is not None:
            self._timer.cancel()

    # --- inside ---

    def _block(self, batch: Batch, place: Place) -> Batch | None:
        if not self._blocked:
            return batch
        now, position = self._now(), 0
        while position < len(batch.view):
            end = position + 4 + _unpack_length(batch.view, position)[0]
            body = batch.view[position + 4 : end]
            self._telling.dropped(_dropped(body, now, self._blocked), place, body)
            position = end
        return None

    def _service(self, key: str, service: str, part: str, body: bytes) -> Judged:
        if self._blocked or self._spent > _LONGEST:
            return Judged(b"", self._blocked or _TOO_LONG)
        if self._set is None or not self._serves(service):
            return Judged(body)
        place, now, began = (key, service), self._now(), time.thread_time()
        view = memoryview(body)
        try:
            outcome = self._set.process_service(service, part, bytearray(body), now)
        except Exception as error:  # noqa: BLE001  a defect of the monitors must not end the relay
            outcome = _dropped(view, now, self._telling.defect(error, place, now))
        self._telling.told(outcome, place)
        self._spent += time.thread_time() - began
        self._schedule()
        if outcome.result == "dropped":
            self._telling.dropped(outcome, place, view)
            return Judged(b"", refusal(outcome, part))
        if outcome.result == "changed":
            self._telling.changed(outcome, place, body[:SHOWN], len(body))
            return Judged(bytes(outcome.buffer))
        return Judged(body)

    def _serves(self, service: str) -> bool:
        return self._set is not None and any(
            monitor.enabled and step.event.topic == service and step.event.part is not None
            for monitor in self._set.monitors
            for step in monitor.steps
        )

    # --- time ---

    def _now(self) -> int:
        return self._offset + time.monotonic_ns()

    def _schedule(self) -> None:
        """See that `_advance` is called when the next tick or deadline is due, or earlier."""
        due = self._set.next_due if self._set is not None else None
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
        began = time.thread_time()
        try:
            for outcome in self._set.advance(self._now()):
                self._telling.told(outcome, ("", ""))
        except Exception as error:  # noqa: BLE001  a defect of the monitors must not end the relay
            now = self._now()
            self._telling.defect(error, ("", ""), now)
            self._due = now + int(_AFTER_DEFECT * 1e9)
            self._timer = self._loop.after(_AFTER_DEFECT, self._advance)
            return
        self._spent += time.thread_time() - began
        self._schedule()


def _same(one: SpecificationsStated, other: SpecificationsStated) -> bool:
    return (one.files, one.definitions, one.on_fault) == (other.files, other.definitions, other.on_fault)


def _dropped(body: memoryview, now: int, reason: str) -> Outcome:
    outcome = Outcome(body, now)
    outcome.result, outcome.reason = "dropped", reason
    return outcome


def _other_definition(resource: str, name: str, md5sum: str, header: Mapping[str, str]) -> str:
    found = header.get("md5sum", "")
    if found == md5sum:
        return ""
    theirs = header.get("type", "*")
    return (
        f"the specifications understand {resource} as [{name}/{md5sum}], its messages are [{theirs}/{found}];"
        " give the specifications the definition of the robot (msg/ beside them)"
    )
