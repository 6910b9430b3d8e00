"""The path of one publication's messages through the monitors.

The fast path takes many messages of a batch together if none needs a report. A single message loses most time to cold
caches, so the options stay prepared until something changes (`Interceptor.preparation`).
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from appliance.relay.monitors.fast_path_counts import FastPathCounts
from appliance.relay.monitors.interceptor import Interceptor
from appliance.relay.monitors.observation_points import HEAD, BatchProgress, ObservationPoint, ObservedMessage
from appliance.relay.monitors.observations import SHOWN
from appliance.relay.monitors.observer import dropped_outcome
from appliance.relay.monitors.state_memory import NOT_KEPT
from appliance.relay.transport.frames import Batch
from appliance.relay.transport.pump import ModuleCall

if TYPE_CHECKING:
    from rosmop.run.engine import MonitorSet
    from rosmop.run.fast_path import BatchOptions, BatchResult, FastLane, Tried
    from rosmop.run.outcomes import Outcome

_unpack_length = struct.Struct("<I").unpack_from
_NEVER = 1 << 63
_UNPREPARED = -1
_LIGHT = 512  # bytes of a message over whose elements the engine loops as fast as the module is called


class TopicPipeline:
    """The pipeline of one topic of one publisher.

    The rest of a batch that exceeds the publisher's quantum waits for its next turn (`Batch.left`).
    """

    def __init__(self, interceptor: Interceptor, point: ObservationPoint) -> None:
        self._interceptor = interceptor
        self.point = point
        self._preparation = _UNPREPARED
        self._until = 0
        self._prepared: tuple[FastLane, BatchOptions, FastPathCounts] | None = None
        self._defect: FastLane | None = None
        self._called: tuple[int, ModuleCall] | None = None
        self._source = interceptor.senders.number(point)
        interceptor.senders.hold(self._source, self)

    def through(self, batch: Batch) -> Batch | None:
        """Return the frames to pass on, after the monitors' state has been kept."""
        judged = self._judge(batch)
        self._interceptor.keep(self.point[1])
        return judged

    def _judge(self, batch: Batch) -> Batch | None:
        interceptor = self._interceptor
        now = batch.judged = batch.judged or interceptor.now()
        prepared = self._prepared
        if prepared is None or self._preparation != interceptor.preparation.number or now >= self._until:
            return self._through(batch, BatchProgress(batch, now))
        lane, options, counts = prepared
        pieces: list[memoryview | bytes | bytearray] = []
        try:
            walked = lane.process_batch(batch.view, 0, 0, pieces, now, options, batch.answer)
        except Exception as error:  # noqa: BLE001  a defect of the walk must not end the relay
            self._failed(error, lane, now)
            return self._through(batch, BatchProgress(batch, now))
        if not counts.begun:
            interceptor.observer.collect_later(counts)
        if walked is None:
            return batch
        progress = BatchProgress(batch, now)
        progress.pieces = pieces
        self._account(walked, progress, counts)
        return self._through(batch, progress)

    def module_call(self) -> ModuleCall | None:
        interceptor, monitors = self._interceptor, self._interceptor.monitors
        lane = None if monitors is None or interceptor.blocked else monitors.lane(self.point[1])
        if monitors is None or lane is None or not self._usable(monitors, lane, interceptor.now()):
            return None
        options, counts = self._prepare(monitors, lane)
        if not counts.begun:
            interceptor.observer.collect_later(counts)
        if self._called is None or self._called[0] != self._preparation:
            native, way = lane.native(), self.point[1]
            place = interceptor.cells_place(way) if native is not None and native.cells else NOT_KEPT
            if native is None or place is None:
                return None
            given = interceptor.preparation, native, options, place
            call = ModuleCall(*given, offset=interceptor.offset, until=self._until)
            counts.count_in(call)
            self._called = self._preparation, call
        return self._called[1]

    def _account(self, walked: BatchResult, progress: BatchProgress, counts: FastPathCounts) -> None:
        if walked.output:
            self._report(walked, progress)
        progress.walked(walked.position, walked.run, counts.add(walked, progress.time))
        if walked.sooner:
            self._interceptor.invalidate_prepared()

    def _failed(self, error: Exception, lane: FastLane, now: int) -> None:
        self._interceptor.observer.defect(error, self.point, now)
        self._defect = lane
        self._preparation = _UNPREPARED

    def _through(self, batch: Batch, progress: BatchProgress) -> Batch | None:
        interceptor, monitors = self._interceptor, self._interceptor.monitors
        if interceptor.blocked or monitors is None:
            return self._block(batch, progress)
        lane = monitors.lane(self.point[1])
        while progress.position < progress.end:
            if progress.position and interceptor.over():
                progress.stop()
            elif lane is None:
                self._one_by_one(monitors, progress, batch.messages)
            elif (tried := self._walk(monitors, lane, progress)) is not None:
                light = lane.brief or _unpack_length(progress.view, progress.position)[0] <= _LIGHT
                self._one_by_one(monitors, progress, progress.turns() if light else 1, tried)
        interceptor.schedule()
        return progress.result()

    def _usable(self, monitors: MonitorSet, lane: FastLane, now: int) -> bool:
        return lane is not self._defect and monitors.lane_ready(lane, now)

    def _walk(self, monitors: MonitorSet, lane: FastLane, progress: BatchProgress) -> Tried | None:
        """Process messages in the lane; return what became of the next one if the engine has to process it."""
        interceptor = self._interceptor
        if not self._usable(monitors, lane, progress.time):
            return "left" if lane is self._defect else ""
        prepared, counts = self._prepare(monitors, lane)
        try:
            given = progress.view, progress.position, progress.run, progress.pieces, progress.time, prepared
            walked = lane.process_batch(*given)
            alone = walked is not None and walked.paused and walked.position == progress.position
            if alone:
                size = _unpack_length(progress.view, progress.position)[0]
                time_budget = interceptor.time_budgets.of(self.point)
                walked = lane.process_one(*given, time_budget.fuel(progress.time, interceptor.budget, size))
        except Exception as error:  # noqa: BLE001  a defect of the walk must not end the relay
            self._failed(error, lane, progress.time)
            return "left"
        if not counts.begun:
            interceptor.observer.collect_later(counts)
        if walked is None:
            progress.walked(progress.end, progress.run, 0)
            return None
        begun = progress.position
        self._account(walked, progress, counts)
        if alone and progress.position == begun:
            return "over" if walked.paused else "left"
        return None if alone or walked.paused or progress.position == progress.end else "left"

    def _report(self, walked: BatchResult, progress: BatchProgress) -> None:
        interceptor, monitors = self._interceptor, self._interceptor.monitors
        assert monitors is not None  # noqa: S101  they have put it out
        head = HEAD if monitors.is_stamped(self.point[1]) else 0
        for position, line in walked.output:
            first = position + 4
            size = _unpack_length(progress.view, position)[0]
            observed = ObservedMessage(
                progress, position, bytes(progress.view[first : first + min(size, head)])
            )
            said = line.monitor, line.level, line.text
            interceptor.observer.report_line(*said, point=self.point, time=progress.time, observed=observed)

    def _prepare(self, monitors: MonitorSet, lane: FastLane) -> tuple[BatchOptions, FastPathCounts]:
        observer, point = self._interceptor.observer, self.point
        number = self._interceptor.preparation.number
        self._until = _NEVER if monitors.next_due is None else monitors.next_due
        if self._prepared is None or self._prepared[0] is not lane:
            counts = FastPathCounts(lane, point)
        elif self._preparation != number:
            counts = self._prepared[2]
        else:
            return self._prepared[1:]
        told = [not observer.hides_drop(monitor, point) for monitor in lane.monitors] if lane.drops else ()
        options = lane.prepare(
            loud=lane.changes and observer.shows(point),
            told=told,
            counted=[observer.hides_verdict(verdict, point) for verdict in lane.verdicts],
            source=self._source,
            changed=counts.changed,
        )
        self._prepared, self._preparation = (lane, options, counts), number
        return options, counts

    def _one_by_one(
        self, monitors: MonitorSet, progress: BatchProgress, count: int, tried: Tried = ""
    ) -> None:
        interceptor, observer = self._interceptor, self._interceptor.observer
        point, now = self.point, progress.time
        view, position, end = progress.view, progress.position, progress.end
        topic = point[1]
        shows = observer.shows(point)
        head = HEAD if monitors.is_stamped(topic) else 0
        number = progress.number_at(position) if monitors.taps(topic) else 0
        looked = 0
        interceptor.invalidate_prepared()
        while position < end and looked < count:
            first = position + 4
            following = first + _unpack_length(view, position)[0]
            body = view[first:following]
            before = bytes(body[:SHOWN]) if shows else b""
            observed = ObservedMessage(progress, position, bytes(body[:head]))
            monitors.hurry(interceptor.time_budgets.of(point).part(now, len(body)))
            outcome = self._process(monitors, body, now, observed, tried)
            if monitors.tapped:
                interceptor.shadow.wait(point, observed.at(number + looked))
            if outcome.events or outcome.log or outcome.faults or outcome.before:
                observer.report(outcome, point, observed)
            result = outcome.result
            if result == "dropped":
                if outcome.overwritten:
                    outcome.restore(body)  # the report contains the message as received
                observer.dropped(outcome, point, body, observed)
                progress.cut(position, following)
            elif result == "changed":
                observer.changed(outcome, point, before, len(body), observed)
                if outcome.buffer is not body:
                    progress.replace(position, following, outcome.buffer)
            position = following
            looked += 1
            if any(fault.over for fault in outcome.faults):
                interceptor.time_budgets.of(point).cut(now, len(body))
            if interceptor.over():
                break
        progress.position = position

    def _process(
        self, monitors: MonitorSet, body: memoryview, now: int, observed: ObservedMessage, tried: Tried
    ) -> Outcome:
        point = self.point
        try:
            return monitors.process(point[1], body, now, observed.sender(self._source), tried=tried)
        except Exception as error:  # noqa: BLE001  a defect of the monitors must not end the relay
            defect = self._interceptor.observer.defect(error, point, now, observed)
        if tried != "left" and (lane := monitors.lane(point[1])) is not None:  # it may be one of the lane
            self._defect = lane
            return self._process(monitors, body, now, observed, "left")
        return dropped_outcome(body, now, defect)

    def _block(self, batch: Batch, progress: BatchProgress) -> Batch | None:
        if not self._interceptor.blocked:
            return batch
        position = 0
        while position < progress.end:
            following = position + 4 + _unpack_length(progress.view, position)[0]
            body = progress.view[position + 4 : following]
            outcome = dropped_outcome(body, progress.time, self._interceptor.blocked)
            self._interceptor.observer.dropped(
                outcome, self.point, body, ObservedMessage(progress, position, b"")
            )
            position = following
        return None
