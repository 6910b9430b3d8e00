"""Store recordings (`ID/`) and unfinished recordings (`.ID.part/`).

A removed recording stays as `.ID.gone/`, without its bag, until its removal is in the audit log. `.ID.rest/` is
garbage.

1. A folder is renamed to its recording's id only when its whole content is on disk.
2. Recordings never exceed `disk` bytes: room for the largest possible recording is made before it begins. Recordings
   of hosts other than the robot use at most three quarters of it, and those of one host, or of the appliance, a
   quarter. Hosts never replace recordings of the robot, of operators or of the appliance. The first to be removed is
   the oldest of the kind of trigger that uses the most bytes. Nothing is removed for a recording that is then refused.
3. The file `noted` marks a recording that is in the audit log. Other recordings are reported again.
4. The file `lent` marks a temporary recording, which does not count in `disk`. A new one replaces the oldest of
   `MAX_TEMPORARY`, unless its reader may not have opened it yet.
5. Whenever the recorder dies, a recording either still exists, or its removal is reported: the folder is renamed
   atomically before anything in it is removed. A folder that a person removed counts as removed when its turn comes.
"""

import re
import shutil
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import msgspec
import structlog

from appliance.features.recorder.recording_answers import Recording
from appliance.features.recorder.recording_plan import OURS, UNLIMITED

BAG, ABOUT, PROGRESS = "recording.bag", "recording.json", "progress"
MAX_KEPT = 500
TEMPORARY_SECONDS = 600
MAX_TEMPORARY = 4
_OPENING_SECONDS = 30
_MAX_DESCRIBED = 32 << 20  # bytes; control gets all descriptions in one message
_NOTED, _TEMPORARY, _REMOVED, _SINCE = "noted", "lent", "removed", "since"
_ID = re.compile(r"[0-9a-f]{20}")
_PART, _GONE, _REST = (re.compile(rf"\.([0-9a-f]{{20}})\.{kind}") for kind in ("part", "gone", "rest"))
_LARGEST = 8  # one recording may have this fraction of `disk`: an eighth
_SECOND = 1_000_000_000
_log = structlog.get_logger()


class RecordingStore:
    """The recordings in a folder, each kept for `seconds` of `clock`.

    `reserve` bytes of the disk stay free for the audit log. `dated` corrects a date of the clock from a time when a
    long gap did not count yet.
    """

    def __init__(
        self,
        folder: Path,
        *,
        disk: int,
        reserve: int,
        seconds: float | None,
        clock: Callable[[], int],
        dated: Callable[[int], int] = int,
    ) -> None:
        self._folder = folder
        self._disk = disk
        self._reserve = reserve
        self._seconds = seconds
        self._clock = clock
        self._dated = dated
        for mark in folder.glob(f"*/{_TEMPORARY}"):
            self._discard(mark.parent)
        for rest in self._named(_REST):
            shutil.rmtree(rest)
        for gone in self._named(_GONE):
            (gone / BAG).unlink(missing_ok=True)
        self._temporary: list[Recording] = []
        self.recordings = sorted(self._read(), key=lambda recording: recording.id)
        self._described = {found.id: self._length(found) for found in self.recordings}
        self._since = {found.id: self._kept_since(found) for found in self.recordings}

    def _read(self) -> Iterator[Recording]:
        for path in self._folder.iterdir():
            if _ID.fullmatch(path.name):
                try:
                    yield msgspec.json.decode((path / ABOUT).read_bytes(), type=Recording)
                except (OSError, ValueError) as error:
                    _log.error("a recording cannot be read", recording=path.name, error=str(error))

    def _kept_since(self, recording: Recording) -> int:
        """Return the date by the age clock: now if the disk was full, or an earlier version kept none."""
        file = self._folder / recording.id / _SINCE
        with suppress(OSError, ValueError):
            return int(file.read_bytes())
        now = self._clock()
        with suppress(OSError):
            file.write_bytes(b"%d" % now)
        return now

    def _length(self, recording: Recording) -> int:
        return (self._folder / recording.id / ABOUT).stat().st_size

    @property
    def largest(self) -> int:
        return self._disk // _LARGEST

    @property
    def free(self) -> int:
        return shutil.disk_usage(self._folder).free

    @property
    def full(self) -> bool:
        """Whether the space that is reserved for the audit log is in use."""
        return self.free < self._reserve

    @property
    def lacking(self) -> str:
        """Why no recording may begin: the largest one must leave twice the reserve. Empty if one may."""
        needed, free = 2 * self._reserve + self.largest, self.free
        if free >= needed:
            return ""
        return (
            f"the disk is nearly full: {free / 1e6:.0f} MB are free at {self._folder}, and a recording needs"
            f" {needed / 1e6:.0f} MB to begin"
        )

    def part(self, recording_id: str) -> Path:
        return self._folder / f".{recording_id}.part"

    def parts(self) -> list[Path]:
        return self._named(_PART)

    def _named(self, kind: re.Pattern[str]) -> list[Path]:
        return sorted(path for path in self._folder.iterdir() if kind.fullmatch(path.name))

    def _discard(self, folder: Path) -> None:
        """Remove a folder without an audit record. A person may have removed it."""
        rest = self._folder / f".{folder.name.strip('.')[:20]}.rest"
        with suppress(FileNotFoundError):
            folder.rename(rest)
            shutil.rmtree(rest)

    def discard_part(self, recording_id: str) -> None:
        with suppress(OSError):
            self._discard(self.part(recording_id))

    def keep(self, recording: Recording) -> None:
        kept = self._folder / recording.id
        with suppress(OSError):  # the disk is full: the next start tries again
            (self.part(recording.id) / _SINCE).write_bytes(b"%d" % self._clock())
        self.part(recording.id).rename(kept)
        (kept / PROGRESS).unlink(missing_ok=True)
        self._since[recording.id] = self._kept_since(recording)
        self.recordings.append(recording)
        self._described[recording.id] = self._length(recording)

    def mark_temporary(self, recording_id: str) -> None:
        self.part(recording_id).mkdir(mode=0o750, exist_ok=True)
        (self.part(recording_id) / _TEMPORARY).touch()

    def has_temporary_room(self, now: int) -> bool:
        """Return False if all temporary recordings are too new to remove."""
        self._expire(now, MAX_TEMPORARY - 1, _OPENING_SECONDS)
        return len(self._temporary) < MAX_TEMPORARY

    def publish_temporary(self, recording: Recording) -> None:
        self.part(recording.id).rename(self._folder / recording.id)
        self._temporary.append(recording)

    def _expire(self, now: int, most: int, seconds: float) -> None:
        while (
            len(self._temporary) > most and abs(now - self._temporary[0].triggers[0].time) > seconds * _SECOND
        ):
            self._discard(self._folder / self._temporary[0].id)
            del self._temporary[0]

    def find(self, recording_id: str) -> Recording | None:
        return next((found for found in self.recordings if found.id == recording_id), None)

    def knows(self, recording_id: str) -> bool:
        return self.find(recording_id) is not None or self._gone(recording_id).exists()

    def has(self, recording_id: str) -> bool:
        """Whether a recording is kept, was removed, or is unfinished."""
        return self.knows(recording_id) or self.part(recording_id).exists()

    def remove(self, recording: Recording, who: str, reason: str) -> None:
        kept, gone = self._folder / recording.id, self._gone(recording.id)
        with suppress(OSError):  # the disk may be full, since recordings are then removed
            if not (kept / ABOUT).exists():  # a person removed it; its removal is still reported
                kept.mkdir(mode=0o750, exist_ok=True)
                (kept / ABOUT).write_bytes(msgspec.json.encode(recording))
            (kept / _REMOVED).write_bytes(msgspec.json.encode((who, reason)))
        with suppress(FileNotFoundError):
            kept.rename(gone)
        self.recordings.remove(recording)
        del self._described[recording.id], self._since[recording.id]
        (gone / BAG).unlink(missing_ok=True)

    def _gone(self, recording_id: str) -> Path:
        return self._folder / f".{recording_id}.gone"

    def removals(self) -> Iterator[tuple[Recording, str, str]]:
        for folder in self._named(_GONE):
            try:
                recording = msgspec.json.decode((folder / ABOUT).read_bytes(), type=Recording)
            except (OSError, ValueError):
                continue
            who, reason = "", "the recorder crashed during the recording"
            with suppress(OSError, ValueError):
                who, reason = msgspec.json.decode((folder / _REMOVED).read_bytes(), type=tuple[str, str])
            yield recording, who, reason

    def note(self, recording_id: str) -> None:
        if self.find(recording_id) is not None:
            (self._folder / recording_id / _NOTED).touch()
        elif self._gone(recording_id).exists():
            self._discard(self._gone(recording_id))

    def unnoted(self) -> list[Recording]:
        return [found for found in self.recordings if not (self._folder / found.id / _NOTED).exists()]

    def outdated(self, now: int) -> Iterator[tuple[Recording, str]]:
        """Yield recordings that are too old, with the reason; the caller must remove each before continuing."""
        self._expire(now, 0, TEMPORARY_SECONDS)
        while self._seconds is not None and self.recordings:
            oldest = min(self.recordings, key=lambda found: self._dated(self._since[found.id]))
            present = self._clock()  # first: it may count a gap
            if self._dated(self._since[oldest.id]) + int(self._seconds * 1e9) > present:
                break
            yield oldest, "it is older than recorder.days"

    def in_the_way(self, charged_to: str, making: Sequence[str] = ()) -> tuple[Recording | None, str]:
        """Return the next recording to remove in favour of a new one of this host, and the reason.

        A reason without a recording means that none may be removed. If both are empty, there is space. `making` has
        the hosts of the recordings in progress.
        """
        reserved = [*making, charged_to]
        stay = [] if charged_to in OURS else [found for found in self.recordings if found.charged_to in OURS]
        if refused := self._excess(stay, reserved):
            return None, refused
        held = self._held(self.recordings, reserved)
        kept_here = {found.charged_to for found in self.recordings}
        alone = {charged_to} - UNLIMITED
        if charged_to in kept_here and self._share(self.recordings, reserved, alone) > 1 / 4:
            return self._oldest({charged_to}), f"{charged_to} used its quota of recordings"
        why = self._excess(self.recordings, reserved)
        if not why:
            return None, ""
        others, own = kept_here - OURS, kept_here & OURS
        if others and (
            charged_to not in OURS or not own or self._share(self.recordings, reserved, others) > 1 / 2
        ):
            return self._oldest({max(others, key=lambda name: held[name])}), why
        return self._oldest(own), why

    def _excess(self, kept: Sequence[Recording], reserved: Sequence[str]) -> str:
        """Return why a recording of the last host in `reserved` has no room beside `kept` and those in progress."""
        held = self._held(kept, reserved)
        guests = {*(found.charged_to for found in kept), *reserved} - OURS
        if reserved[-1] not in OURS and self._share(kept, reserved, guests) > 3 / 4:
            return "hosts other than the robot used their quota of recordings"
        if sum(held.values()) > self._disk:
            return "recorder.disk is full"
        if len(kept) + len(reserved) > MAX_KEPT:
            return f"the limit is {MAX_KEPT} recordings"
        if sum(self._described[found.id] for found in kept) > _MAX_DESCRIBED:
            return f"the descriptions of all recordings have more than {_MAX_DESCRIBED} bytes"
        return ""

    def _share(self, kept: Sequence[Recording], reserved: Sequence[str], of: Collection[str]) -> float:
        """Return which part these hosts have of the bytes or of the number of recordings, the larger one."""
        size = sum(size for name, size in self._held(kept, reserved).items() if name in of)
        number = sum(name in of for name in (*(found.charged_to for found in kept), *reserved))
        return max(size / self._disk, number / MAX_KEPT)

    def _held(self, kept: Sequence[Recording], reserved: Sequence[str]) -> Counter[str]:
        held = _sizes(kept, lambda found: found.charged_to)
        held.update({name: number * self.largest for name, number in Counter(reserved).items()})
        return held

    def _oldest(self, charged_to: Collection[str]) -> Recording:
        kinds = _sizes((found for found in self.recordings if found.charged_to in charged_to), _kind)
        fullest = max(kinds, key=lambda kind: kinds[kind])
        return next(
            found for found in self.recordings if found.charged_to in charged_to and _kind(found) == fullest
        )


def _sizes(recordings: Iterable[Recording], of: Callable[[Recording], str]) -> Counter[str]:
    sizes: Counter[str] = Counter()
    for recording in recordings:
        sizes[of(recording)] += recording.size
    return sizes


def _kind(recording: Recording) -> str:
    return recording.triggers[0].what if recording.triggers else "order"
