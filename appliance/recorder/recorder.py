"""The flight recorder: follows the audit log, and makes a recording of what relays have in memory when there is reason.

`step` does all that is due and returns what control is to be told; nothing here waits or knows a socket.

Invariants:

1. One recording is made at a time. A trigger within its time makes it longer, up to `longest`; a later one begins
   another.
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

from appliance.audit.database import LogUnreadableError
from appliance.audit.ids import IdSource
from appliance.audit.query import Filter
from appliance.audit.search import Follower, export, search
from appliance.channel import messages
from appliance.channel.answers.recordings import Trigger
from appliance.config import RecorderRules
from appliance.recorder.recording import MOST_TRIGGERS, Progress, RecordingInProgress, load_progress
from appliance.recorder.shelf import MOST_LENT, Shelf
from appliance.recorder.triggers import HourlyLimit, trigger_of

SETTLE_SECONDS = 0.5
"""After its end a recording waits so long for what is on its way from the relay, and from the log."""

_IDLE_SECONDS, _BUSY_SECONDS = 0.5, 0.25
_PAGES = 20  # of the log in one step
_MOST_RECORDS = 200_000  # of the log in one recording
_SECOND = 1_000_000_000
_TELL_AGAIN = 600 * _SECOND
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
        self._making: RecordingInProgress | None = None
        self._revisions = messages.RevisionsStated(0, 0)
        self._revisions_asked = False
        self._told: dict[str, int] = {}  # when it was told last that such a trigger made no recording
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
            for trigger in self._new_triggers():
                self._triggered(trigger)
            self._go_on()
        except LogUnreadableError as error:
            _log.error("the audit log cannot be read; it is tried again", reason=str(error))
        except OSError as error:
            self._give_up(error)
        self._remove_surplus(room=False)
        answers, self._answers = self._answers, []
        return answers

    def close(self) -> None:
        """Leave the recording that is being made to the next recorder."""
        if self._making is not None:
            self._making.leave()

    @property
    def pause(self) -> float:
        """Seconds until the next step is due."""
        return _IDLE_SECONDS if self._making is None else _BUSY_SECONDS

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
        try:
            why_not = self._record(wanted.trigger, wanted.before, wanted.after)
        except OSError as error:
            self._give_up(error)
            why_not = str(error)
        if self._making is None or why_not:
            self._answers.append(messages.RecordingRefused(wanted.number, why_not))
            if wanted.trigger.what == "service":  # an operator reads the refusal, of a node's nobody may
                self._missed(wanted.trigger, why_not)
        else:
            progress = self._making.progress
            self._answers.append(messages.RecordingBegun(wanted.number, progress.id, progress.ends))

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

    def _new_triggers(self) -> list[Trigger]:
        follower = self._follower or self._begin_to_follow()
        found: list[Trigger] = []
        for _page in range(_PAGES):
            entries = follower.poll()
            if not entries:
                break
            triggers = (trigger_of(entry.record, self._rules.triggers) for entry in entries)
            found += [trigger for trigger in triggers if trigger is not None]
        return found

    def _begin_to_follow(self) -> Follower:
        """From what the memory still has: an earlier recorder may have fallen before it saw the last of it."""
        since = max(self._memory, self._clock() - int(self._rules.before * _SECOND))
        first = search(self._log, Filter(since=since), "0", 1, newest_first=False).entries
        self._follower = Follower(self._log, Filter(), first[0].sequence - 1 if first else None)
        return self._follower

    def _triggered(self, trigger: Trigger) -> None:
        if any(kept.began <= trigger.time <= kept.ended for kept in self._shelf.recordings):
            return
        why_not = self._record(trigger, self._rules.before, self._rules.after)
        if why_not:
            self._missed(trigger, why_not)

    def _missed(self, trigger: Trigger, why: str) -> None:
        """Have it recorded that such a trigger began no recording, which is said again after a while."""
        now = self._clock()
        if abs(now - self._told.get(trigger.what, -_TELL_AGAIN)) >= _TELL_AGAIN:  # or the clock was set back
            self._told[trigger.what] = now
            self._answers.append(messages.RecordingMissed(trigger, why))

    def _record(self, trigger: Trigger, before: float, after: float) -> str:
        """Have a recording with this trigger in it; why there is none, or empty. Raises `OSError`."""
        ends = trigger.time + int(after * _SECOND)
        if self._making is not None:
            progress = self._making.progress
            latest = progress.began + int(self._rules.longest * _SECOND)
            if trigger.time <= progress.ends:
                progress.ends = max(progress.ends, min(ends, latest))
                known = any(trigger.record == other.record for other in progress.triggers)
                if not known and len(progress.triggers) < MOST_TRIGGERS:
                    progress.triggers.append(trigger)
                return ""
            self._close()
        if self._shelf.free < 2 * self._reserve + self._shelf.largest:
            return "the disk is nearly full"
        if trigger.what != "order" and not self._limit.take(trigger.what, self._clock()):
            return f"this hour has its {self._rules.per_hour} recordings of this kind (recorder.per_hour)"
        self._remove_surplus(room=True)
        began = trigger.time - int(before * _SECOND)
        if self._memory <= trigger.time:  # else the clock was set back since
            began = max(self._memory, began)
        ends = min(ends, began + int(self._rules.longest * _SECOND))
        progress = Progress(self._ids.next(), self._memory, began, ends, [trigger])
        self._making = self._in_progress(progress)
        self._answers.append(messages.RevisionsWanted())
        _log.info("a recording begins", recording=progress.id, trigger=trigger.what)
        return ""

    def _in_progress(self, progress: Progress) -> RecordingInProgress:
        folder = self._shelf.part(progress.id)
        return RecordingInProgress(folder, progress, self._rings, largest=self._shelf.largest)

    # --- the recording ------------------------------------------------------------------------------------

    def _go_on(self) -> None:
        if self._making is None:
            return
        now, progress = self._clock(), self._making.progress
        if now < progress.began:
            progress.why_not = "the clock was set back while it was made"
            now = progress.began
        if now <= progress.ends:
            self._making.step()
        elif not self._revisions_asked:
            self._revisions_asked = True
            self._answers.append(messages.RevisionsWanted())
        if self._shelf.free < self._reserve:
            progress.why_not = "the disk was nearly full"
        if progress.why_not:
            progress.ends = min(now, progress.ends)
        if progress.why_not or now >= progress.ends + int(SETTLE_SECONDS * _SECOND):
            self._close()

    def _close(self) -> None:
        """The recording is over: its last messages, the audit records of its time, and its description."""
        assert self._making is not None  # noqa: S101  somebody has looked
        self._making.step()
        self._finish(self._making)

    def _finish(self, making: RecordingInProgress) -> None:
        progress = making.progress
        within = Filter(since=progress.began, until=progress.ends + 1)
        try:
            records = list(islice(export(self._log, within), _MOST_RECORDS))
        except LogUnreadableError as error:
            records = []
            progress.why_not = progress.why_not or f"the audit log could not be read: {error}"
        recording = making.finish(records, self._revisions)
        self._making, self._revisions_asked = None, False
        self._shelf.keep(recording)
        self._answers.append(messages.RecordingClosed(recording))
        _log.info("a recording is closed", recording=recording.id, size=recording.size)

    def _give_up(self, error: OSError) -> None:
        """The disk does not take it: what was written of it goes."""
        _log.error("a recording cannot be made", reason=str(error))
        if self._making is not None:
            self._making.leave()
            progress = self._making.progress
            self._shelf.discard_part(progress.id)
            self._making, self._revisions_asked = None, False
            self._answers.append(messages.RecordingMissed(progress.triggers[0], str(error)))

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
                if progress.memory == self._memory and self._making is None:
                    self._making = self._in_progress(progress)
                    _log.warning("a recording that was begun goes on", recording=progress.id)
                    continue
                progress.why_not = "the appliance ended while it was made"
                _log.warning("a recording that was begun is finished without its end", recording=progress.id)
                self._finish(RecordingInProgress(folder, progress, (), largest=self._shelf.largest))
            except OSError as error:
                _log.error("it cannot be finished; the next start tries again", reason=str(error))

    def _remove_surplus(self, *, room: bool) -> None:
        try:
            for recording, reason in self._shelf.surplus(self._clock(), room=room):
                self._shelf.remove(recording, "", reason)
                self._answers.append(messages.RecordingRemoved(0, recording, "", reason))
        except OSError as error:
            _log.error("a recording cannot be removed", reason=str(error))
