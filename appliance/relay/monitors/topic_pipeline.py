"""One topic of one incarnation on its way through the monitors.

The messages of a batch are taken many at a time where they need nothing but the common (`rosmop/walks.py`), one by
one where there is something to tell; what nobody changed or dropped leaves in the buffer it came in.

A message that comes alone costs little work and much fetching: at a thousand a second other programs have filled
the caches since the last one. So while nothing happens that could matter (`Middle.sight` is the same), all that a
batch has to be asked is prepared once (`_prepare`), and what it adds to the counters is added up here, until the
second is over.

What does not fit into the publisher's quantum (`Monitors.over`) is left for its next turn (`Batch.left`).
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Protocol

from appliance.relay.connections.frames import Batch
from appliance.relay.counts import Counts
from appliance.relay.monitors.batch import Passage
from appliance.relay.monitors.observation_points import HEAD, Place, Senders, Sighting
from appliance.relay.monitors.observations import SHOWN
from appliance.relay.monitors.observer import Observer
from appliance.relay.monitors.pace import Pace
from appliance.relay.monitors.shadow import Trials
from rosmop.run.outcomes import Outcome

if TYPE_CHECKING:
    from rosmop.run.engine import MonitorSet
    from rosmop.run.fast_path import FastLane, Prepared, Walked

_unpack_length = struct.Struct("<I").unpack_from
_NEVER = 1 << 63


class Monitors(Protocol):
    """The monitors of the relay, as their lanes see them."""

    monitors: MonitorSet | None
    """The specifications in force."""

    blocked: str
    """Why everything is blocked, if it is."""

    sight: object
    """Another one whenever something has happened that changes what may be prepared."""

    observer: Observer
    """What is told to control."""

    trials: Trials
    """The monitors on trial, which are given copies."""

    senders: Senders
    """The senders, by number."""

    def now(self) -> int:
        """Nanoseconds."""

    budget: float
    """Seconds of processor time that a message may take."""

    def over(self) -> bool:
        """Whether the publisher's quantum is used up."""

    def pace(self, place: Place) -> Pace:
        """Return the pace of messages from a place."""

    def keep(self, way: str) -> None:
        """Keep the state of those that judge messages on a topic."""

    def look_again(self) -> None:
        """Something has happened: there is another `sight`."""

    def schedule(self) -> None:
        """See that what is due next happens."""


class Lane:
    """Where the batches of one topic of one publisher go through."""

    def __init__(self, middle: Monitors, place: Place) -> None:
        self._middle = middle
        self._place = place
        self._sight: object = None
        self._until = 0
        self._walker: FastLane | None = None
        self._prepared: Prepared | None = None
        self._counts: Counts | None = None
        self._defect: FastLane | None = None
        self._source = middle.senders.number(place)

    def through(self, batch: Batch) -> Batch | None:
        """The frames that go on, as the monitors leave them; None when none does. Their state is kept before that."""
        judged = self._judged(batch)
        self._middle.keep(self._place[1])
        return judged

    def _judged(self, batch: Batch) -> Batch | None:
        middle = self._middle
        now = batch.judged = middle.now()
        if self._sight is not middle.sight or now >= self._until:
            return self._through(batch, Passage(batch, now))
        assert self._walker is not None  # noqa: S101  `_prepare` has found one
        assert self._prepared is not None  # noqa: S101  and prepared it
        assert self._counts is not None  # noqa: S101  and counts for it
        pieces: list[memoryview | bytes | bytearray] = []
        try:
            walked = self._walker.walk(batch.view, 0, 0, pieces, now, self._prepared)
        except Exception as error:  # noqa: BLE001  a defect of the walk must not end the relay
            self._failed(error, self._walker, now)
            return self._through(batch, Passage(batch, now))
        if not self._counts.begun:
            middle.observer.owe(self._counts)
        if walked is None:
            return batch
        gone = self._counts.add(walked, now)
        if walked.position == len(batch.view) and not gone and not walked.sooner and not walked.output:
            return batch
        passage = Passage(batch, now)
        if walked.output:
            self._say(walked, passage)
        passage.pieces = pieces
        passage.walked(walked.position, walked.run, gone)
        if walked.sooner:
            middle.look_again()
        return self._through(batch, passage)

    def _failed(self, error: Exception, walker: FastLane, now: int) -> None:
        """The walk of this topic is not right: tell it, and leave everything to the engine from now on."""
        self._middle.observer.defect(error, self._place, now)
        self._defect = walker
        self._sight = None

    def _through(self, batch: Batch, passage: Passage) -> Batch | None:
        middle, monitors = self._middle, self._middle.monitors
        if middle.blocked or monitors is None:
            return self._block(batch, passage)
        walker = monitors.walker(self._place[1])
        while passage.position < passage.end:
            if passage.position and middle.over():
                passage.stop()
            elif walker is None:
                self._one_by_one(monitors, passage, batch.messages)
            elif not self._walk(monitors, walker, passage):
                self._one_by_one(monitors, passage, passage.turns())
        middle.schedule()
        return passage.result()

    def _walk(self, monitors: MonitorSet, walker: FastLane, passage: Passage) -> bool:
        """Take messages that need nothing but the common, for a quantum; False if the next one needs more."""
        middle = self._middle
        if walker is self._defect or not monitors.walks(walker, passage.time):
            return False
        prepared, counts = self._prepare(monitors, walker)
        try:
            given = passage.view, passage.position, passage.run, passage.pieces, passage.time, prepared
            walked = walker.walk(*given)
            alone = walked is not None and walked.paused and walked.position == passage.position
            if alone:
                walked = walker.walk_one(*given, middle.pace(self._place).fuel(passage.time, middle.budget))
        except Exception as error:  # noqa: BLE001  a defect of the walk must not end the relay
            self._failed(error, walker, passage.time)
            return False
        if walked is not None and walked.output:
            self._say(walked, passage)
        if not counts.begun:
            middle.observer.owe(counts)
        if walked is None:
            passage.walked(passage.end, passage.run, 0)
            return True
        begun = passage.position
        passage.walked(walked.position, walked.run, counts.add(walked, passage.time))
        if walked.sooner:
            middle.look_again()
        if alone:
            if walked.paused:  # the engine would take much longer
                middle.pace(self._place).cut(passage.time)
            return passage.position > begun
        return walked.paused or passage.position == passage.end

    def _say(self, walked: Walked, passage: Passage) -> None:
        """Tell what was put out."""
        middle, monitors = self._middle, self._middle.monitors
        assert monitors is not None  # noqa: S101  they have put it out
        head = HEAD if monitors.stamped(self._place[1]) else 0
        for position, said in walked.output:
            first = position + 4
            size = _unpack_length(passage.view, position)[0]
            sighting = Sighting(passage, position, bytes(passage.view[first : first + min(size, head)]))
            middle.observer.said(said, self._place, passage.time, sighting)

    def _prepare(self, monitors: MonitorSet, walker: FastLane) -> tuple[Prepared, Counts]:
        """Ask once what holds for all batches until something happens."""
        observer, place = self._middle.observer, self._place
        prepared, counts = self._prepared, self._counts
        if counts is None or counts.walker is not walker:
            counts = self._counts = Counts(walker, place)
        if prepared is None or self._sight is not self._middle.sight or self._walker is not walker:
            prepared = self._prepared = walker.prepare(
                loud=walker.changes and observer.shows(place),
                told=[not observer.hides_drop(monitor, place) for monitor in walker.monitors]
                if walker.drops
                else (),
                counted=[observer.hides_verdict(verdict, place) for verdict in walker.verdicts],
                source=self._source,
                changed=counts.changed,
            )
        self._walker, self._sight = walker, self._middle.sight
        self._until = _NEVER if monitors.next_due is None else monitors.next_due
        return prepared, counts

    def _one_by_one(self, monitors: MonitorSet, passage: Passage, count: int) -> None:
        """Give so many messages to the engine, or as many as there is time for."""
        middle, place, now, observer = self._middle, self._place, passage.time, self._middle.observer
        view, position, end = passage.view, passage.position, passage.end
        process, topic = monitors.process, place[1]
        shows = observer.shows(place)
        head = HEAD if monitors.stamped(topic) else 0
        number = passage.number_at(position) if monitors.taps(topic) else 0
        looked = 0
        middle.look_again()
        while position < end and looked < count:
            first = position + 4
            following = first + _unpack_length(view, position)[0]
            body = view[first:following]
            before = bytes(body[:SHOWN]) if shows else b""
            sighting = Sighting(passage, position, bytes(body[:head]))
            monitors.hurry(middle.pace(place).part(now))
            try:
                outcome = process(topic, body, now, sighting.sender(self._source))
            except Exception as error:  # noqa: BLE001  a defect of the monitors must not end the relay
                outcome = dropped(body, now, observer.defect(error, place, now, sighting))
            if monitors.tapped:
                middle.trials.wait(place, sighting.at(number + looked))
            if outcome.events or outcome.log or outcome.faults or outcome.before:
                observer.told(outcome, place, sighting)
            result = outcome.result
            if result == "dropped":
                if outcome.overwritten:
                    outcome.restore(body)  # it is told as it was received
                observer.dropped(outcome, place, body, sighting)
                passage.cut(position, following)
            elif result == "changed":
                observer.changed(outcome, place, before, len(body), sighting)
                shows = False
                if outcome.buffer is not body:
                    passage.replace(position, following, outcome.buffer)
            position = following
            looked += 1
            if outcome.faults and monitors.late:
                middle.pace(place).cut(now)
            if middle.over():
                break
        passage.position = position

    def _block(self, batch: Batch, passage: Passage) -> Batch | None:
        if not self._middle.blocked:
            return batch
        position = 0
        while position < passage.end:
            following = position + 4 + _unpack_length(passage.view, position)[0]
            body = passage.view[position + 4 : following]
            outcome = dropped(body, passage.time, self._middle.blocked)
            self._middle.observer.dropped(outcome, self._place, body, Sighting(passage, position, b""))
            position = following
        return None


def dropped(body: memoryview, now: int, reason: str) -> Outcome:
    """The outcome of a message that is dropped without having been judged."""
    outcome = Outcome(body, now)
    outcome.result, outcome.reason = "dropped", reason
    return outcome
