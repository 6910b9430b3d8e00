"""Run monitors in shadow mode on copies of messages that have already been passed on.

- Their actions reach no message, subscriber or monitor in force; they are only reported.
- They take at most `SHARE` of the processor's time, and the loop continues between slices.
- If too many messages wait, some are missed, and the monitors count as incomplete. So does a monitor that exceeds its
  instructions or has a defect; it rests until the second is over.
- Ticks and deadlines are processed after the messages that arrived before them.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

from appliance.relay.loop import EventLoop, LoopTimer
from appliance.relay.monitors.observation_points import NOWHERE, ObservationPoint, ObservedMessage
from appliance.relay.monitors.observer import Observer
from rosmop.run.outcomes import SHADOW_BUDGET, MessageSender, Outcome

if TYPE_CHECKING:
    from rosmop.run.engine import MonitorSet, ShadowCopy

SHARE = 0.2
"""Seconds of processor time in a second."""

_SLICE = 0.002  # seconds of processor time
_LAST_SLICE = 0.02  # seconds, before other monitors take over their state
_MAX_WAITING = 2000  # messages
_MAX_BYTES = 8 << 20

_TOO_SLOW = (
    f"monitors in shadow mode take more than {SHARE:.0%} of a processor; this one did not see all messages"
)
_TOO_MANY = "the queue for monitors in shadow mode is full; this one did not see all messages"
_TOO_LONG = f"more than {SHADOW_BUDGET} instructions at once, the limit in shadow mode: it pauses until the next second"


class _Waiting(NamedTuple):
    tapped: ShadowCopy
    point: ObservationPoint
    observed: ObservedMessage | None


class ShadowMonitors:
    """The messages that wait for monitors in shadow mode, and the turns of these monitors."""

    def __init__(self, loop: EventLoop, now: Callable[[], int], observer: Observer) -> None:
        self._loop = loop
        self._now = now
        self._observer = observer
        self._monitors: MonitorSet | None = None
        self.waiting: deque[_Waiting] = deque()
        self._bytes = 0
        self._spent = 0.0
        self._foreign: dict[tuple[str, str], str] = {}  # why, by the publisher's key and resource
        self._timer: LoopTimer | None = None
        self._resting: dict[MonitorSet, str] = {}  # with the reason

    # --- the monitors ---

    def settle(self) -> frozenset[str]:
        """Process waiting messages before other monitors take over; return the incomplete monitors."""
        self._turn(_LAST_SLICE)
        for waiting in self.waiting:
            self._miss(waiting.tapped.shadow, waiting.point, _TOO_SLOW)
        self.waiting.clear()
        self._bytes = 0
        return self._observer.incomplete

    def take(self, monitors: MonitorSet, outcome: Outcome) -> None:
        self._monitors = monitors
        self._observer.keep(
            [monitor.name for monitor in monitors.shadowed], list(monitors.began), self._now()
        )
        for shadowed in outcome.shadowed:
            self._observer.report(shadowed, NOWHERE)
        self.schedule()

    def understand(self, point: ObservationPoint, objection: str) -> None:
        """Note why messages of this publisher cannot be read, or that they can if `objection` is empty."""
        if objection:
            self._foreign[point[:2]] = objection
        else:
            self._foreign.pop(point[:2], None)

    # --- their messages ---

    def wait(self, point: ObservationPoint, observed: ObservedMessage | None) -> None:
        assert self._monitors is not None  # noqa: S101  they have copied it
        idle, foreign = not self.waiting, self._foreign.get(point[:2], "")
        for tapped in self._monitors.tapped:
            why = foreign if tapped.resource == point.resource else ""  # otherwise a monitor published it
            if len(self.waiting) >= _MAX_WAITING or self._bytes + len(tapped.data) > _MAX_BYTES:
                why = why or _TOO_MANY
            if why:
                self._miss(tapped.shadow, point, why, observed)
                continue
            self.waiting.append(_Waiting(tapped, point, observed))
            self._bytes += len(tapped.data)
        self._monitors.tapped.clear()
        if idle and self.waiting:
            self.schedule()

    def tick(self) -> None:
        self._spent = 0.0
        self._resting.clear()
        self._observer.tick(self._now())
        self.schedule()

    def close(self) -> None:
        if self._timer is not None:
            self._timer.cancel()

    def schedule(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        due = min((shadow.next_due for shadow in self._awake() if shadow.next_due is not None), default=None)
        if self.waiting:
            self._timer = self._loop.after(0, self.have_turn)
        elif due is not None:
            self._timer = self._loop.after(max(0, due - self._now()) / 1e9, self.have_turn)

    def _awake(self) -> list[MonitorSet]:
        shadows = self._monitors.shadows if self._monitors is not None and self._spent <= SHARE else ()
        return [shadow for shadow in shadows if shadow not in self._resting]

    def have_turn(self) -> None:
        self._timer = None
        self._turn(_SLICE)
        self.schedule()

    def _turn(self, longest: float) -> None:
        began = last = time.thread_time()
        while self.waiting and last - began < longest:
            waiting = self.waiting.popleft()
            self._bytes -= len(waiting.tapped.data)
            why = _TOO_SLOW if self._spent > SHARE else self._resting.get(waiting.tapped.shadow)
            if why is None:
                self._give(waiting)
            else:
                self._miss(waiting.tapped.shadow, waiting.point, why, waiting.observed)
            now = time.thread_time()
            self._spent += now - last
            last = now
        if not self.waiting:
            self._advance()
            self._spent += time.thread_time() - last

    def _give(self, waiting: _Waiting) -> None:
        tapped, point, observed = waiting
        shadow, data = tapped.shadow, tapped.data
        observer, view = self._observer, memoryview(data)
        try:
            source = observer.senders.number(point)
            outcome = tapped.give(observed.sender(source) if observed is not None else MessageSender(source))
        except Exception as error:  # noqa: BLE001  a defect of the monitors must not end the relay
            self._resting[shadow] = observer.defect(error, point, self._now(), observed)
            self._miss(shadow, point, self._resting[shadow], observed)
            return
        observer.report(outcome, point, observed)
        if self._rests(shadow):
            self._miss(shadow, point, _TOO_LONG, observed)
        elif outcome.result == "dropped":
            observer.dropped(outcome, point, view, observed)
        elif outcome.result == "changed":
            observer.changed(outcome, point, data, len(data), observed)

    def _advance(self) -> None:
        now = self._now()
        for shadow in self._awake():
            if shadow.next_due is None or shadow.next_due > now:
                continue
            try:
                outcomes = shadow.advance(now)
            except Exception as error:  # noqa: BLE001  a defect of the monitors must not end the relay
                self._resting[shadow] = self._observer.defect(error, NOWHERE, now)
                self._miss(shadow, NOWHERE, self._resting[shadow])
                continue
            for outcome in outcomes:
                self._observer.report(outcome, NOWHERE)
            if self._rests(shadow):
                self._miss(shadow, NOWHERE, _TOO_LONG)

    def _rests(self, shadow: MonitorSet) -> bool:
        spent = shadow.late or any(monitor.context.budget < 0 for monitor in shadow.monitors)
        if spent:
            self._resting[shadow] = _TOO_LONG
        return spent

    def _miss(
        self, shadow: MonitorSet, point: ObservationPoint, text: str, observed: ObservedMessage | None = None
    ) -> None:
        for monitor in shadow.monitors:
            self._observer.missed(monitor.name, point, self._now(), text, observed)
