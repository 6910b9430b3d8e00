"""The flight recorder: follows the audit log, and makes a recording of what relays have in memory when there is reason.

`step` does all that is due and returns what control is to be told; nothing here waits or knows a socket.

Invariants:

1. One recording of each host is made at a time (`plan`). A trigger within its time prolongs it, up to `longest`; a
   later one begins another. Control has planned which recording has a trigger, and its audit record says so.
2. Whatever a trigger is, recordings take no more of the disk than they may, nor what is kept for the audit log.
3. A recording that a fallen recorder began is finished by the next: whole while the memory is the same, else as far as
   it got, and that stands in it.
"""

import shutil
import time
from collections.abc import Callable, Iterable, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import msgspec
import structlog

from appliance.audit.ids import IdSource
from appliance.audit.log_database import LogUnreadableError
from appliance.audit.query import Filter
from appliance.audit.search import Follower, export, search
from appliance.channel import messages
from appliance.channel.answers.recording_answers import Recording, Trigger
from appliance.configuration.settings import RecorderRules
from appliance.recorder.recording import MOST_TRIGGERS, Progress, RecordingInProgress, load_progress
from appliance.recorder.recording_plan import KEPT, HourlyLimit, lane, span
from appliance.recorder.recording_store import MOST_LENT, Shelf
from appliance.recorder.triggers import trigger_of

SETTLE_SECONDS = 0.5
"""After its end a recording waits so long for what is on its way from the relay, and from the log."""

_IDLE_SECONDS, _BUSY_SECONDS = 0.5, 0.25
_PAGES = 20  # of the log in one step
_MOST_RECORDS = 200_000  # of the log in one recording
_SECOND = 1_000_000_000
_TELL_AGAIN = 600 * _SECOND
_MOST_TOLD = 4096
_log = structlog.get_logger()


class Recorder:
    """Makes recordings of `rings`, which were made at `memory` (nanoseconds since the epoch), by the log at `log`.

    `reserve` bytes of the disk are left free.
    """

    def __init__(
        self,
        rules: RecorderRules,
        shelf: Shelf,
        log: Path,
        rings: Sequence[memoryview],
        *,
        memory: int,
        reserve: int,
        clock: Callable[[], int] = time.time_ns,
    ) -> None:
        self._rules = rules
        self._shelf = shelf
        self._log = log
        self._rings = rings
        self._memory = memory
        self._reserve = reserve
        self._clock = clock
        self._ids = IdSource(clock=clock)
        self._limit = HourlyLimit(rules.per_hour, shelf.recordings)
        self._follower: Follower | None = None
        self._making: list[RecordingInProgress] = []
        self._revisions = messages.RevisionsStated(0, 0)
        self._asked_for: set[str] = set()  # the recordings for whose end the revisions were asked
        self._told: dict[
            tuple[str, str], int
        ] = {}  # when it was told last that such a trigger made no recording
        self._answers: list[messages.Message] = []
        self._take_up()

    def step(self, said: Iterable[Any] = ()) -> list[messages.Message]:
        """Obey what control has said, follow the log, go on with the recording; what control is to be told."""
        for message in said:
            try:
                self._obey(message)
            except OSError as error:
                _log.error(
                    "what control said cannot be done", order=type(message).__name__, reason=str(error)
                )
        try:
            for trigger, planned in self._new_triggers():
                self._triggered(trigger, planned)
        except LogUnreadableError as error:
            _log.error("the audit log cannot be read; it is tried again", reason=str(error))
        for making in tuple(self._making):
            try:
                self._go_on(making)
            except OSError as error:
                self._give_up(making, error)
        self._remove_outdated()
        answers, self._answers = self._answers, []
        return answers

    def close(self) -> None:
        """Leave the recordings that are being made to the next recorder."""
        for making in self._making:
            making.leave()

    @property
    def pause(self) -> float:
        """Seconds until the next step is due."""
        return _BUSY_SECONDS if self._making else _IDLE_SECONDS

    # --- what control says --------------------------------------------------------------------------------

    def _obey(self, message: Any) -> None:
        match message:
            case messages.RecordingsAsked():
                self._answers.append(messages.RecordingsStated(list(self._shelf.recordings)))
                self._answers += [messages.RecordingClosed(found) for found in self._shelf.unnoted()]
                self._answers += [messages.RecordingRemoved(0, *removed) for removed in self._shelf.removed()]
                self._answers.append(messages.RevisionsWanted())
            case messages.RevisionsStated():
                self._revisions = message
            case messages.RecordingNoted(recording_id):
                self._shelf.note(recording_id)
            case messages.RecordingWanted():
                self._order(message)
            case messages.MemoryWanted():
                self._lend(message)
            case messages.RecordingRemovalWanted(number, recording_id, who):
                self._remove(number, recording_id, who)

    def _order(self, wanted: messages.RecordingWanted) -> None:
        making, why_not = self._record(wanted.trigger, wanted.before, wanted.after)
        if making is None:
            self._answers.append(messages.RecordingRefused(wanted.number, why_not))
            if wanted.trigger.what == "service":  # an operator reads the refusal, of a node's nobody may
                self._missed(wanted.trigger, why_not)
        else:
            progress = making.progress
            self._answers.append(
                messages.RecordingBegun(wanted.number, progress.id, progress.ends, progress.began)
            )

    def _lend(self, wanted: messages.MemoryWanted) -> None:
        """Write what is in memory of that time where it can be read, beside the recordings and not among them."""
        now = self._clock()
        since = max(self._memory, wanted.since, now - int(self._rules.before * _SECOND))
        until = min(wanted.until, now)
        if since > until:
            reason = f"the memory has the last {self._rules.before:g} seconds, and nothing of that time"
            self._answers.append(messages.RecordingRefused(wanted.number, reason, unknown=True))
            return
        if self._shelf.free < 2 * self._reserve + self._shelf.largest:
            self._answers.append(messages.RecordingRefused(wanted.number, "the disk is nearly full"))
            return
        progress = Progress(self._ids.next(), self._memory, since, until, [wanted.trigger])
        try:
            if not self._shelf.can_lend(now):
                reason = f"others asked for it {MOST_LENT} times within seconds: try again in half a minute"
                self._answers.append(messages.RecordingRefused(wanted.number, reason))
                return
            self._shelf.mark_lent(progress.id)
            lent = self._in_progress(progress)
            try:
                lent.step()
                recording = lent.finish((), self._revisions)
            finally:
                lent.leave()
            self._shelf.lend(recording)
        except OSError as error:
            self._shelf.discard_part(progress.id)
            self._answers.append(messages.RecordingRefused(wanted.number, str(error)))
        else:
            self._answers.append(messages.MemoryLent(wanted.number, recording))

    def _remove(self, number: int, recording_id: str, who: str) -> None:
        recording = self._shelf.find(recording_id)
        if recording is None:
            refused = messages.RecordingRefused(number, f"there is no recording {recording_id}", unknown=True)
            self._answers.append(refused)
            return
        try:
            self._shelf.remove(recording, who, "")
        except OSError as error:
            self._answers.append(messages.RecordingRefused(number, str(error)))
        else:
            self._answers.append(messages.RecordingRemoved(number, recording, who, ""))

    # --- triggers -----------------------------------------------------------------------------------------

    def _new_triggers(self) -> list[tuple[Trigger, str]]:
        """What has happened, each with the recording that control has planned for it (empty: none)."""
        follower = self._follower or self._begin_to_follow()
        found: list[tuple[Trigger, str]] = []
        for _page in range(_PAGES):
            entries = follower.poll()
            if not entries:
                break
            for record in (entry.record for entry in entries):
                trigger = trigger_of(record, self._rules.triggers)
                if trigger is None:
                    continue
                if "not_recorded" in record.detail:
                    self._missed(trigger, str(record.detail["not_recorded"]))
                else:
                    found.append((trigger, str(record.detail.get("recording", ""))))
        return found

    def _begin_to_follow(self) -> Follower:
        """From what the memory still has: an earlier recorder may have fallen before it saw the last of it."""
        since = max(self._memory, self._clock() - int(self._rules.before * _SECOND))
        first = search(self._log, Filter(since=since), "0", 1, newest_first=False).entries
        self._follower = Follower(self._log, Filter(), first[0].sequence - 1 if first else None)
        return self._follower

    def _triggered(self, trigger: Trigger, planned: str) -> None:
        if planned and self._shelf.knows(planned):
            kept = self._shelf.find(planned)
            if kept is not None and trigger.time > kept.ended:
                self._missed(
                    trigger, f"recording {planned} had ended: {kept.why_not or 'its time was over'}", planned
                )
            return
        if any(
            lane(kept.charged_to) == lane(trigger.charged_to) and kept.began <= trigger.time <= kept.ended
            for kept in self._shelf.recordings
        ):
            return
        making, why_not = self._record(trigger, planned=planned)
        if making is None:
            self._missed(trigger, why_not, planned)

    def _missed(self, trigger: Trigger, why: str, planned: str = "") -> None:
        """Have it recorded that such a trigger began no recording, which is said again after a while."""
        now, kind = self._clock(), (trigger.charged_to, trigger.what)
        if (
            planned or abs(now - self._told.get(kind, -_TELL_AGAIN)) >= _TELL_AGAIN
        ):  # or the clock was set back
            if len(self._told) > _MOST_TOLD:
                self._told.clear()
            self._told[kind] = now
            self._answers.append(messages.RecordingMissed(trigger, why, planned))

    def _record(
        self, trigger: Trigger, before: float | None = None, after: float | None = None, planned: str = ""
    ) -> tuple[RecordingInProgress | None, str]:
        """Have a recording with this trigger in it: the one that is made, or why there is none."""
        charged_to, now = trigger.charged_to, trigger.time
        for making in tuple(self._making):
            progress = making.progress
            if lane(progress.charged_to) == lane(charged_to):
                if now <= progress.ends:
                    _prolong(progress, trigger, after)
                    return making, ""
                try:
                    self._close(making)
                except OSError as error:
                    self._give_up(making, error)
        if self._shelf.free < 2 * self._reserve + self._shelf.largest:
            return None, "the disk is nearly full"
        if (
            not planned
            and trigger.what != "order"
            and not self._limit.take(charged_to, trigger.what, self._clock())
        ):
            return None, self._limit.refusal(charged_to)
        why_not = self._make_room(charged_to)
        if why_not:
            return None, why_not
        own = [kept.ended for kept in self._shelf.recordings if lane(kept.charged_to) == lane(charged_to)]
        ended = max(own, default=0)
        times = span(self._rules, now, ended, before, after)
        began = (
            max(self._memory, times.began) if self._memory <= now else times.began
        )  # the clock was set back since
        latest = began + int(self._rules.longest * _SECOND)
        progress = Progress(
            planned or self._ids.next(), self._memory, began, min(times.ends, latest), [trigger],
            charged_to=charged_to, hold=times.hold, latest=latest,
        )  # fmt: skip
        try:
            making = self._in_progress(progress)
        except OSError as error:
            self._shelf.discard_part(progress.id)
            return None, str(error)
        self._making.append(making)
        self._answers.append(messages.RevisionsWanted())
        _log.info("a recording begins", recording=progress.id, trigger=trigger.what, charged_to=charged_to)
        return making, ""

    def _in_progress(self, progress: Progress) -> RecordingInProgress:
        folder = self._shelf.part(progress.id)
        return RecordingInProgress(folder, progress, self._rings, largest=self._shelf.largest)

    # --- the recording ------------------------------------------------------------------------------------

    def _go_on(self, making: RecordingInProgress) -> None:
        now, progress = self._clock(), making.progress
        if now < progress.began:
            progress.why_not = "the clock was set back while it was made"
            now = progress.began
        if now <= progress.ends:
            making.step()
        elif progress.id not in self._asked_for:
            self._asked_for.add(progress.id)
            self._answers.append(messages.RevisionsWanted())
        if self._shelf.free < self._reserve:
            progress.why_not = "the disk was nearly full"
        if progress.why_not:
            progress.ends = min(now, progress.ends)
        if progress.why_not or now >= progress.ends + int(SETTLE_SECONDS * _SECOND):
            self._close(making)

    def _close(self, making: RecordingInProgress) -> None:
        """The recording is over: its last messages, the audit records of its time, and its description."""
        making.step()
        self._finish(making)

    def _finish(self, making: RecordingInProgress) -> None:
        progress = making.progress
        within = Filter(since=progress.began, until=progress.ends + 1)
        try:
            records = list(islice(export(self._log, within), _MOST_RECORDS))
        except LogUnreadableError as error:
            records = []
            progress.why_not = progress.why_not or f"the audit log could not be read: {error}"
        recording = making.finish(records, self._revisions)
        self._forget(making)
        self._shelf.keep(recording)
        self._answers.append(messages.RecordingClosed(recording))
        _log.info("a recording is closed", recording=recording.id, size=recording.size)

    def _give_up(self, making: RecordingInProgress, error: OSError) -> None:
        """The disk does not take it: what was written of it goes."""
        _log.error("a recording cannot be made", reason=str(error))
        making.leave()
        progress = making.progress
        self._shelf.discard_part(progress.id)
        self._forget(making)
        self._answers.append(messages.RecordingMissed(progress.triggers[0], str(error), progress.id))

    def _forget(self, making: RecordingInProgress) -> None:
        self._making = [other for other in self._making if other is not making]
        self._asked_for.discard(making.progress.id)

    def _take_up(self) -> None:
        """Go on with what a fallen recorder began, or finish it; where nothing is known of it, take it away."""
        for folder in self._shelf.parts():
            try:
                progress = load_progress(folder)
            except (OSError, msgspec.MsgspecError):
                _log.warning("a recording that had only been begun is removed", folder=folder.name)
                shutil.rmtree(folder)
                continue
            try:
                if progress.memory == self._memory:
                    self._making.append(self._in_progress(progress))
                    _log.warning("a recording that was begun goes on", recording=progress.id)
                    continue
                progress.why_not = "the appliance ended while it was made"
                _log.warning("a recording that was begun is finished without its end", recording=progress.id)
                self._finish(RecordingInProgress(folder, progress, (), largest=self._shelf.largest))
            except OSError as error:
                _log.error("it cannot be finished; the next start tries again", reason=str(error))

    def _remove_outdated(self) -> None:
        try:
            for recording, reason in self._shelf.outdated(self._clock()):
                self._remove_for(recording, reason)
        except OSError as error:
            _log.error("a recording cannot be removed", reason=str(error))

    def _make_room(self, charged_to: str) -> str:
        """Remove what is in the way of a recording of this host; why there is no room all the same."""
        while True:
            try:
                found, why = self._shelf.in_the_way(
                    charged_to, [making.progress.charged_to for making in self._making]
                )
                if found is None:
                    return why
                self._remove_for(found, why)
            except OSError as error:
                return str(error)

    def _remove_for(self, recording: Recording, reason: str) -> None:
        self._shelf.remove(recording, "", reason)
        self._answers.append(messages.RecordingRemoved(0, recording, "", reason))


def _prolong(progress: Progress, trigger: Trigger, after: float | None) -> None:
    """A trigger within the time of a recording is one of its own."""
    hold = progress.hold if after is None else int(after * _SECOND)
    progress.ends = max(progress.ends, min(trigger.time + hold, progress.latest))
    if trigger.charged_to in KEPT and progress.charged_to not in KEPT:
        progress.charged_to = trigger.charged_to  # from now on no host displaces it
    known = any(trigger.record == other.record for other in progress.triggers)
    if not known and len(progress.triggers) < MOST_TRIGGERS:
        progress.triggers.append(trigger)
