"""Make a recording of the relays' memory when an audit record is a trigger.

1. Control plans the recordings (`recording_plan`), so that the trigger's audit record names its recording.
2. Recordings never use space that is reserved for the audit log.
3. After a crash, the next recorder finishes each recording: completely if the memory still exists, otherwise as
   far as it was written.
"""

import shutil
from collections.abc import Callable, Iterable, Sequence
from itertools import islice
from pathlib import Path

import structlog

from appliance.audit.log.ids import IdSource
from appliance.audit.log.log_database import LogUnreadableError
from appliance.audit.search.query import Filter
from appliance.audit.search.search import Follower, export, search
from appliance.base import clock
from appliance.channel import messages
from appliance.features.recorder import recorder_link
from appliance.features.recorder.recording import (
    MAX_RECORDS,
    MAX_TRIGGERS,
    Progress,
    ReadPosition,
    RecordingInProgress,
    RingReader,
    load_progress,
)
from appliance.features.recorder.recording_answers import OpenRecording, Recording, Trigger
from appliance.features.recorder.recording_plan import (
    UNLIMITED,
    HourlyLimit,
    recording_owner,
    span,
    trigger_of,
)
from appliance.features.recorder.recording_store import MAX_TEMPORARY, RecordingStore
from appliance.features.recorder.settings import RecorderRules

SETTLE_SECONDS = 0.5
"""The time that late messages and audit records have to arrive."""

_IDLE_SECONDS, _BUSY_SECONDS = 0.5, 0.25
_PAGES = 20  # pages of the log in one step
_SECOND = 1_000_000_000
_TELL_AGAIN = 600 * _SECOND
_MAX_TOLD = 4096
_log = structlog.get_logger()


class Recorder:
    """Records `rings`, which were created at the time `memory`. Times are nanoseconds since the epoch.

    The machine's clock was then `ahead` nanoseconds ahead of the monotonic one, `steady`.
    """

    def __init__(
        self,
        rules: RecorderRules,
        store: RecordingStore,
        log: Path,
        rings: Sequence[memoryview],
        *,
        memory: int,
        ahead: int,
        clock: Callable[[], int] = clock.wall_ns,
        steady: Callable[[], int] = clock.now_ns,
    ) -> None:
        self._rules = rules
        self._store = store
        self._log = log
        self._rings = rings
        self._memory = memory
        self._clock = clock
        self._steady = steady
        self._ahead = ahead
        self._since = memory  # the clock was not set since
        self._places: list[dict[int, ReadPosition]] = []  # and these positions follow all earlier messages
        self._ids = IdSource(clock=clock)
        self._limit = HourlyLimit(rules.per_hour, store.recordings)
        self._follower: Follower | None = None
        self._making: list[RecordingInProgress] = []
        self._revisions = recorder_link.RevisionsStated(0, 0)
        self._asked_for: set[str] = set()  # ids of recordings that wait for the revisions in force
        self._told: dict[tuple[str, str], int] = {}  # when a trigger without a recording was last reported
        self._answers: list[messages.Message] = []
        self._notice_set_clock()
        self._take_up()

    def step(self, said: Iterable[object] = ()) -> list[messages.Message]:
        self._notice_set_clock()
        for message in said:
            try:
                self._obey(message)
            except OSError as error:
                _log.error("control's request failed", order=type(message).__name__, reason=str(error))
        self._follow()
        for making in tuple(self._making):
            try:
                self._go_on(making)
            except OSError as error:
                self._give_up(making, error)
        self._remove_outdated()
        answers, self._answers = self._answers, []
        return answers

    def close(self) -> None:
        for making in self._making:
            making.leave()

    @property
    def pause(self) -> float:
        return _BUSY_SECONDS if self._making else _IDLE_SECONDS

    # --- messages of control ------------------------------------------------------------------------------

    def _obey(self, message: object) -> None:
        match message:
            case recorder_link.RecordingsAsked():
                making = [making.opened for making in self._making]
                self._answers.append(recorder_link.RecordingsStated(list(self._store.recordings), making))
                self._answers += [recorder_link.RecordingClosed(found) for found in self._store.unnoted()]
                self._answers += [
                    recorder_link.RecordingRemoved(0, *removed) for removed in self._store.removals()
                ]
                self._answers.append(recorder_link.RevisionsWanted())
                self._report_unmade()
            case recorder_link.RevisionsStated():
                self._revisions = message
            case recorder_link.RecordingNoted(recording_id):
                self._store.note(recording_id)
            case recorder_link.RecordingRequested():
                self._order(message)
            case recorder_link.MemoryWanted():
                self._record_temporarily(message)
            case recorder_link.RecordingRemovalWanted(number, recording_id, who):
                self._remove(number, recording_id, who)

    def _order(self, wanted: recorder_link.RecordingRequested) -> None:
        self._follow()  # first, because earlier triggers have the ids that control planned
        making, why_not = self._record(wanted.trigger, wanted.before, wanted.after)
        if making is None:
            self._answers.append(recorder_link.RecordingRefused(wanted.number, why_not))
            if wanted.trigger.what == "service":  # a node may ignore the refusal, so it is also recorded
                self._on_missed(wanted.trigger, why_not)
        else:
            progress = making.progress
            self._answers.append(
                recorder_link.RecordingStarted(wanted.number, progress.id, progress.ends, progress.began)
            )

    def _record_temporarily(self, wanted: recorder_link.MemoryWanted) -> None:
        now = self._clock()
        since = max(self._since, wanted.since, now - int(self._rules.before * _SECOND))
        until = min(wanted.until, now)
        if since > until:
            reason = f"the memory has the last {self._rules.before:g} seconds, and none of that period"
            self._answers.append(recorder_link.RecordingRefused(wanted.number, reason, unknown=True))
            return
        if lacking := self._store.lacking:
            self._answers.append(recorder_link.RecordingRefused(wanted.number, lacking))
            return
        progress = Progress(self._ids.next(), self._memory, since, until, [wanted.trigger])
        try:
            if not self._store.has_temporary_room(now):
                reason = f"{MAX_TEMPORARY} requests came within seconds: try again in half a minute"
                self._answers.append(recorder_link.RecordingRefused(wanted.number, reason))
                return
            self._store.mark_temporary(progress.id)
            temporary = self._in_progress(progress)
            try:
                temporary.step(now)
                recording = temporary.finish((), self._revisions)
            finally:
                temporary.leave()
            self._store.publish_temporary(recording)
        except OSError as error:
            self._store.discard_part(progress.id)
            self._answers.append(recorder_link.RecordingRefused(wanted.number, str(error)))
        else:
            self._answers.append(recorder_link.MemoryLent(wanted.number, recording))

    def _remove(self, number: int, recording_id: str, who: str) -> None:
        recording = self._store.find(recording_id)
        if recording is None:
            refused = recorder_link.RecordingRefused(
                number, f"recording {recording_id} does not exist", unknown=True
            )
            self._answers.append(refused)
            return
        try:
            self._store.remove(recording, who, "")
        except OSError as error:
            self._answers.append(recorder_link.RecordingRefused(number, str(error)))
        else:
            self._answers.append(recorder_link.RecordingRemoved(number, recording, who, ""))

    # --- triggers -----------------------------------------------------------------------------------------

    def _follow(self) -> None:
        try:
            for trigger, planned in self._new_triggers():
                self._on_trigger(trigger, planned)
        except LogUnreadableError as error:
            _log.error("cannot read the audit log; retrying", reason=str(error))

    def _new_triggers(self) -> list[tuple[Trigger, str]]:
        follower = self._follower or self._begin_to_follow()
        triggers: list[tuple[Trigger, str]] = []
        for _page in range(_PAGES):
            entries = follower.poll()
            if not entries:
                break
            for record in (entry.record for entry in entries):
                trigger = trigger_of(record, self._rules.triggers)
                if trigger is None:
                    continue
                if "not_recorded" in record.detail:
                    self._on_missed(trigger, str(record.detail["not_recorded"]))
                else:
                    triggers.append((trigger, str(record.detail.get("recording", ""))))
        return triggers

    def _begin_to_follow(self) -> Follower:
        """Begin `before` seconds ago, because an earlier recorder may not have read the log to its end."""
        since = max(self._memory, self._clock() - int(self._rules.before * _SECOND))
        first = search(self._log, Filter(since=since), "0", 1, newest_first=False).entries
        self._follower = Follower(self._log, Filter(), first[0].sequence - 1 if first else None)
        return self._follower

    def _report_unmade(self) -> None:
        """Report the recordings that the end of the appliance prevented: their messages went with its memory."""
        begun = Filter(since=self._memory - int(self._rules.before * _SECOND), until=self._memory)
        unmade: dict[str, Trigger] = {}
        try:
            for entry in islice(export(self._log, begun), MAX_RECORDS):
                trigger = trigger_of(entry.record, self._rules.triggers)
                planned = str(entry.record.detail.get("recording", ""))
                if trigger is not None and planned and not self._store.has(planned):
                    unmade.setdefault(planned, trigger)
            for event in ("recording closed", "recording missed") if unmade else ():
                for entry in export(self._log, Filter(since=begun.since, event=event)):
                    unmade.pop(str(entry.record.detail.get("recording", "")), None)
        except LogUnreadableError as error:
            _log.error("cannot read which recordings were promised", reason=str(error))
            return
        for planned, trigger in unmade.items():
            self._on_missed(trigger, "the appliance stopped before it was written", planned)

    def _on_trigger(self, trigger: Trigger, planned: str) -> None:
        if planned and self._store.knows(planned):
            kept = self._store.find(planned)
            if kept is not None and trigger.time > kept.ended:
                self._on_missed(
                    trigger, f"recording {planned} had ended: {kept.why_not or 'its time expired'}", planned
                )
            return
        for kept in self._store.recordings:
            own = recording_owner(kept.charged_to) == recording_owner(trigger.charged_to)
            if own and kept.began <= trigger.time <= kept.ended:
                if planned:
                    self._on_missed(trigger, f"recording {kept.id} has this time", planned)
                return
        making, why_not = self._record(trigger, planned=planned)
        if making is None:
            self._on_missed(trigger, why_not, planned)
        elif planned and planned != making.progress.id:
            self._on_missed(trigger, f"it prolonged recording {making.progress.id}", planned, making.opened)

    def _on_missed(
        self, trigger: Trigger, why: str, planned: str = "", instead: OpenRecording | None = None
    ) -> None:
        """Unless a recording was planned, repeat the report only every ten minutes."""
        now, kind = self._clock(), (trigger.charged_to, trigger.what)
        if (
            planned or abs(now - self._told.get(kind, -_TELL_AGAIN)) >= _TELL_AGAIN
        ):  # `abs`, because the clock may have been set back
            if len(self._told) > _MAX_TOLD:
                self._told.clear()
            self._told[kind] = now
            self._answers.append(recorder_link.RecordingMissed(trigger, why, planned, instead))

    def _record(
        self, trigger: Trigger, before: float | None = None, after: float | None = None, planned: str = ""
    ) -> tuple[RecordingInProgress | None, str]:
        charged_to, now = trigger.charged_to, min(max(trigger.time, self._since), self._clock())
        for making in tuple(self._making):
            progress = making.progress
            if recording_owner(progress.charged_to) == recording_owner(charged_to):
                if now <= progress.ends:
                    _prolong(progress, trigger, now, after)
                    return making, ""
                try:
                    self._close(making)
                except OSError as error:
                    self._give_up(making, error)
        if lacking := self._store.lacking:
            return None, lacking
        if (
            not planned
            and trigger.what != "order"
            and not self._limit.take(charged_to, trigger.what, self._clock())
        ):
            return None, self._limit.refusal(charged_to)
        why_not = self._make_room(charged_to)
        if why_not:
            return None, why_not
        own = [
            kept.ended
            for kept in self._store.recordings
            if recording_owner(kept.charged_to) == recording_owner(charged_to)
        ]
        ended = max(own, default=0)
        times = span(self._rules, now, ended, before, after)
        began = max(self._since, times.began)
        latest = began + int(self._rules.longest * _SECOND)
        progress = Progress(
            planned or self._ids.next(), self._memory, began, min(times.ends, latest), [trigger],
            charged_to=charged_to, hold=times.hold, latest=latest, ahead=self._ahead, reached=began,
        )  # fmt: skip
        try:
            making = self._in_progress(progress)
        except OSError as error:
            self._store.discard_part(progress.id)
            return None, str(error)
        self._making.append(making)
        self._answers += [recorder_link.RecordingOpened(making.opened), recorder_link.RevisionsWanted()]
        _log.info("a recording begins", recording=progress.id, trigger=trigger.what, charged_to=charged_to)
        return making, ""

    def _in_progress(self, progress: Progress) -> RecordingInProgress:
        folder = self._store.part(progress.id)
        progress.places = progress.places or list(self._places)
        return RecordingInProgress(folder, progress, self._rings, largest=self._store.largest)

    # --- the recording ------------------------------------------------------------------------------------

    def _go_on(self, making: RecordingInProgress) -> None:
        now, progress = self._clock(), making.progress
        if now <= progress.ends:
            making.step(now)
        elif progress.id not in self._asked_for:
            self._asked_for.add(progress.id)
            self._answers.append(recorder_link.RevisionsWanted())
        if self._store.full:
            progress.why_not = "the disk was nearly full"
        if progress.why_not:
            progress.ends = min(now, progress.ends)
        if progress.why_not or now >= progress.ends + int(SETTLE_SECONDS * _SECOND):
            self._close(making)

    def _notice_set_clock(self) -> None:
        """Forget the memory when the clock was set: times before and after it do not measure silences."""
        now = self._clock()
        ahead = now - self._steady()
        for making in tuple(self._making):
            progress = making.progress
            if abs(ahead - progress.ahead) > recorder_link.CLOCK_STEP:
                progress.why_not = "the clock was set, or the machine was suspended, during the recording"
                progress.ends = progress.reached
                try:
                    self._finish(making)
                except OSError as error:
                    self._give_up(making, error)
        if abs(ahead - self._ahead) > recorder_link.CLOCK_STEP:
            self._ahead, self._since = ahead, now
            self._places = [RingReader(ring).skip() for ring in self._rings]

    def _close(self, making: RecordingInProgress) -> None:
        making.step(self._clock())
        self._finish(making)

    def _finish(self, making: RecordingInProgress) -> None:
        progress = making.progress
        within = Filter(since=progress.began, until=progress.ends + 1)
        try:
            records = list(islice(export(self._log, within), MAX_RECORDS + 1))
        except LogUnreadableError as error:
            records = []
            progress.why_not = progress.why_not or f"the audit log could not be read: {error}"
        recording = making.finish(records, self._revisions)
        self._forget(making)
        self._store.keep(recording)
        self._answers.append(recorder_link.RecordingClosed(recording))
        _log.info("a recording is closed", recording=recording.id, size=recording.size)

    def _give_up(self, making: RecordingInProgress, error: OSError) -> None:
        _log.error("a recording cannot be written", reason=str(error))
        making.leave()
        progress = making.progress
        self._store.discard_part(progress.id)
        self._forget(making)
        self._answers.append(recorder_link.RecordingMissed(progress.triggers[0], str(error), progress.id))

    def _forget(self, making: RecordingInProgress) -> None:
        self._making = [other for other in self._making if other is not making]
        self._asked_for.discard(making.progress.id)

    def _take_up(self) -> None:
        for folder in self._store.parts():
            try:
                progress = load_progress(folder)
            except (OSError, ValueError):
                _log.warning("an unfinished recording is removed", folder=folder.name)
                shutil.rmtree(folder)
                continue
            try:
                if progress.memory == self._memory:
                    self._making.append(self._in_progress(progress))
                    _log.warning("an unfinished recording continues", recording=progress.id)
                    continue
                progress.why_not = "the appliance stopped during the recording"
                _log.warning("an unfinished recording is closed without its end", recording=progress.id)
                self._finish(RecordingInProgress(folder, progress, (), largest=self._store.largest))
            except OSError as error:
                _log.error("it cannot be closed; the next start retries", reason=str(error))

    def _remove_outdated(self) -> None:
        try:
            for recording, reason in self._store.outdated(self._clock()):
                self._remove_for(recording, reason)
        except OSError as error:
            _log.error("a recording cannot be removed", reason=str(error))

    def _make_room(self, charged_to: str) -> str:
        while True:
            try:
                found, why = self._store.in_the_way(
                    charged_to, [making.progress.charged_to for making in self._making]
                )
                if found is None:
                    return why
                self._remove_for(found, why)
            except OSError as error:
                return str(error)

    def _remove_for(self, recording: Recording, reason: str) -> None:
        self._store.remove(recording, "", reason)
        self._answers.append(recorder_link.RecordingRemoved(0, recording, "", reason))


def _prolong(progress: Progress, trigger: Trigger, now: int, after: float | None) -> None:
    hold = progress.hold if after is None else int(after * _SECOND)
    progress.ends = max(progress.ends, min(now + hold, progress.latest))
    if trigger.charged_to in UNLIMITED and progress.charged_to not in UNLIMITED:
        progress.charged_to = trigger.charged_to  # from now on it does not use up the appliance's quota
    known = any(trigger.record == other.record for other in progress.triggers)
    if not known and len(progress.triggers) < MAX_TRIGGERS:
        progress.triggers.append(trigger)
