"""Store segments as files (listed in docs/reference/fleet.md), before any other part of the collector uses them.

A marker, an empty file KIND/ROBOT/LOG~NUMBER~NAME, states a fact about a segment:

- `pending`, `large`: it is not in the index yet.
- `damaged`: it could not be indexed; with `large` as well, it is tried again.
- `gaps`: it does not follow a stored segment.
- `forks`: another segment has its number.

1. A stored segment was verified, and is on the disk with its folder before `keep` returns. It never changes, unless
   the disk has damaged it and the robot uploads it again.
2. Markers are written before their segment, and `keep` repairs them, so a crash leaves a segment either stored or
   absent.
3. The state that uploads need is in file names, not in a database, nor in memory that grows with the number of
   segments.
4. A wrong system clock removes nothing: while the time is uncertain, an arrival has the latest possible time, and
   retention the earliest.
5. Work for one robot does not grow with the data of others, and the number of names that a robot can choose is
   limited. So a robot can neither slow down nor hide others.
"""

import contextlib
import errno
import itertools
import os
import re
import shutil
import sys
import tempfile
import threading
import zlib
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import IO, NamedTuple, TypeVar

import msgspec

from appliance.base import clock
from appliance.base.age_clock import AgeClock
from appliance.base.atomic_files import write_whole
from appliance.formats.segments import SegmentHeader, SegmentSummary
from rosrv_fleet.robots import make_folder

# Read the small files of the data folder. A damaged one is an `OSError` with its path, like an unreadable one.

T = TypeVar("T")


class DamagedFileError(OSError):
    """A file of the data folder has no valid content."""


def read_stored(file: Path, type_: type[T]) -> T:
    try:
        return msgspec.json.decode(file.read_bytes(), type=type_)
    except ValueError as error:
        raise DamagedFileError(
            errno.EIO, f"damaged ({error}); restore it from a backup", str(file)
        ) from error


_BUCKET = 1000
_DIGITS = 18
_MAX_ATTEMPTS = 100  # to make a marker in a folder that another thread removes when it is empty
_MAX_LOGS = 1000
_MAX_BUCKETS = 10_000
_MAX_FORKS = 16
_LARGE_BYTES = 4 << 20
_KINDS = ("pending", "large", "damaged", "gaps", "forks")
_HEADER_BYTES = 64 << 10  # a header has less than 2 KiB
_DAMAGED = (zlib.error, ValueError)
_LOG = re.compile("[0-9a-f]{32}")
_FILE = re.compile(r"(\d{18})-([0-9a-f]{64})\.ndjson\.gz")
_MARK = re.compile(r"([0-9a-f]{32})~(\d{18})~([0-9a-f]{64})")
FileStamp = tuple[int, int, int]


class StoreFullError(OSError):
    """The disk has too little free space for another segment."""


class NotStorableError(ValueError):
    """A valid segment cannot be stored: retention removed it before, or a limit of the store is exceeded."""


class RemovalNote(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The segments that retention removed from the beginning of a log. Its numbers are totals since the beginning.

    `ends` are the headers of the segments with the last removed number. `time` is in nanoseconds since the epoch;
    `by` is the setting.
    """

    ends: list[SegmentHeader]
    time: int
    by: str
    segments: int
    gaps: int
    forks: int

    @property
    def number(self) -> int:
        return self.ends[0].end.number


def read_header(file: Path) -> SegmentHeader:
    """Return the header of a compressed segment. Raise `OSError`, `zlib.error` or `ValueError` if it is unreadable.

    Only the file's beginning is read: a robot chooses how its segments are compressed, and millions of empty members
    before the content would take the server's time.
    """
    with file.open("rb") as packed:
        beginning = zlib.decompressobj(wbits=31).decompress(packed.read(_HEADER_BYTES), _HEADER_BYTES)
    line, end, _records = beginning.partition(b"\n")
    if not end:
        raise ValueError("its header is not at the beginning")
    return msgspec.json.decode(line, type=SegmentHeader)


class SegmentPlace(NamedTuple):
    """The key of a segment: its robot, its log, its checkpoint's number, and its name."""

    robot: str
    log: str
    number: int
    name: str

    @property
    def mark(self) -> str:
        return f"{self.log}~{self.number:0{_DIGITS}}~{self.name}"


class SegmentStore:
    """The segments of a collector, in a folder. Thread-safe, but only one process may write.

    The methods raise `OSError`.
    """

    def __init__(self, folder: Path, reserve: int) -> None:
        """Open the store, which keeps `reserve` bytes of the disk free."""
        self._folder = folder
        self._reserve = reserve
        self._locks: dict[str, threading.Lock] = {}
        self._aging = threading.Lock()
        for name in ("segments", "newest", "earlier", "removed", "incoming", *_KINDS):
            make_folder(folder / name)

    def _lock(self, robot: str) -> threading.Lock:
        return self._locks.setdefault(robot, threading.Lock())

    def time_ns(self) -> int:
        """Return the time by the clock of ages, in nanoseconds since the epoch."""
        with self._aging:
            return self._ages()

    def latest_ns(self) -> int:
        """Return the latest time that it may be, which arrivals get."""
        with self._aging:
            return self._ages.latest()

    @cached_property
    def _ages(self) -> AgeClock:
        return AgeClock(self._folder / "age", self._last_arrival)

    def _last_arrival(self) -> int | None:
        """Return the newest arrival, as an earlier version kept no clock of ages."""
        arrivals = (file.stat().st_mtime_ns for file in (self._folder / "newest").iterdir())
        return min(max(arrivals, default=clock.wall_ns()), clock.wall_ns())

    def remove_unfinished(self) -> None:
        """Remove the uploads that a killed collector left. No other upload may be running."""
        for file in (self._folder / "incoming").iterdir():
            file.unlink()

    def check_space(self, size: int = 0) -> None:
        """Raise `StoreFullError` unless `size` bytes leave the reserve free."""
        free = shutil.disk_usage(self._folder).free
        if free - size < self._reserve:
            raise StoreFullError(
                errno.ENOSPC, f"{free} bytes are free, {self._reserve} are reserved", str(self._folder)
            )

    def incoming(self) -> IO[bytes]:
        return tempfile.NamedTemporaryFile(dir=self._folder / "incoming", delete=False)

    def path(self, place: SegmentPlace) -> Path:
        bucket = f"{place.number // _BUCKET:0{_DIGITS}}"
        name = f"{place.number:0{_DIGITS}}-{place.name}.ndjson.gz"
        return self._folder / "segments" / place.robot / place.log / bucket / name

    def has(self, place: SegmentPlace) -> bool:
        return self.path(place).exists() and self._readable(place) is not None

    def header(self, place: SegmentPlace) -> SegmentHeader:
        """Return a segment's header. Raise `OSError`, `zlib.error` or `ValueError` if it is unreadable."""
        return read_header(self.path(place))

    def _readable(self, place: SegmentPlace) -> SegmentHeader | None:
        try:
            return self.header(place)
        except _DAMAGED:
            self._touch("large", place)
            return None

    def headers(self, places: list[SegmentPlace]) -> list[SegmentHeader]:
        return [header for header in map(self._readable, places) if header is not None]

    def keep(self, robot: str, upload: Path, summary: SegmentSummary, size: int) -> SegmentPlace:
        """Store an upload of `size` uncompressed bytes durably, or raise `NotStorableError`."""
        header = summary.header
        place = SegmentPlace(robot, header.end.log, header.end.number, summary.name)
        path, now = self.path(place), self.latest_ns()
        os.utime(upload, ns=(now, now))
        sync(upload)
        with self._lock(robot):
            if not self.has(place):
                path.unlink(missing_ok=True)  # damaged
                self._check(place)
                self._make_folders(path.parent)
                self._mark(place, header, "large" if size > _LARGE_BYTES else "pending")
                os.link(upload, path)
            self._settle(place, header)
            self._note_newest(place)
        return place

    def _check(self, place: SegmentPlace) -> None:
        note = self.removal(place.robot, place.log)
        if note is not None and place.number <= note.number:
            raise NotStorableError(
                f"the segments up to {note.number} of this log were removed ({note.by}); if the robot was restored from"
                " an older copy, begin a new log: stop its appliance, move control/audit.db* of its state directory"
                " away, and start it"
            )
        if len(self.with_number(place.robot, place.log, place.number)) >= _MAX_FORKS:
            raise NotStorableError(f"{_MAX_FORKS} segments have the number {place.number}")
        bucket = self.path(place).parent
        for folder, most, what in ((bucket, _MAX_BUCKETS, "ranges"), (bucket.parent, _MAX_LOGS, "logs")):
            if not folder.exists() and len(_folders(folder.parent)) >= most:
                raise NotStorableError(
                    f"{folder.parent} has {most} {what}: remove those that are no longer needed"
                )

    def _note_newest(self, place: SegmentPlace) -> None:
        newest = self.newest(place.robot)
        file = self._folder / "newest" / place.robot
        now = self.latest_ns()
        if newest is not None and newest[1].log == place.log and newest[1].number > place.number:
            os.utime(file, ns=(now, now))
            return
        if newest is not None and newest[1].log != place.log:
            self._note_earlier(newest[1])
        making = self._folder / "incoming" / f"{place.robot}.newest"
        making.write_text(place.mark, encoding="ascii")
        os.utime(making, ns=(now, now))
        making.rename(file)

    def _note_earlier(self, last: SegmentPlace) -> None:
        """Note the last segment of a log before the robot's newest segment is one of another log."""
        earlier = self.earlier(last.robot)
        if earlier.get(last.log, 0) < last.number:
            content = msgspec.json.encode(earlier | {last.log: last.number})
            write_whole(self._folder / "earlier" / last.robot, content, 0o600)

    def earlier(self, robot: str) -> dict[str, int]:
        """Return the logs that the robot pushed before its present one, with their last segments' numbers."""
        file = self._folder / "earlier" / robot
        try:
            return msgspec.json.decode(file.read_bytes(), type=dict[str, int])
        except FileNotFoundError:
            return {}
        except ValueError as error:
            raise OSError(f"{file}: damaged: {error}; see what changed it, and remove it") from error

    def newest(self, robot: str) -> tuple[int, SegmentPlace] | None:
        try:
            with (self._folder / "newest" / robot).open(encoding="ascii", errors="replace") as file:
                match = _MARK.fullmatch(file.read())
                arrived = os.fstat(file.fileno()).st_mtime_ns
        except FileNotFoundError:
            return None
        return None if match is None else (arrived, _place(robot, match))

    def settle(self, place: SegmentPlace, header: SegmentHeader) -> None:
        """Complete the work of `keep` that a killed collector left."""
        with self._lock(place.robot):
            self._settle(place, header)
            newest = self.newest(place.robot)
            if newest is None or newest[0] < self.arrival_time(place):
                self._note_newest(place)

    def _settle(self, place: SegmentPlace, header: SegmentHeader) -> None:
        sync(self.path(place).parent)
        for following in self.with_number(place.robot, place.log, place.number + 1):
            found = self._readable(following)
            if found is not None and found.follows(header):
                self._unmark("gaps", following)

    def _make_folders(self, bucket: Path) -> None:
        for folder in (bucket.parent.parent, bucket.parent, bucket):
            if not folder.exists():
                make_folder(folder)
                sync(folder.parent)

    def _mark(self, place: SegmentPlace, header: SegmentHeader, waiting: str) -> None:
        if not self._follows_a_stored_one(place, header):
            self._touch("gaps", place)
        others = self.with_number(place.robot, place.log, place.number)
        for one in [*others, place] if others else []:
            self._touch("forks", one)
        self._touch(waiting, place)

    def _touch(self, kind: str, place: SegmentPlace) -> None:
        folder = self._folder / kind / place.robot
        for _attempt in range(_MAX_ATTEMPTS):
            if not folder.exists():
                make_folder(folder)
                sync(folder.parent)
            # `_unmark` may have just removed the empty folder.
            with contextlib.suppress(FileNotFoundError):
                (folder / place.mark).touch(mode=0o600)
                sync(folder)
                return
        raise OSError(errno.EAGAIN, "another thread removed the folder each time", str(folder))

    def _unmark(self, kind: str, place: SegmentPlace) -> bool:
        marker = self._folder / kind / place.robot / place.mark
        try:
            marker.unlink()
        except FileNotFoundError:
            return False
        with contextlib.suppress(OSError):  # other markers are in it
            marker.parent.rmdir()
        return True

    def _follows_a_stored_one(self, place: SegmentPlace, header: SegmentHeader) -> bool:
        if place.number == 1 or (header.begin is None and self.head(place.robot, place.log) is None):
            return True
        note = self.removal(place.robot, place.log)
        ends = note.ends if note is not None and note.number == place.number - 1 else []
        before = self.with_number(place.robot, place.log, place.number - 1)
        return any(map(header.follows, ends)) or any(
            found is None or header.follows(found) for found in map(self._readable, before)
        )

    def with_number(self, robot: str, log: str, number: int) -> list[SegmentPlace]:
        """Return the segments with a number: at most one, unless the robot signed two histories."""
        bucket = self.path(SegmentPlace(robot, log, number, "")).parent
        return [one for one in _in_bucket(robot, log, bucket) if one.number == number]

    def head(self, robot: str, log: str, upto: int = 10**_DIGITS - 1) -> SegmentPlace | None:
        last = f"{upto // _BUCKET:0{_DIGITS}}"
        for bucket in reversed(_folders(self._folder / "segments" / robot / log)):
            if bucket.name > last:
                continue
            found = [one for one in _in_bucket(robot, log, bucket) if one.number <= upto]
            if found:
                return found[-1]
        return None

    def logs(self, robot: str) -> list[str]:
        return [one.name for one in _folders(self._folder / "segments" / robot) if _LOG.fullmatch(one.name)]

    def segments(self, robot: str, log: str) -> Iterator[SegmentPlace]:
        for bucket in _folders(self._folder / "segments" / robot / log):
            yield from _in_bucket(robot, log, bucket)

    def arrival_time(self, place: SegmentPlace) -> int:
        """Return the time of arrival in nanoseconds since the epoch."""
        return self.path(place).stat().st_mtime_ns

    def marks(self, kind: str, robot: str, most: int) -> list[SegmentPlace]:
        marks = []
        with contextlib.suppress(FileNotFoundError), os.scandir(self._folder / kind / robot) as entries:
            for entry in entries:
                match = _MARK.fullmatch(entry.name)
                if match is not None:
                    marks.append(_place(robot, match))
                if len(marks) == most:
                    break
        return marks

    def robots_with(self, kind: str) -> list[str]:
        return sorted(os.listdir(self._folder / kind))  # noqa: PTH208  names, not paths

    def waiting(self, most: int = 1000) -> int:
        found = set[SegmentPlace]()  # those that are tried again have two markers
        for kind in ("pending", "large", "damaged"):
            for robot in self.robots_with(kind):
                found.update(self.marks(kind, robot, most))
                if len(found) >= most:
                    return most
        return len(found)

    def all_wait(self) -> bool:
        """Return whether each segment waits for the index, as after the start of a new collector."""
        return all(
            any(
                (self._folder / kind / robot.name / segment.mark).exists()
                for kind in ("pending", "large", "damaged")
            )
            for robot in _folders(self._folder / "segments")
            for log in self.logs(robot.name)
            for segment in self.segments(robot.name, log)
        )

    def mark_indexed(self, place: SegmentPlace) -> None:
        for kind in ("pending", "large", "damaged"):
            self._unmark(kind, place)

    def stamp(self, place: SegmentPlace) -> FileStamp | None:
        try:
            found = self.path(place).stat()
        except FileNotFoundError:
            return None
        return found.st_ino, found.st_size, found.st_mtime_ns

    def set_aside(self, place: SegmentPlace, stamp: FileStamp | None) -> bool:
        """Mark a segment as damaged. Return False if the file with this stamp was replaced since."""
        with self._lock(place.robot):
            if self.stamp(place) != stamp:
                return False
            self._touch("damaged", place)
            for kind in ("pending", "large"):
                self._unmark(kind, place)
            return True

    def try_again(self) -> None:
        """Let the damaged segments wait for the index again. They stay marked as damaged."""
        for robot in self.robots_with("damaged"):
            for place in self.marks("damaged", robot, sys.maxsize):
                self._touch("large", place)

    def forget_absent(self, place: SegmentPlace) -> None:
        """Remove the index's markers of a segment if a crash came before it was stored. The robot pushes it again."""
        with self._lock(place.robot):  # `keep` writes the marker before the segment
            if not self.path(place).exists():
                self.mark_indexed(place)

    def removal(self, robot: str, log: str) -> RemovalNote | None:
        try:
            return read_stored(self._note(robot, log), RemovalNote)
        except FileNotFoundError:
            return None

    def _note(self, robot: str, log: str) -> Path:
        return self._folder / "removed" / robot / f"{log}.json"

    def prune(self, robot: str, log: str, before: int, by: str) -> int:
        """Remove the segments at the beginning of a log that arrived before a time (ns), and return their number.

        Segments dated in the future are removed with those after them. A segment that is not in the index yet stays
        with all later ones, and so does the last segment of a log. Also raise `zlib.error` and `ValueError`.
        """
        with self._lock(robot):
            note = self.removal(robot, log)
            if note is not None:  # a crash may have left some of the noted segments
                self._remove(self._up_to(robot, log, note.number))
            old = self._old(robot, log, before)
            if not old:
                return 0
            last = [one for one in old if one.number == old[-1].number]
            gaps, forks = (
                sum((self._folder / kind / robot / one.mark).exists() for one in old)
                for kind in ("gaps", "forks")
            )
            made = RemovalNote(
                ends=[self.header(one) for one in last], time=clock.wall_ns(), by=by,
                segments=len(old) + (note.segments if note else 0), gaps=gaps + (note.gaps if note else 0),
                forks=forks + (note.forks if note else 0),
            )  # fmt: skip
            file = self._note(robot, log)
            make_folder(file.parent)
            sync(file.parent.parent)
            write_whole(file, msgspec.json.encode(made), 0o600)
            self._remove(old)
            return len(old)

    def _old(self, robot: str, log: str, before: int) -> list[SegmentPlace]:
        head, now = self.head(robot, log), self.time_ns()
        found: list[SegmentPlace] = []
        last = 0
        for place in self.segments(robot, log):
            waits = any((self._folder / kind / robot / place.mark).exists() for kind in ("pending", "large"))
            arrived = self.arrival_time(place)
            if head is None or place.number >= head.number or waits or before <= arrived <= now:
                last = min(last, place.number - 1)
                break
            found.append(place)
            if arrived < before:
                last = place.number
        return [one for one in found if one.number <= last]

    def _up_to(self, robot: str, log: str, number: int) -> list[SegmentPlace]:
        return list(itertools.takewhile(lambda one: one.number <= number, self.segments(robot, log)))

    def _remove(self, places: list[SegmentPlace]) -> None:
        for place in places:
            for kind in _KINDS:
                self._unmark(kind, place)
            self.path(place).unlink()
        for bucket in {self.path(place).parent for place in places}:
            with contextlib.suppress(OSError):  # it has others
                bucket.rmdir()


def _place(robot: str, mark: re.Match[str]) -> SegmentPlace:
    return SegmentPlace(robot, mark[1], int(mark[2]), mark[3])


def _folders(folder: Path) -> list[Path]:
    """Return the folders in a folder without a system call for each, as there may be thousands."""
    try:
        with os.scandir(folder) as entries:
            return [folder / name for name in sorted(entry.name for entry in entries if entry.is_dir())]
    except FileNotFoundError:
        return []


def _in_bucket(robot: str, log: str, bucket: Path) -> list[SegmentPlace]:
    try:
        names = sorted(os.listdir(bucket))  # noqa: PTH208  names, not paths
    except (FileNotFoundError, NotADirectoryError):  # retention may have just removed it
        return []
    found = [match for match in map(_FILE.fullmatch, names) if match is not None]
    return [SegmentPlace(robot, log, int(match[1]), match[2]) for match in found]


def sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
