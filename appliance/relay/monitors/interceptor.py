"""The monitors of one relay: the specifications in force, and their effects on messages, requests and replies.

- A fault of a monitor, or a defect of this program, drops only the current message, and is reported.
- Refused specifications change nothing, but a relay whose first ones are refused blocks all messages.
- Specifications are replaced between two messages. A published message goes only through later monitors.
- The clock of monitors never goes back or jumps. All messages of a batch have the same time.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from ipaddress import ip_address, ip_network
from typing import TYPE_CHECKING

from appliance.base import clock
from appliance.channel.messages import (
    GivenValue,
    MonitorGiven,
    MonitorRow,
    MonitorSwitched,
    SpecificationsRefused,
    SpecificationsStated,
    SpecificationsTaken,
    StateWanted,
    StopBegun,
    StopWanted,
    ValuesSeen,
    ValuesWanted,
)
from appliance.relay.loop import EventLoop, LoopTimer
from appliance.relay.monitors.loader import Loader, Result
from appliance.relay.monitors.observation_points import NOWHERE, ObservationPoint, Senders
from appliance.relay.monitors.observations import SHOWN, Observations
from appliance.relay.monitors.observer import Observer, dropped_outcome, refusal
from appliance.relay.monitors.shadow import ShadowMonitors
from appliance.relay.monitors.state_keeper import LEAVING, StateKeeper, clock_shift, start_outcome, state_left
from appliance.relay.monitors.state_memory import NOT_KEPT, CellsPlace
from appliance.relay.monitors.time_budget import TimeBudgets
from appliance.relay.report import Reporter
from appliance.relay.transport.pump import Version
from rosmop.run.outcomes import MessageSender
from roswire.definitions import Definitions
from roswire.errors import DefinitionError
from roswire.tcpros import ServiceReply

if TYPE_CHECKING:
    from rosmop.run.engine import MonitorSet
    from rosmop.run.fast_path import BatchOptions, FastLane
    from rosmop.run.outcomes import Outcome, Published


# The hosts that get no message of a topic while a monitor withholds it.

_MAX_KNOWN = 1000


class HostMask:
    """Hides a topic from hosts in the networks that `networks()` returns, at each delivery."""

    def __init__(self, networks: Callable[[], tuple[str, ...]]) -> None:
        self._networks = networks
        self._known: dict[tuple[str, str], bool] = {}

    def hides(self, host: str) -> bool:
        """Return whether to hide the topic from this host; a host without an IP address counts as in every network."""
        return any(self._contains(network, host) for network in self._networks())

    def _contains(self, network: str, host: str) -> bool:
        found = self._known.get((network, host))
        if found is None:
            try:
                found = ip_address(host) in ip_network(network)
            except ValueError:
                found = True
            if len(self._known) >= _MAX_KNOWN:
                self._known.clear()
            self._known[network, host] = found
        return found


# Let monitors hold their topics when specifications are loaded, and report those that hold to control.


def hold_begun(monitors: MonitorSet, message: SpecificationsStated, switches: Mapping[str, bool]) -> None:
    """Let monitors that began in their initial state hold their topics, if they moved or cannot be built.

    A disabled monitor guarded nothing, so it does not hold its topics.
    """
    for monitor in monitors.monitors:
        if monitor.name not in monitors.began:
            continue
        if monitor.name in message.moved and not monitor.held:
            monitors.hold_lost(
                monitor, "it moved to another relay process, and its state remained in the previous one"
            )
        if monitor.name in message.unbuilt and monitor.held_channels and not monitor.code.begins:
            monitors.hold(monitor, f"its file has an error: {message.unbuilt[monitor.name]}")
        if monitor.why_held and not switches.get(monitor.name, True):
            monitors.resume(monitor.name)


def taken_report(
    message: SpecificationsStated, began: list[str], monitors: MonitorSet | None
) -> SpecificationsTaken:
    held = [] if monitors is None else [monitor for monitor in monitors.monitors if monitor.held]
    because = {one.name: one.why_held for one in held if one.why_held}
    return SpecificationsTaken(
        message.revision, began, [one.name for one in held], message.statement, because
    )


MonitorOrder = MonitorSwitched | MonitorGiven | StopWanted | ValuesWanted
"""Control's orders and queries about monitors in force, beside new specifications."""

_AFTER_DEFECT = 1.0
_REPLAYED = "its publisher had latched this command before the relay connected to it; send it again"


class Interceptor:
    """The monitors of one relay. A topic without an enabled event bypasses them.

    `changed(topics)` is called when monitors may want other topics; `topics` are those whose messages may now be
    judged differently (None: all). `holder(host)` is charged for the slices that a host's messages create,
    `payer(host)` for their processor time. `publishers(topic)` returns the nodes that publish a topic now. A message
    that takes more than `budget` seconds of processor time is cut off, which is a fault. A monitor that acts more than
    `late` seconds later than due is late.
    """

    def __init__(
        self,
        loop: EventLoop,
        reporter: Reporter,
        *,
        budget: float,
        publish: Callable[[Published], None],
        changed: Callable[[frozenset[str] | None], None],
        holder: Callable[[str], str] = str,
        payer: Callable[[str], str] = str,
        publishers: Callable[[str], Sequence[ObservationPoint]] = lambda _topic: (),
        late: float = math.inf,
    ) -> None:
        self._loop = loop
        self.late = late
        self._erroneous: tuple[str, ...] = ()
        self.budget = budget
        self.over = loop.over
        self._reporter = reporter
        self.offset = clock.wall_ns() - clock.now_ns()
        self.monitors: MonitorSet | None = None
        self._stated: SpecificationsStated | None = None
        self._switches: dict[str, bool] = {}
        self._given: dict[str, dict[str, GivenValue]] = {}
        self.blocked = ""
        self._awaited: SpecificationsStated | None = None
        self.preparation = Version()
        """The version of all options that pipelines and services have prepared."""
        self.time_budgets = TimeBudgets(payer)
        self._prepared: dict[tuple[ObservationPoint, str], BatchOptions] = {}
        """The prepared options for requests and replies; they last a second, or until `preparation` changes."""
        self._timer: LoopTimer | None = None
        self._due: int | None = None
        self._loader = Loader(loop, self.loaded, self.holder_of)
        self.observations = Observations(loop, reporter, self._rows, lambda: clock.wall_ns() - self.now())
        self._changed = changed
        self._holder = holder
        self.senders = Senders()
        self._publish = publish
        self._keeper: StateKeeper | None = None
        self.observer = Observer(
            self.observations,
            self._on_publication,
            self.senders,
            held=self._tell_held,
            now=self.now,
            bound=late,
            publishers=publishers,
        )
        self._shadow_observer = Observer(self.observations, lambda _published: None, self.senders, "shadow ")
        self.shadow = ShadowMonitors(loop, self.now, self._shadow_observer)

    def remember(self, keeper: StateKeeper) -> None:
        self._keeper = keeper
        self.offset = keeper.offset

    # --- control's statements ---

    def state(self, message: SpecificationsStated | StateWanted) -> None:
        """Apply these specifications, at once or when they are loaded; unchanged monitors keep their state.

        With `StateWanted`, send the state of the monitors; unless it is for a copy, drop all messages from now on.
        """
        if isinstance(message, StateWanted):
            self._leave(message)
            return
        self._switches, self._given = dict(message.enabled), dict(message.given)
        self._erroneous = (*message.left_out, *message.unbuilt)
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
        if message is self._awaited:
            self._awaited = None
        self.invalidate_prepared()
        if isinstance(result, list):
            self._refuse(message, result)
            return
        result.limit_time(time.thread_time, self.budget)
        result.explain_when(self.observer.asks, self._shadow_observer.asks)
        result.give(self._given)
        result.name_senders(self.senders.names)
        before, first = self.monitors, self._stated is None or bool(self.blocked)
        if before is None and first:
            self.offset += clock_shift(message, self._keeper, self.now())
        now = self.now()
        if before is None:
            outcome = start_outcome(result, message, self._keeper, now, restarted=first and message.restarted)
        else:
            outcome = result.succeed(before, now, self.shadow.settle())
        self.monitors, self._stated, self.blocked = result, message, ""
        began = list(result.began)
        hold_begun(result, message, self._switches)
        if self._keeper is not None:
            self._keeper.take(result)
        self.observer.take(result)
        self.observer.keep([monitor.name for monitor in result.monitors], began, now)
        self.observer.report(outcome, NOWHERE)
        self.shadow.take(result, outcome)
        anew = None if first else result.replaced_topics(before)
        self._taken(message, began, anew)

    def _leave(self, message: StateWanted) -> None:
        if not message.copy:
            self.blocked = LEAVING
            self.invalidate_prepared()
            self._changed(None)
        self._reporter.send(state_left(message, self._keeper))

    def holder_of(self, source: int) -> str:
        point = self.senders.point(source)
        return self._holder("" if point is None else point.host)

    def _taken(self, message: SpecificationsStated, began: list[str], anew: frozenset[str] | None) -> None:
        switched = self._apply()
        self._changed(None if anew is None else anew | switched)
        self._reporter.send(taken_report(message, began, self.monitors))

    def _apply(self) -> frozenset[str]:
        """Switch the monitors, and give them their constants; return the topics of those that were switched."""
        self.invalidate_prepared()
        if self.monitors is None:
            return frozenset()
        both = (*self.monitors.monitors, *self.monitors.shadowed)
        switches = {monitor.name: self._switches.get(monitor.name, True) for monitor in both}
        switched = self.monitors.switch(switches, self.now())
        self.monitors.give(self._given)
        if (restarted := self.monitors.take_restarted()) is not None:
            self.observer.report(restarted, NOWHERE)
        self.keep_all()
        self.schedule()
        self.shadow.schedule()
        return self.monitors.topics_of(switched)

    def _tell_held(self) -> None:
        self.invalidate_prepared()
        if self._stated is not None:
            self._reporter.send(taken_report(self._stated, [], self.monitors))

    def _refuse(self, message: SpecificationsStated, findings: list[str]) -> None:
        self.invalidate_prepared()
        if self._stated is None:
            reason = f"the specifications of revision {message.revision} could not be loaded: {findings[0]}"
            self.blocked = reason
        self._changed(None if self._stated is None else frozenset())
        self._reporter.send(SpecificationsRefused(message.revision, findings[:100], message.statement))

    def order(self, message: MonitorOrder) -> None:
        if isinstance(message, MonitorSwitched):
            self.switch(message.name, message.enabled)
        elif isinstance(message, StopWanted):
            self._reporter.send(StopBegun(message.number, self._stoppers(message.topic, begin=message.begin)))
        elif isinstance(message, ValuesWanted):
            now = self.now()
            found = None if self.monitors is None else self.monitors.read_out(message.monitor, now)
            values, ages = found or (None, dict[str, float | None]())
            self._reporter.send(ValuesSeen(message.number, values, ages, now))
        else:
            self._given[message.name] = dict(message.values)
            self._apply()

    def switch(self, name: str, enabled: bool) -> None:
        self._switches[name] = enabled
        self._changed(self._apply())

    def resume(self, name: str) -> frozenset[str]:
        self.invalidate_prepared()
        if self.monitors is None:
            return frozenset()
        held = [one for one in self.monitors.monitors if one.name == name and (one.held or one.awaits)]
        for monitor in held:
            self.monitors.resume(monitor.name)
        self.keep_all()
        return self.monitors.topics_of(held)

    def unfit(self) -> str:
        """Return why a monitor in force cannot act now, or an empty text."""
        monitors = self.monitors
        if self.blocked or self._stated is None:
            return self.blocked or "the relay has no specifications yet"
        if self._erroneous:
            return f"{self._erroneous[0]} has an error, and does not run"
        if monitors is None:
            return ""
        if monitors.next_due is not None and self.now() - monitors.next_due > self.late * 1e9:
            return "ticks of the monitors are overdue"
        return monitors.unfit()

    def copy_source(self, guard: str) -> tuple[SpecificationsStated, dict[str, dict[str, GivenValue]]] | str:
        """Return what a copy of a monitor in force is made from, or why there is none."""
        if self._stated is None or self.blocked or self.monitors is None:
            return self.blocked or "the relay has no specifications yet"
        if guard not in self.monitors.acting():
            return f"{guard} is not in force in its relay"
        return self._stated, self._given

    @property
    def acting(self) -> list[str]:
        """The monitors in force that may stop, change or withhold messages."""
        return [] if self.monitors is None else self.monitors.acting()

    def judges(self, topic: str) -> list[str]:
        """Return the monitors in force that judge or observe a topic."""
        return [] if self.monitors is None else self.monitors.judges(topic)

    def holds(self, topic: str) -> bool:
        """Return whether all messages of a topic are dropped now, whatever they are."""
        return bool(self.blocked) or (self.monitors is not None and self.monitors.holds(topic))

    def has_stoppers(self, topic: str) -> bool:
        return self.monitors is not None and bool(self.monitors.stoppers(topic))

    def is_stop(self, topic: str, data: bytes) -> bool:
        return self.monitors is not None and self.monitors.is_safe(topic, data)

    def refuse_replay(self, point: ObservationPoint, body: memoryview) -> None:
        self.observer.dropped(dropped_outcome(body, self.now(), _REPLAYED), point, body)

    def _stoppers(self, topic: str, *, begin: bool) -> list[str]:
        if self.monitors is None:
            return []
        names = self.monitors.stoppers(topic)
        if begin and names:
            self.invalidate_prepared()
            self.monitors.stop(topic)
            self.schedule()
        return names

    # --- queries when something changes ---

    @property
    def preparing(self) -> bool:
        """Whether specifications must be in force before any other message is carried out."""
        return self._awaited is not None

    def intercepts(self, topic: str) -> bool:
        return bool(self.blocked) or (self.monitors is not None and self.monitors.wants(topic))

    def wants(self, topic: str) -> bool:
        return self.monitors is not None and self.monitors.wants(topic)

    def mask(self, topic: str) -> Callable[[str], bool] | None:
        monitors = self.monitors
        if monitors is None or not monitors.may_withhold(topic):
            return None
        return HostMask(lambda: monitors.withheld_from(topic)).hides

    def objection(self, point: ObservationPoint, header: Mapping[str, str]) -> str:
        monitors, topic = self.monitors, point.resource
        name = monitors.type_of(topic, shadowed=True) if monitors is not None else None
        if monitors is None or name is None:
            return ""
        objection = _other_definition(topic, name, monitors.md5sum(name), header) or _other_text(
            topic, name, monitors.definitions, header
        )
        return self._objection(point, objection, monitors.type_of(topic) is None)

    def service_objection(self, point: ObservationPoint, header: Mapping[str, str]) -> str:
        monitors, service = self.monitors, point.resource
        name = monitors.service_type_of(service, shadowed=True) if monitors is not None else None
        if monitors is None or name is None:
            return ""
        objection = _other_definition(service, name, monitors.definitions.service_md5sum(name), header)
        return self._objection(point, objection, monitors.service_type_of(service) is None)

    def _objection(self, point: ObservationPoint, objection: str, only_tried: bool) -> str:
        """Return the objection, unless only monitors in shadow mode have it: they just miss what they cannot read."""
        self.shadow.understand(point, objection)
        return "" if only_tried else objection

    def header_of(self, topic: str) -> dict[str, str] | None:
        if self.monitors is None or topic not in self.monitors.publications:
            return None
        return {**self._claim(self.monitors, self.monitors.publications[topic]), "latching": "0"}

    def claim_of(self, topic: str) -> dict[str, str]:
        name = self.monitors.type_of(topic, shadowed=True) if self.monitors is not None else None
        return {} if self.monitors is None or name is None else self._claim(self.monitors, name)

    @staticmethod
    def _claim(monitors: MonitorSet, name: str) -> dict[str, str]:
        definition = monitors.definitions.full_text(name)
        return {"type": name, "md5sum": monitors.md5sum(name), "message_definition": definition}

    # --- kept state ---

    def keep(self, way: str) -> None:
        if self._keeper is not None and not self._keeper.keep(way):
            self.invalidate_prepared()

    def keep_all(self) -> None:
        if self._keeper is not None and not self._keeper.keep_all():
            self.invalidate_prepared()

    def cells_place(self, way: str) -> CellsPlace | None:
        return NOT_KEPT if self._keeper is None else self._keeper.cells_place(way)

    def _on_publication(self, message: Published) -> None:
        self.keep_all()
        self._publish(message)

    # --- messages ---

    def invalidate_prepared(self) -> None:
        self.preparation.change()
        self._prepared.clear()

    def judge(self, point: ObservationPoint, part: str, body: bytes) -> ServiceReply:
        """Return the body of a request or reply to pass on, or an error with the reason why it is refused."""
        service = point.resource
        if self.blocked:
            return ServiceReply(False, self.blocked.encode())
        if self.monitors is None or self.monitors.service_type_of(service, shadowed=True) is None:
            return ServiceReply(True, body)
        now, due = self.now(), self.monitors.next_due
        view = memoryview(body)
        channel = self.monitors.channel_of(service, part)
        outcome = self._walk(self.monitors, point, channel, body, now)
        if outcome is None:
            self.invalidate_prepared()
            time_budget = self.time_budgets.of(point)
            self.monitors.hurry(time_budget.part(now, len(body)))
            try:
                outcome = self.monitors.process_service(
                    service, part, bytearray(body), now, MessageSender(self.senders.number(point))
                )
            except Exception as error:  # noqa: BLE001  a defect of the monitors must not end the relay
                outcome = dropped_outcome(view, now, self.observer.defect(error, point, now))
            if any(fault.over for fault in outcome.faults):
                time_budget.cut(now, len(body))
            if self.monitors.tapped:
                self.shadow.wait(point, None)
        elif self.monitors.next_due != due:
            self.invalidate_prepared()
        self.keep(channel)
        self.observer.report(outcome, point)
        self.schedule()
        if outcome.result == "dropped":
            self.observer.dropped(outcome, point, view)
            return ServiceReply(False, refusal(outcome, part).encode("utf-8", "replace"))
        if outcome.result == "changed":
            self.observer.changed(outcome, point, body[:SHOWN], len(body))
            return ServiceReply(True, bytes(outcome.buffer))
        return ServiceReply(True, body)

    def tick(self) -> None:
        """Send the counts of this second; the next event of each kind is reported in full.

        If there was no event, the options already ask for this, and stay valid.
        """
        self.observer.tick(self.now())
        self.shadow.tick()
        if self.observations.some:
            self.invalidate_prepared()
        self._prepared.clear()
        self.observations.tick()
        self.time_budgets.forget_recovered(self.now())

    def close(self) -> None:
        self._loader.close()
        self.shadow.close()
        if self._timer is not None:
            self._timer.cancel()

    # --- internals ---

    def _rows(self) -> list[MonitorRow]:
        if self.monitors is None:
            return []
        rows = self.observer.rows(self.monitors, self.now())
        return rows + self._shadow_observer.rows(self.monitors, self.now())

    def _walk(
        self, monitors: MonitorSet, point: ObservationPoint, way: str, body: bytes, now: int
    ) -> Outcome | None:
        observer = self.observer

        def prepare(lane: FastLane) -> BatchOptions:
            prepared, source = self._prepared.get((point, way)), self.senders.number(point)
            if prepared is None or prepared.source != source:
                prepared = self._prepared[point, way] = lane.prepare(
                    loud=lane.changes and observer.shows(point),
                    told=[True] * len(lane.events),
                    counted=[observer.hides_verdict(verdict, point) for verdict in lane.verdicts],
                    source=source,
                )
            return prepared

        try:
            fuel = self.time_budgets.of(point).fuel(now, self.budget, len(body))
            return monitors.process_fast(way, body, now, prepare, fuel)
        except Exception as error:  # noqa: BLE001  a defect of the walk must not end the relay
            observer.defect(error, point, now)
            return None

    # --- time ---

    def now(self) -> int:
        return self.offset + clock.now_ns()

    def schedule(self) -> None:
        due = self.monitors.next_due if self.monitors is not None else None
        if due is None or (self._due is not None and self._due <= due):
            return
        if self._timer is not None:
            self._timer.cancel()
        self._due = due
        self._timer = self._loop.after(max(0, due - self.now()) / 1e9, self._advance)

    def _advance(self) -> None:
        self.invalidate_prepared()
        self._due = self._timer = None
        if self.monitors is None:
            return
        self.monitors.hurry(1.0)
        try:
            for outcome in self.monitors.advance(self.now()):
                self.observer.report(outcome, NOWHERE)
        except Exception as error:  # noqa: BLE001  a defect of the monitors must not end the relay
            now = self.now()
            self.observer.defect(error, NOWHERE, now)
            self._due = now + int(_AFTER_DEFECT * 1e9)
            self._timer = self._loop.after(_AFTER_DEFECT, self._advance)
            return
        self.keep_all()
        self.schedule()


def _same(one: SpecificationsStated, other: SpecificationsStated) -> bool:
    return (one.part, one.enabled.keys(), one.on_fault, one.shadows, one.slices) == (
        other.part,
        other.enabled.keys(),
        other.on_fault,
        other.shadows,
        other.slices,
    )


def _other_definition(resource: str, name: str, md5sum: str, header: Mapping[str, str]) -> str:
    found = header.get("md5sum", "")
    if found == md5sum:
        return ""
    theirs = f"{header.get('type', '*')[:200]}/{found[:32]}"  # a peer chooses the texts
    return (
        f"the specifications define {resource} as [{name}/{md5sum}], but its messages are [{theirs}];"
        " add the robot's definition to the specifications (in msg/ beside them)"
    )


def _other_text(topic: str, name: str, definitions: Definitions, header: Mapping[str, str]) -> str:
    """Return an objection to a publisher's definition that differs, although it has the same md5sum.

    A definition that is left out, cannot be read, or is far longer than ours, such as a comment of megabytes, says
    nothing: the md5sum decides.
    """
    ours, theirs = definitions.full_text(name), header.get("message_definition", "")
    if theirs in ("", ours) or len(theirs) > 2 * len(ours) + _LONGER:
        return ""
    try:
        same = Definitions.from_full_text(name, theirs).fingerprint(name) == definitions.fingerprint(name)
    except DefinitionError:
        return ""
    if same:
        return ""
    return (
        f"the specifications and the publisher define {topic} as {name} with the same md5sum, but with other arrays or"
        " nested types; add the robot's definition to the specifications (in msg/ beside them)"
    )


_LONGER = 1 << 15  # characters of comments
