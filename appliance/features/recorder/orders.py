"""Pass operators' orders to the flight recorder; the audit log has these orders and the recorder's reports."""

import asyncio
from collections.abc import Callable
from contextlib import suppress
from typing import Any, TypeVar

from msgspec.structs import replace

from appliance.audit.log.record_format import rfc3339
from appliance.base import clock
from appliance.channel import messages
from appliance.channel.answers.limit_answers import LimitUse
from appliance.channel.channel import ChannelClosedError, ChannelFullError
from appliance.channel.link import Link
from appliance.control.errors import SenselessError, UnavailableError, UnknownThingError
from appliance.features.recorder import recorder_link
from appliance.features.recorder import requests as recording_requests
from appliance.features.recorder.recording_answers import (
    OPERATORS,
    OpenRecording,
    Recording,
    RecordingBegun,
    Recordings,
    Trigger,
    TriggerKind,
)
from appliance.features.recorder.recording_plan import RecordingPlan
from appliance.features.recorder.recording_store import MAX_TEMPORARY
from appliance.features.recorder.settings import RecorderRules
from appliance.features.recorder.view import RecorderState
from appliance.telemetry.audit_trail import AuditTrail

_PATIENCE_SECONDS = 10.0
_MAX_TOPICS = 20
_LONGEST_NAME = 500
_M = TypeVar("_M", recorder_link.RecordingStarted, recorder_link.RecordingRemoved, recorder_link.MemoryLent)


class RecordingOrders:
    """Answers operators and nodes. Requests raise `UnavailableError`, `UnknownThingError` and `SenselessError`."""

    def __init__(
        self,
        rules: RecorderRules,
        trail: AuditTrail,
        in_force: Callable[[], tuple[int, int]],
        plan: RecordingPlan,
        publish_as: str,
    ) -> None:
        self._rules = rules
        self._plan = plan
        self._trail = trail
        self._in_force = in_force
        self._publish_as = publish_as
        self.link = Link(self._heard)
        self._kept: dict[str, Recording] = {}
        self._lent: dict[str, Recording] = {}  # temporary recordings of the data in memory
        self._open: dict[str, OpenRecording] = {}
        self._removed_by: dict[str, str] = {}  # who ordered the removals that are not recorded yet
        self._notes: set[asyncio.Future[None]] = set()

    def state(self) -> RecorderState | None:
        if not self._rules.enabled:
            return None
        sizes = [recording.size for recording in self._kept.values()]
        return RecorderState(self.link.channel is not None, len(sizes), sum(sizes), len(self._open))

    # --- what operators ask -------------------------------------------------------------------------------

    def limits(self) -> tuple[LimitUse, ...]:
        if (state := self.state()) is None:
            return ()
        return (LimitUse("bytes of recordings", state.bytes, int(self._rules.disk), "recorder.disk"),)

    async def recordings(self, _request: recording_requests.RecordingsWanted) -> Recordings:
        self._require()
        rules, kept = self._rules, [self._kept[name] for name in sorted(self._kept)]
        in_progress = [
            replace(recording, ends=self._plan.end_of(recording.id) or recording.ends)
            for recording in self._open.values()
        ]
        return Recordings(
            kept, list(rules.topics), list(rules.never), rules.before, in_progress, self._publish_as
        )

    async def recording(self, request: recording_requests.RecordingWanted) -> Recording:
        self._require()
        return self._find(request.id)

    async def now(self, request: recording_requests.RecordNow, who: str) -> RecordingBegun:
        self._require()
        before = self._rules.before if request.before is None else request.before
        after = self._rules.after if request.after is None else request.after
        if before < 0 or after <= 0 or before + after > self._rules.longest:
            raise SenselessError(
                f"before is {before:g} and after {after:g} seconds: after must be more than 0, and both together at"
                f" most {self._rules.longest:g} (recorder.longest)"
            )
        text = f"{who}: {request.note}" if request.note else who
        begun = await self._begin("order", request.note, text, who, (before, after))
        return RecordingBegun(begun.id, begun.ends)

    async def called(self, call: messages.OwnServiceCalled) -> messages.OwnServiceAnswered:
        try:
            self._require()
            text = f"{call.caller_id} of {call.host} called {call.service}"
            span = self._rules.before, self._rules.after
            caller = {
                "host": call.host,
                "caller_id": call.caller_id,
                "category": "call",
                "resource": call.service,
            }
            reason = f"by a call of {call.service}"
            begun = await self._begin("service", reason, text, call.caller_id, span, **caller)
        except (UnavailableError, UnknownThingError) as error:
            return messages.OwnServiceAnswered(call.number, False, str(error))
        return messages.OwnServiceAnswered(call.number, True, begun.id)

    async def _begin(
        self, what: TriggerKind, reason: str, text: str, who: str, span: tuple[float, float], **caller: Any
    ) -> recorder_link.RecordingStarted:
        """Record the order, and let the recorder begin. `span` is seconds before and after now."""
        before, after = span
        record = self._trail.happened(
            "recording ordered", reason, who=who, before=before, after=after, **caller
        )
        charged_to = self._plan.charged_to(str(caller["host"])) if "host" in caller else OPERATORS
        trigger = Trigger(clock.wall_ns(), what, record, text[: recording_requests.LONGEST_NOTE], charged_to)
        begun = await self._ask(
            lambda number: recorder_link.RecordingRequested(number, trigger, before, after),
            recorder_link.RecordingStarted,
        )
        self._plan.opened(charged_to, begun.id, begun.began, begun.ends)
        return begun

    async def fetch(self, request: recording_requests.RecordingFetch, who: str) -> Recording:
        return await self._given_out(request.id, "recording fetched", f"by {who}", who)

    async def read(self, request: recording_requests.RecordingRead, who: str) -> Recording:
        """Record who reads messages. Repetitions within a few seconds are only counted."""
        topics = request.topics
        if len(topics) > _MAX_TOPICS or any(len(topic) > _LONGEST_NAME for topic in topics):
            raise SenselessError(f"at most {_MAX_TOPICS} topics at once, of {_LONGEST_NAME} characters each")
        reason = f"messages of {', '.join(topics) or 'all topics'}, by {who}"
        return await self._given_out(request.id, "recording read", reason, who, reads=True, topics=topics)

    async def _given_out(
        self, recording_id: str, event: str, reason: str, who: str, *, reads: bool = False, **detail: Any
    ) -> Recording:
        self._require()
        recording = self._find(recording_id)
        self._trail.happened(
            event,
            reason,
            resource=recording.id,
            reads=reads,
            recording=recording.id,
            sha256=recording.sha256,
            who=who,
            **detail,
        )
        failure = await self._trail.durable()
        if failure is not None:
            raise UnavailableError(f"nothing can be fetched while the order cannot be recorded: {failure}")
        return recording

    async def of_memory(self, request: recording_requests.RecordingOfMemory, who: str) -> Recording:
        self._require()
        now = clock.wall_ns()
        since, until = request.since or 0, now if request.until is None else request.until
        record = self._trail.happened(
            "recording ordered",
            f"from the messages in memory, temporary, by {who}",
            who=who,
            before=min(self._rules.before, max(0, now - since) / 1e9),
            after=0.0,
        )
        trigger = Trigger(now, "order", record, f"{who}: from the messages in memory", OPERATORS)
        lent = await self._ask(
            lambda number: recorder_link.MemoryWanted(number, trigger, since, until), recorder_link.MemoryLent
        )
        self._lent = dict([*self._lent.items(), (lent.recording.id, lent.recording)][-MAX_TEMPORARY:])
        return lent.recording

    async def remove(self, request: recording_requests.RecordingRemove, who: str) -> Recording:
        self._require()
        self._removed_by[request.id] = who
        try:
            removed = await self._ask(
                lambda number: recorder_link.RecordingRemovalWanted(number, request.id, who),
                recorder_link.RecordingRemoved,
            )
        except UnknownThingError:
            self._removed_by.pop(request.id, None)
            raise
        return removed.recording

    def _require(self) -> None:
        if not self._rules.enabled:
            raise UnknownThingError(
                "the flight recorder is off: `recorder: {enabled: true}` in appliance.yaml turns it on"
            )
        if self.link.channel is None:
            raise UnavailableError("the flight recorder is not running now: see rosrv status")

    def _find(self, recording_id: str) -> Recording:
        known = self._kept | self._lent
        if (ends := self._plan.end_of(recording_id)) is not None:
            raise UnknownThingError(
                f"recording {recording_id} is still being made: ask again after {rfc3339(ends)}, or later if"
                " further triggers make it longer"
            )
        if recording_id not in known:
            raise UnknownThingError(f"there is no recording {recording_id[:40]}: rosrv record list")
        return known[recording_id]

    async def _ask(self, order: Callable[[int], messages.Message], kind: type[_M]) -> _M:
        try:
            answer: _M | recorder_link.RecordingRefused = await self.link.ask(order, _PATIENCE_SECONDS)
        except ChannelClosedError:
            raise UnavailableError("the flight recorder ended before it answered: try again") from None
        except TimeoutError:
            raise UnavailableError("the flight recorder did not answer: try again") from None
        if isinstance(answer, recorder_link.RecordingRefused):
            raise (UnknownThingError if answer.unknown else UnavailableError)(answer.reason)
        assert isinstance(answer, kind)  # noqa: S101  the only other answer to such an order
        return answer

    # --- what the recorder says ---------------------------------------------------------------------------

    def _heard(self, message: object) -> None:
        match message:
            case recorder_link.RecordingsStated(recordings, in_progress):
                self._kept = {recording.id: recording for recording in recordings}
                self._open = {recording.id: recording for recording in in_progress}
                self._plan.stated(recordings, in_progress)
            case recorder_link.RecordingOpened(recording):
                self._open[recording.id] = recording
            case recorder_link.RevisionsWanted():
                self.link.send(recorder_link.RevisionsStated(*self._in_force()))
            case recorder_link.RecordingClosed(recording):
                self._open.pop(recording.id, None)
                self._plan.closed(recording)
                self._on_close(recording)
                self._note(recording.id)
            case recorder_link.RecordingMissed(trigger, reason, planned, instead):
                self._open.pop(planned, None)
                about = {"what": trigger.what, "record": trigger.record, "charged_to": trigger.charged_to}
                if planned:
                    about["recording"] = planned
                    self._plan.missed(trigger.charged_to, planned, reason, clock.wall_ns(), instead)
                self._trail.happened("recording missed", reason, more=about)
            case recorder_link.RecordingRemoved(_number, recording, claimed, reason):
                self._kept.pop(recording.id, None)
                who = "" if reason else self._removed_by.get(recording.id, "")
                by = f"by {who}" if who else f"the recorder reports an order of {claimed}"
                self._trail.happened(
                    "recording removed",
                    reason or by,
                    recording=recording.id,
                    sha256=recording.sha256,
                    who=who or "recorder",
                )
                self._note(recording.id)
                self.link.answered(message.number, message)
            case (
                recorder_link.RecordingStarted(number)
                | recorder_link.MemoryLent(number)
                | recorder_link.RecordingRefused(number)
            ):
                self.link.answered(number, message)

    def _note(self, recording_id: str) -> None:
        async def note() -> None:
            if await self._trail.durable() is None:
                self._removed_by.pop(recording_id, None)
                with suppress(ChannelFullError):
                    self.link.send(recorder_link.RecordingNoted(recording_id))

        task = asyncio.ensure_future(note())
        self._notes.add(task)
        task.add_done_callback(self._notes.discard)

    def _on_close(self, recording: Recording) -> None:
        self._kept[recording.id] = recording
        self._trail.happened(
            "recording closed",
            "complete" if recording.complete else f"not complete: {recording.why_not}",
            recording=recording.id,
            sha256=recording.sha256,
            size=recording.size,
            began=recording.began,
            ended=recording.ended,
            complete=recording.complete,
            charged_to=recording.charged_to,
            triggers=[f"{trigger.what} {trigger.record}" for trigger in recording.triggers],
        )
