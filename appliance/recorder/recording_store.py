"""The recordings that are kept: `ID/recording.bag` and `ID/recording.json`, and what was begun as `.ID.part/`.

What is removed is `.ID.gone/` until the audit log has that, without its bag; `.ID.rest/` is nothing any more.

Invariants:

1. A folder with the name of a recording is whole: it gets that name when all that is in it is on disk.
2. All of them together never have more than `disk` bytes: room for the largest is made before one is begun. A host but
   the robot's makes room from its own where it would have more than a quarter of it; all of these together have three
   quarters at most. One of theirs never takes the place of one of the robot's or of operators', who need not have less
   than half of the disk because of others. Of those that make room the oldest goes, of the kind of trigger that has
   most. So it is with the number of recordings, and where their descriptions have more than `_MOST_DESCRIBED` bytes:
   control is told of all of them in one message.
3. `noted` in a folder says that the audit log has the recording; what was not noted is told again.
4. `lent` in a folder says that it is no recording that is kept: there are `MOST_LENT` at most, of which the oldest goes
   with the next, but not while who asked for it may be about to open it (`_OPENING_SECONDS`), and a recorder that
   begins removes them, also where the one before fell while one was made. They are not counted: beside what `disk`
   says there may be as many recordings' shares for `LENT_SECONDS`.
5. Whenever the recorder falls, a recording is there, or it is gone and that is told: of a folder that has the name of a
   recording nothing is removed; it loses its name first, at once.
"""

import re
import shutil
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import msgspec
import structlog

from appliance.channel.answers.recording_answers import Recording
from appliance.recorder.recording_plan import KEPT

BAG, ABOUT, PROGRESS = "recording.bag", "recording.json", "progress"
MOST_KEPT = 500
LENT_SECONDS = 600
MOST_LENT = 4
_OPENING_SECONDS = 30
_MOST_DESCRIBED = 32 << 20
_NOTED, _LENT, _REMOVED, _SINCE = "noted", "lent", "removed", "since"
_ID = re.compile(r"[0-9a-f]{20}")
_PART, _GONE, _REST = (re.compile(rf"\.([0-9a-f]{{20}})\.{kind}") for kind in ("part", "gone", "rest"))
_LARGEST = 8  # the part of `disk` that one recording may have
_SECOND = 1_000_000_000
_log = structlog.get_logger()


class Shelf:
    """The recordings in `folder`. They have `disk` bytes together, and go after `seconds` (None: never) of `clock`."""

    def __init__(self, folder: Path, *, disk: int, seconds: float | None, clock: Callable[[], int]) -> None:
        self._folder = folder
        self._disk = disk
        self._seconds = seconds
        self._clock = clock
        for mark in folder.glob(f"*/{_LENT}"):
            self._discard(mark.parent)
        for rest in self._named(_REST):
            shutil.rmtree(rest)
        for gone in self._named(_GONE):
            (gone / BAG).unlink(missing_ok=True)
        self._lent: list[Recording] = []
        self.recordings = sorted(self._read(), key=lambda recording: recording.id)
        self._described = {found.id: self._length(found) for found in self.recordings}
        self._since = {found.id: self._kept_since(found) for found in self.recordings}

    def _read(self) -> Iterator[Recording]:
        for path in self._folder.iterdir():
            if _ID.fullmatch(path.name):
                try:
                    yield msgspec.json.decode((path / ABOUT).read_bytes(), type=Recording)
                except (OSError, msgspec.MsgspecError) as error:
                    _log.error("a recording cannot be read", recording=path.name, error=str(error))

    def _kept_since(self, recording: Recording) -> int:
        """When it was kept, by the clock of ages; where that was not written, its end."""
        with suppress(OSError, ValueError):
            return int((self._folder / recording.id / _SINCE).read_bytes())
        return recording.ended

    def _length(self, recording: Recording) -> int:
        return (self._folder / recording.id / ABOUT).stat().st_size

    @property
    def largest(self) -> int:
        """Bytes that one recording may have."""
        return self._disk // _LARGEST

    @property
    def free(self) -> int:
        """Bytes that are free on the disk."""
        return shutil.disk_usage(self._folder).free

    def part(self, recording_id: str) -> Path:
        """The folder in which a recording is made."""
        return self._folder / f".{recording_id}.part"

    def parts(self) -> list[Path]:
        """Those that were begun and not finished, the oldest first."""
        return self._named(_PART)

    def _named(self, kind: re.Pattern[str]) -> list[Path]:
        return sorted(path for path in self._folder.iterdir() if kind.fullmatch(path.name))

    def _discard(self, folder: Path) -> None:
        """Nothing of it is there any more, or nothing of it counts. Raises `OSError`."""
        rest = self._folder / f".{folder.name.strip('.')[:20]}.rest"
        folder.rename(rest)
        shutil.rmtree(rest)

    def discard_part(self, recording_id: str) -> None:
        """Take away what was begun of a recording, if anything was."""
        with suppress(OSError):
            self._discard(self.part(recording_id))

    def keep(self, recording: Recording) -> None:
        """A recording is whole, and all of it on disk; only what has no name yet needs `progress`."""
        kept = self._folder / recording.id
        with suppress(OSError):  # a full disk: then it is kept by its end
            (self.part(recording.id) / _SINCE).write_bytes(b"%d" % self._clock())
        self.part(recording.id).rename(kept)
        (kept / PROGRESS).unlink(missing_ok=True)
        self._since[recording.id] = self._kept_since(recording)
        self.recordings.append(recording)
        self._described[recording.id] = self._length(recording)

    def mark_lent(self, recording_id: str) -> None:
        """What is made in its folder is not to be kept. Raises `OSError`."""
        self.part(recording_id).mkdir(mode=0o750, exist_ok=True)
        (self.part(recording_id) / _LENT).touch()

    def can_lend(self, now: int) -> bool:
        """Make room for one that is not kept; False while all that there may be are about to be opened.

        Raises `OSError`.
        """
        self._take_back(now, MOST_LENT - 1, _OPENING_SECONDS)
        return len(self._lent) < MOST_LENT

    def lend(self, recording: Recording) -> None:
        """One that is not kept can be read for `LENT_SECONDS`, or until others need its place. Raises `OSError`."""
        self.part(recording.id).rename(self._folder / recording.id)
        self._lent.append(recording)

    def _take_back(self, now: int, most: int, seconds: float) -> None:
        """Of those that were lent longer ago the oldest go, until there are so many."""
        while len(self._lent) > most and abs(now - self._lent[0].triggers[0].time) > seconds * _SECOND:
            self._discard(self._folder / self._lent[0].id)
            del self._lent[0]

    def find(self, recording_id: str) -> Recording | None:
        """The recording of this id; None when there is none."""
        return next((found for found in self.recordings if found.id == recording_id), None)

    def knows(self, recording_id: str) -> bool:
        """Whether there is a recording of this id, or was one that was removed a moment ago."""
        return self.find(recording_id) is not None or self._gone(recording_id).exists()

    def remove(self, recording: Recording, who: str, reason: str) -> None:
        """Take a recording away, for somebody or for a reason. Raises `OSError`."""
        kept, gone = self._folder / recording.id, self._gone(recording.id)
        with suppress(OSError):  # a full disk, which is when recordings have to go
            (kept / _REMOVED).write_bytes(msgspec.json.encode((who, reason)))
        kept.rename(gone)
        self.recordings.remove(recording)
        del self._described[recording.id], self._since[recording.id]
        (gone / BAG).unlink(missing_ok=True)

    def _gone(self, recording_id: str) -> Path:
        return self._folder / f".{recording_id}.gone"

    def removed(self) -> Iterator[tuple[Recording, str, str]]:
        """Those that were removed, for whom and why, and of which it is not known whether the audit log has that."""
        for folder in self._named(_GONE):
            try:
                recording = msgspec.json.decode((folder / ABOUT).read_bytes(), type=Recording)
            except (OSError, msgspec.MsgspecError):
                continue
            who, reason = "", "the recorder fell meanwhile"
            with suppress(OSError, msgspec.MsgspecError):
                who, reason = msgspec.json.decode((folder / _REMOVED).read_bytes(), type=tuple[str, str])
            yield recording, who, reason

    def note(self, recording_id: str) -> None:
        """The audit log has it: that there is this recording, or that it was removed. Raises `OSError`."""
        if self.find(recording_id) is not None:
            (self._folder / recording_id / _NOTED).touch()
        elif self._gone(recording_id).exists():
            self._discard(self._gone(recording_id))

    def unnoted(self) -> list[Recording]:
        """Those of which it is not known whether the audit log has them."""
        return [found for found in self.recordings if not (self._folder / found.id / _NOTED).exists()]

    def outdated(self, now: int) -> Iterator[tuple[Recording, str]]:
        """What is too old now (nanoseconds since the epoch), and why; to be removed before the next is asked for.

        What was lent for long enough goes, too. Raises `OSError`.
        """
        self._take_back(now, 0, LENT_SECONDS)
        while self._seconds is not None and self.recordings:
            oldest = self.recordings[0]
            if self._since[oldest.id] + int(self._seconds * 1e9) > self._clock():
                break
            yield oldest, "it is older than recorder.days"

    def in_the_way(self, charged_to: str, making: Sequence[str] = ()) -> tuple[Recording | None, str]:
        """The next recording to remove so that one of this host can be made, and why; an empty reason: there is room.

        None with a reason: no other is to make room. `making` are the hosts whose recordings are being made now.
        """
        held = self._sizes(lambda found: found.charged_to)
        held.update({name: number * self.largest for name, number in Counter((*making, charged_to)).items()})
        guests = {name: size for name, size in held.items() if name not in KEPT}
        kept_here = {found.charged_to for found in self.recordings}
        if charged_to not in KEPT and held[charged_to] > self._disk // 4 and charged_to in kept_here:
            return self._oldest({charged_to}), f"{charged_to} has its share of recorder.disk"
        if charged_to not in KEPT and sum(guests.values()) > self._disk * 3 // 4:
            why = "hosts but the robot have their share of recorder.disk"
        elif sum(held.values()) > self._disk:
            why = "recorder.disk is used up"
        elif len(self.recordings) + len(making) >= MOST_KEPT:
            why = f"there are {MOST_KEPT} recordings"
        elif sum(self._described.values()) > _MOST_DESCRIBED:
            why = f"the descriptions of all recordings have more than {_MOST_DESCRIBED} bytes"
        else:
            return None, ""
        others, own = kept_here - KEPT, kept_here & KEPT
        if others and (charged_to not in KEPT or not own or sum(guests.values()) * 2 > self._disk):
            return self._oldest({max(others, key=lambda name: held[name])}), why
        return (self._oldest(own), why) if own and charged_to in KEPT else (None, why)

    def _oldest(self, charged_to: Collection[str]) -> Recording:
        """Of these hosts' recordings the oldest of the kind of trigger that has most."""
        kinds = self._sizes(lambda found: _kind(found) if found.charged_to in charged_to else "")
        del kinds[""]
        fullest = max(kinds, key=lambda kind: kinds[kind])
        return next(
            found for found in self.recordings if found.charged_to in charged_to and _kind(found) == fullest
        )

    def _sizes(self, of: Callable[[Recording], str]) -> Counter[str]:
        sizes: Counter[str] = Counter()
        for recording in self.recordings:
            sizes[of(recording)] += recording.size
        return sizes


def _kind(recording: Recording) -> str:
    return recording.triggers[0].what if recording.triggers else "order"
