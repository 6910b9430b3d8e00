"""Monitors in the middle: the specifications in force, and what they do to messages, requests and replies.

A topic without an enabled event never comes here (`stands` is asked when something changes, not per message). The
messages of the others go through their lanes (`lane.py`).

Invariants:
- Whatever goes wrong with a monitor, a defect of this program included, ends the way of that message and of nothing
  else: it is dropped and told.
- Specifications that cannot be taken change nothing; a relay that has none yet blocks everything then.
- One swap is between two messages. What monitors publish is not given to monitors.
- The clock of monitors never goes back and makes no leap: it is the time of the day when the relay started, and
  from there the monotonic clock. The messages of one batch have come at the same time.
- A message may take its monitors `budget` seconds of processor time. One that takes longer is cut off: that is a fault.
  Messages behind it wait for their publisher's next turn. Ticks that are late and take long are left out.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from appliance.channel.messages import (
    MonitorRow,
    SpecificationsRefused,
    SpecificationsStated,
    SpecificationsTaken,
)
from appliance.relay.loop import Loop, Timer
from appliance.relay.monitors.keeper import Keeper
from appliance.relay.monitors.loader import Loader, Result
from appliance.relay.monitors.margin_counts import Margins
from appliance.relay.monitors.observation_points import NOWHERE, Place, Senders
from appliance.relay.monitors.observations import SHOWN, Observations
from appliance.relay.monitors.observer import Observer, refusal
from appliance.relay.monitors.pace import Pace
from appliance.relay.monitors.shadow import Trials
from appliance.relay.monitors.topic_pipeline import Lane, dropped
from appliance.relay.report import Reporter
from rosmop.form.connected_groups import way_of
from rosmop.run.causes import Sender
from rosmop.runtime.action_context import Published

if TYPE_CHECKING:
    from rosmop.run.engine import MonitorSet
    from rosmop.run.fast_path import FastLane, Prepared
    from rosmop.run.monitor import Monitor
    from rosmop.run.outcomes import Outcome

_AFTER_DEFECT = 1.0
_NO_MEMORY = "the relay process before this one ended, and nothing keeps the state of monitors"


@dataclass(frozen=True, slots=True)
class Judged:
    """What becomes of a request or a reply: the body to pass on, or the reason why it is refused."""

    body: bytes
    refused: str | None = None


class Middle:
    """The monitors of one relay.

    `budget` is how many seconds of processor time a message may take. `publish(published)` sends what a monitor
    publishes; `changed(topics)` is called when other topics may be wanted, with those whose messages may fare otherwise
    now (None: all). `holder(host)` is charged for the slices that messages of this host make, `payer(host)` for their
    processor time.
    """

    def __init__(
        self,
        loop: Loop,
        reporter: Reporter,
        *,
        budget: float,
        publish: Callable[[Published], None],
        changed: Callable[[frozenset[str] | None], None],
        holder: Callable[[str], str] = str,
        payer: Callable[[str], str] = str,
    ) -> None:
        self._loop = loop
        self.budget = budget
        self.over = loop.over
        self._reporter = reporter
        self._offset = time.time_ns() - time.monotonic_ns()
        self.monitors: MonitorSet | None = None
        self._stated: SpecificationsStated | None = None
        self._switches: dict[str, bool] = {}
        self.blocked = ""
        self._awaited: SpecificationsStated | None = None
        self.sight = object()
        self._paces: dict[Place, Pace] = {}
        """Of places whose messages were cut off in the last two seconds, and others."""
        self._prepared: dict[tuple[Place, str], Prepared] = {}
        """For the walks of requests and replies until there is another `sight`: at most a second."""
        self._timer: Timer | None = None
        self._due: int | None = None
        self._loader = Loader(loop, self.loaded, self.holder_of)
        self.observations = Observations(loop, reporter, self._rows)
        self._changed = changed
        self._holder = holder
        self._payer = payer
        self._shared_pace = Pace()
        self.senders = Senders()
        self._margins = Margins()
        self._publish = publish
        self._keeper: Keeper | None = None
        self.observer = Observer(self.observations, self._published, self._margins, self.senders)
        self._on_trial = Observer(
            self.observations, lambda _published: None, self._margins, self.senders, "trial "
        )
        self.trials = Trials(loop, self.now, self._on_trial)

    def remember(self, keeper: Keeper) -> None:
        """Keep the state of the monitors there, and begin with what it has; before anything is stated."""
        self._keeper = keeper
        self._offset = keeper.offset

    # --- what control states ---

    def state(self, message: SpecificationsStated) -> None:
        """Take these specifications, at once or when they are loaded; the same as before keep their state."""
        self._switches = dict(message.enabled)
        if not self._loader.busy:
            if self._stated is not None and not self.blocked and _same(message, self._stated):
                self._taken(message, [], frozenset())
                return
            if not message.part and (self._stated is None or self.blocked):
                self._stated, self.blocked = message, ""
                if self._keeper is not None:
                    self._keeper.take_nothing()
                self._taken(message, [], None)
                return
        if message.ahead or (self._stated is None and not self.blocked):
            self._awaited = message
        self._loader.later(message)

    def loaded(self, message: SpecificationsStated, result: Result) -> None:
        """Put a set that was loaded into force, or refuse it, and tell control."""
        if message is self._awaited:
            self._awaited = None
        self.look_again()
        if isinstance(result, list):
            self._refuse(message, result)
            return
        result.limit_time(time.thread_time, self.budget)
        result.explain_when(self.observer.asks, self._on_trial.asks)
        before, now, first = self.monitors, self.now(), self._stated is None or bool(self.blocked)
        if before is None:
            outcome = self._begun(result, now, restarted=first and message.restarted)
        else:
            incomplete = self.trials.settle()
            self._margins.take(before, now)
            outcome = result.succeed(before, now, incomplete)
        self.monitors, self._stated, self.blocked = result, message, ""
        began = list(result.began)
        self._margins.keep([monitor.name for monitor in (*result.monitors, *result.tried)], began)
        for monitor in result.monitors:
            if monitor.name in message.moved and monitor.name in began and not monitor.held:
                result.hold_lost(
                    monitor, "it is on another relay process now, and its state was on the one before"
                )
            if monitor.why_held and monitor.name in began and not self._switches.get(monitor.name, True):
                monitor.resume()  # it was disabled, and guarded nothing
        if self._keeper is not None:
            self._keeper.take(result)
        self.observer.keep([monitor.name for monitor in result.monitors], began, now)
        self.observer.told(outcome, NOWHERE)
        self.trials.take(result, outcome)
        anew = None if first else _topics(_replaced(before, result))
        self._taken(message, began, anew)

    def _begun(self, monitors: MonitorSet, now: int, *, restarted: bool) -> Outcome:
        """The first monitors of this process begin, or go on where an earlier one ended."""
        left = self._keeper.recovered() if self._keeper is not None else None
        if left is not None:
            return monitors.recover(left.groups, left.lost, now, restarted=restarted)
        if restarted and self._keeper is None:
            return monitors.recover((), {"": _NO_MEMORY}, now, restarted=True)
        return monitors.start(now, restarted=restarted)

    def holder_of(self, source: int) -> str:
        """Return who is charged for the slices that messages of this source make."""
        place = self.senders.place(source)
        return self._holder("" if place is None else place.host)

    def _taken(self, message: SpecificationsStated, began: list[str], anew: frozenset[str] | None) -> None:
        self.look_again()
        held: list[str] = []
        because: dict[str, str] = {}
        if self.monitors is not None:
            both = (*self.monitors.monitors, *self.monitors.tried)
            switches = {monitor.name: self._switches.get(monitor.name, True) for monitor in both}
            switched = _topics(self.monitors.switch(switches, self.now()))
            anew = None if anew is None else anew | switched
            held = [monitor.name for monitor in self.monitors.monitors if monitor.held]
            because = {one.name: one.why_held for one in self.monitors.monitors if one.why_held}
            self.keep_all()
        self.schedule()
        self.trials.schedule()
        self._changed(anew)
        self._reporter.send(SpecificationsTaken(message.revision, began, held, message.statement, because))

    def _refuse(self, message: SpecificationsStated, findings: list[str]) -> None:
        self.look_again()
        if self._stated is None:
            reason = f"the specifications of revision {message.revision} could not be taken: {findings[0]}"
            self.blocked = reason
        self._changed(None if self._stated is None else frozenset())
        self._reporter.send(SpecificationsRefused(message.revision, findings[:100], message.statement))

    def switch(self, name: str, enabled: bool) -> None:
        """Let the events of a monitor happen, or not; an unknown name is fine (it is gone)."""
        self.look_again()
        self._switches[name] = enabled
        if self.monitors is not None:
            switched = self.monitors.switch({name: enabled}, self.now())
            if switched:
                self.keep_all()
                self.schedule()
                self.trials.schedule()
                self._changed(_topics(switched))

    def resume(self, name: str) -> frozenset[str]:
        """Let the topics of a monitor that holds them go on; they."""
        self.look_again()
        if self.monitors is None:
            return frozenset()
        held = [monitor for monitor in self.monitors.monitors if monitor.name == name and monitor.held]
        for monitor in held:
            self.monitors.resume(monitor.name)
        self.keep_all()
        return _topics(held)

    # --- what is asked when something changes ---

    @property
    def preparing(self) -> bool:
        """Whether specifications are loaded that must be in force before anything else is carried out."""
        return self._awaited is not None

    def stands(self, topic: str) -> bool:
        """Whether messages of a topic go through here."""
        return bool(self.blocked) or (self.monitors is not None and self.monitors.wants(topic))

    def wants(self, topic: str) -> bool:
        """Whether a monitor wants a topic's messages even if nobody else does."""
        return self.monitors is not None and self.monitors.wants(topic)

    def objection(self, topic: str, header: Mapping[str, str]) -> str:
        """Why a publisher's messages cannot be understood by the monitors of its topic; empty when they can."""
        monitors = self.monitors
        name = monitors.type_of(topic, tried=True) if monitors is not None else None
        if monitors is None or name is None:
            return ""
        objection = _other_definition(topic, name, monitors.md5sum(name), header)
        return self._objection(topic, objection, monitors.type_of(topic) is None)

    def service_objection(self, service: str, header: Mapping[str, str]) -> str:
        """The same of a service, by the header it answers with."""
        monitors = self.monitors
        name = monitors.service_type_of(service, tried=True) if monitors is not None else None
        if monitors is None or name is None:
            return ""
        objection = _other_definition(service, name, monitors.definitions.service_md5sum(name), header)
        return self._objection(service, objection, monitors.service_type_of(service) is None)

    def _objection(self, resource: str, objection: str, only_tried: bool) -> str:
        """Those on trial object to nothing: they are not given what they do not understand."""
        self.trials.understand(resource, objection)
        return "" if only_tried else objection

    def header_of(self, topic: str) -> dict[str, str] | None:
        """The connection header, without names, for what monitors publish on a topic; None if none does."""
        if self.monitors is None or topic not in self.monitors.publications:
            return None
        name = self.monitors.publications[topic]
        return {
            "type": name,
            "md5sum": self.monitors.md5sum(name),
            "message_definition": self.monitors.definitions.full_text(name),
            "latching": "0",
        }

    # --- what is kept ---

    def keep(self, way: str) -> None:
        """Keep the state of those that judge messages on a topic: before one of these is passed on."""
        if self._keeper is not None:
            self._keeper.keep(way)

    def keep_all(self) -> None:
        """Keep the state of all monitors."""
        if self._keeper is not None:
            self._keeper.keep_all()

    def _published(self, published: Published) -> None:
        self.keep_all()
        self._publish(published)

    # --- messages ---

    def lane(self, place: Place) -> Lane:
        """Where the messages of this publication go through."""
        return Lane(self, place)

    def pace(self, place: Place) -> Pace:
        """Return the pace of messages from a place; hosts that pay as one have one."""
        if self._payer(place.host) != place.host:
            return self._shared_pace
        if place not in self._paces:
            self._paces[place] = Pace()
        return self._paces[place]

    def look_again(self) -> None:
        """Something has happened that may change what lanes have prepared, and what is prepared here."""
        self.sight = object()
        self._prepared.clear()

    def request(self, place: Place, body: bytes) -> Judged:
        """What becomes of a client's request to a service."""
        return self._service(place, "request", body)

    def response(self, place: Place, body: bytes) -> Judged:
        """What becomes of a service's reply to a request."""
        return self._service(place, "response", body)

    def tick(self) -> None:
        """A second is over."""
        self.look_again()
        self.observer.tick(self.now())
        self.trials.tick()
        if self.monitors is not None:
            self._margins.take(self.monitors, self.now())
        self.observations.tick()
        now = self.now()
        self._paces = {place: pace for place, pace in self._paces.items() if pace.part(now) < 1}

    def close(self) -> None:
        """The relay ends."""
        self._loader.close()
        self.trials.close()
        if self._timer is not None:
            self._timer.cancel()

    # --- inside ---

    def _rows(self) -> list[MonitorRow]:
        if self.monitors is None:
            return []
        rows = self.observer.rows(self.monitors.monitors, self.now())
        return rows + self._on_trial.rows(self.monitors.tried, self.now())

    def _service(self, place: Place, part: str, body: bytes) -> Judged:
        service = place.resource
        if self.blocked:
            return Judged(b"", self.blocked)
        if self.monitors is None or self.monitors.service_type_of(service, tried=True) is None:
            return Judged(body)
        now, due = self.now(), self.monitors.next_due
        view = memoryview(body)
        outcome = self._walked(self.monitors, place, way_of(service, part), body, now)
        if outcome is None:
            self.look_again()
            pace = self.pace(place)
            self.monitors.hurry(pace.part(now))
            try:
                outcome = self.monitors.process_service(
                    service, part, bytearray(body), now, Sender(self.senders.number(place))
                )
            except Exception as error:  # noqa: BLE001  a defect of the monitors must not end the relay
                outcome = dropped(view, now, self.observer.defect(error, place, now))
            if outcome.faults and self.monitors.late:
                pace.cut(now)
            if self.monitors.tapped:
                self.trials.wait(place, None)
        elif self.monitors.next_due != due:
            self.look_again()
        self.keep(way_of(service, part))
        self.observer.told(outcome, place)
        self.schedule()
        if outcome.result == "dropped":
            self.observer.dropped(outcome, place, view)
            return Judged(b"", refusal(outcome, part))
        if outcome.result == "changed":
            self.observer.changed(outcome, place, body[:SHOWN], len(body))
            return Judged(bytes(outcome.buffer))
        return Judged(body)

    def _walked(self, monitors: MonitorSet, place: Place, way: str, body: bytes, now: int) -> Outcome | None:
        """What the module says, if nothing is to be told of it but how much there was; a refusal is told its client."""
        observer = self.observer

        def prepare(walker: FastLane) -> Prepared:
            prepared = self._prepared.get((place, way))
            if prepared is None:
                prepared = self._prepared[place, way] = walker.prepare(
                    loud=walker.changes and observer.shows(place),
                    told=[True] * len(walker.events),
                    counted=[observer.hides_verdict(verdict, place) for verdict in walker.verdicts],
                    source=self.senders.number(place),
                )
            return prepared

        try:
            fuel = self.pace(place).fuel(now, self.budget)
            return monitors.taken(way, body, now, prepare, fuel)
        except Exception as error:  # noqa: BLE001  a defect of the walk must not end the relay
            observer.defect(error, place, now)
            return None

    # --- time ---

    def now(self) -> int:
        """The time of monitors, in nanoseconds."""
        return self._offset + time.monotonic_ns()

    def schedule(self) -> None:
        """See that `_advance` is called when the next tick or deadline is due, or earlier."""
        due = self.monitors.next_due if self.monitors is not None else None
        if due is None or (self._due is not None and self._due <= due):
            return
        if self._timer is not None:
            self._timer.cancel()
        self._due = due
        self._timer = self._loop.after(max(0, due - self.now()) / 1e9, self._advance)

    def _advance(self) -> None:
        self.look_again()
        self._due = self._timer = None
        if self.monitors is None:
            return
        self.monitors.hurry(1.0)
        try:
            for outcome in self.monitors.advance(self.now()):
                self.observer.told(outcome, NOWHERE)
        except Exception as error:  # noqa: BLE001  a defect of the monitors must not end the relay
            now = self.now()
            self.observer.defect(error, NOWHERE, now)
            self._due = now + int(_AFTER_DEFECT * 1e9)
            self._timer = self._loop.after(_AFTER_DEFECT, self._advance)
            return
        self.keep_all()
        self.schedule()


def _topics(monitors: Iterable[Monitor]) -> frozenset[str]:
    return frozenset(step.event.topic for monitor in monitors for step in monitor.steps if step.event.topic)


def _replaced(before: MonitorSet | None, after: MonitorSet) -> list[Monitor]:
    """The monitors of both sets that do not go on as they were."""
    earlier = before.monitors if before is not None else ()
    kept = {monitor.name for monitor in after.monitors} & {monitor.name for monitor in earlier} - set(
        after.began
    )
    return [monitor for monitor in (*earlier, *after.monitors) if monitor.name not in kept]


def _same(one: SpecificationsStated, other: SpecificationsStated) -> bool:
    return (one.part, one.enabled.keys(), one.on_fault, one.trials, one.slices) == (
        other.part,
        other.enabled.keys(),
        other.on_fault,
        other.trials,
        other.slices,
    )


def _other_definition(resource: str, name: str, md5sum: str, header: Mapping[str, str]) -> str:
    found = header.get("md5sum", "")
    if found == md5sum:
        return ""
    theirs = header.get("type", "*")
    return (
        f"the specifications understand {resource} as [{name}/{md5sum}], its messages are [{theirs}/{found}];"
        " give the specifications the definition of the robot (msg/ beside them)"
    )
