"""Specifications on trial, beside the traffic: they are given copies of messages that have gone on.

Invariants:
- Nothing that they do reaches a message, a subscriber or a monitor in force; what they would have done is told.
- They take at most `SHARE` of the processor's time, in slices between which the loop goes on, and at most `_MOST_BYTES`
  wait for them.
- What is beyond that they are not given, and that is told: they are incomplete then. So is one that spent more on a
  message or a tick than it may, or met a defect; it rests until the second is over, so it delays others once in it.
- Ticks and deadlines happen after the messages that came before them.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

from appliance.relay.loop import Loop, Timer
from appliance.relay.monitors.observation_points import NOWHERE, Place, Sighting
from appliance.relay.monitors.observer import Observer
from rosmop.run.causes import Sender
from rosmop.run.outcomes import Outcome
from rosmop.runtime.action_context import TRIAL_BUDGET

if TYPE_CHECKING:
    from rosmop.run.engine import MonitorSet, Tapped

SHARE = 0.2
"""Seconds of processor time in a second."""

_SLICE = 0.002  # seconds of processor time
_LAST_SLICE = 0.02  # before what they know is taken over
_MOST_WAITING = 2000  # messages
_MOST_BYTES = 8 << 20

_TOO_SLOW = f"monitors on trial take more than {SHARE:.0%} of a processor; this one did not see all messages"
_TOO_MANY = "more messages wait for monitors on trial than can be kept; this one did not see all"
_TOO_LONG = f"more than {TRIAL_BUDGET} instructions at once, which one on trial may not take: it rests for this second"


class _Waiting(NamedTuple):
    tapped: Tapped
    place: Place
    sighting: Sighting | None


class Trials:
    """What waits for the specifications on trial, and when they have their turn."""

    def __init__(self, loop: Loop, now: Callable[[], int], observer: Observer) -> None:
        self._loop = loop
        self._now = now
        self._observer = observer
        self._monitors: MonitorSet | None = None
        self.waiting: deque[_Waiting] = deque()
        self._bytes = 0
        self._spent = 0.0
        self._foreign: set[str] = set()
        self._timer: Timer | None = None
        self._resting: set[MonitorSet] = set()

    # --- which there are ---

    def settle(self) -> frozenset[str]:
        """Give what waits, as others take over; those that are incomplete."""
        self._turn(_LAST_SLICE)
        for waiting in self.waiting:
            self._miss(waiting.tapped.trial, waiting.place, _TOO_SLOW)
        self.waiting.clear()
        self._bytes = 0
        return self._observer.incomplete

    def take(self, monitors: MonitorSet, outcome: Outcome) -> None:
        """These have taken over, and this came of their beginning."""
        self._monitors = monitors
        self._observer.keep([monitor.name for monitor in monitors.tried], list(monitors.began), self._now())
        for tried in outcome.tried:
            self._observer.told(tried, NOWHERE)
        self.schedule()

    def understand(self, resource: str, objection: str) -> None:
        """Whether the messages of a topic or service can be understood, and why not."""
        if not objection:
            self._foreign.discard(resource)
            return
        self._foreign.add(resource)
        for trial in self._monitors.trials if self._monitors is not None else ():
            if trial.wants(resource) or trial.service_type_of(resource) is not None:
                self._miss(trial, Place("", resource), objection)

    # --- what they are given ---

    def wait(self, place: Place, sighting: Sighting | None) -> None:
        """A message is on its way and was copied: it is given when it has gone on."""
        assert self._monitors is not None  # noqa: S101  they have copied it
        idle = not self.waiting
        for tapped in self._monitors.tapped:
            if tapped.resource in self._foreign:
                continue
            if len(self.waiting) >= _MOST_WAITING or self._bytes + len(tapped.data) > _MOST_BYTES:
                self._miss(tapped.trial, place, _TOO_MANY, sighting)
                continue
            self.waiting.append(_Waiting(tapped, place, sighting))
            self._bytes += len(tapped.data)
        self._monitors.tapped.clear()
        if idle and self.waiting:
            self.schedule()

    def tick(self) -> None:
        """A second is over."""
        self._spent = 0.0
        self._resting.clear()
        self._observer.tick(self._now())
        self.schedule()

    def close(self) -> None:
        """The relay ends."""
        if self._timer is not None:
            self._timer.cancel()

    def schedule(self) -> None:
        """See that they have their turn when messages wait, or something is due."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        due = min((trial.next_due for trial in self._awake() if trial.next_due is not None), default=None)
        if self.waiting:
            self._timer = self._loop.after(0, self.have_turn)
        elif due is not None:
            self._timer = self._loop.after(max(0, due - self._now()) / 1e9, self.have_turn)

    def _awake(self) -> list[MonitorSet]:
        """Those that may have a turn in this second."""
        trials = self._monitors.trials if self._monitors is not None and self._spent <= SHARE else ()
        return [trial for trial in trials if trial not in self._resting]

    def have_turn(self) -> None:
        """Give what waits to the specifications on trial, for one slice of time."""
        self._timer = None
        self._turn(_SLICE)
        self.schedule()

    def _turn(self, longest: float) -> None:
        began = last = time.thread_time()
        while self.waiting and last - began < longest:
            waiting = self.waiting.popleft()
            self._bytes -= len(waiting.tapped.data)
            if self._spent > SHARE or waiting.tapped.trial in self._resting:
                self._miss(waiting.tapped.trial, waiting.place, _TOO_SLOW, waiting.sighting)
            else:
                self._give(waiting)
            now = time.thread_time()
            self._spent += now - last
            last = now
        if not self.waiting:
            self._advance()
            self._spent += time.thread_time() - last

    def _give(self, waiting: _Waiting) -> None:
        (trial, _, _, data, _), place, sighting = waiting
        observer, view = self._observer, memoryview(data)
        try:
            source = observer.senders.number(place)
            outcome = waiting.tapped.give(sighting.sender(source) if sighting is not None else Sender(source))
        except Exception as error:  # noqa: BLE001  a defect of the monitors must not end the relay
            self._resting.add(trial)
            self._miss(trial, place, observer.defect(error, place, self._now(), sighting), sighting)
            return
        observer.told(outcome, place, sighting)
        if self._rests(trial):
            self._miss(trial, place, _TOO_LONG, sighting)
        elif outcome.result == "dropped":
            observer.dropped(outcome, place, view, sighting)
        elif outcome.result == "changed":
            observer.changed(outcome, place, data, len(data), sighting)

    def _advance(self) -> None:
        now = self._now()
        for trial in self._awake():
            if trial.next_due is None or trial.next_due > now:
                continue
            try:
                outcomes = trial.advance(now)
            except Exception as error:  # noqa: BLE001  a defect of the monitors must not end the relay
                self._resting.add(trial)
                self._miss(trial, NOWHERE, self._observer.defect(error, NOWHERE, now))
                continue
            for outcome in outcomes:
                self._observer.told(outcome, NOWHERE)
            if self._rests(trial):
                self._miss(trial, NOWHERE, _TOO_LONG)

    def _rests(self, trial: MonitorSet) -> bool:
        """Whether it has spent more than it may, and has to wait for the next second."""
        spent = trial.late or any(monitor.context.budget < 0 for monitor in trial.monitors)
        if spent:
            self._resting.add(trial)
        return spent

    def _miss(self, trial: MonitorSet, place: Place, text: str, sighting: Sighting | None = None) -> None:
        for monitor in trial.monitors:
            self._observer.missed(monitor.name, place, self._now(), text, sighting)
