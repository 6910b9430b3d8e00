"""Store segments as files, before anything else knows of them.

    segments/ROBOT/LOG/BUCKET/NUMBER-NAME.ndjson.gz    a segment; a bucket has a thousand numbers
    pending/ROBOT~LOG~NUMBER~NAME                      the same file (a link): the index does not have it yet
    gaps/ROBOT~LOG~NUMBER~NAME                         the segment does not follow a stored one
    forks/ROBOT~LOG~NUMBER~NAME                        another segment has the same number
    incoming/                                          uploads that are not verified

Invariants:
1. A stored segment was verified, and is on the disk with its folder before `keep` returns. It never changes.
2. A crash leaves a segment either stored or absent. What refers to it is written first, and repaired by `keep`.
3. The state that uploads need is in names: no database, and no memory that grows with the number of segments.
"""

import errno
import gzip
import os
import re
import shutil
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import IO, NamedTuple

import msgspec

from appliance.audit.segments import LONGEST_LINE, SegmentHeader, SegmentSummary
from rosrv_fleet.robots import make_folder

_BUCKET = 1000
_DIGITS = 18
_LOG = re.compile("[0-9a-f]{32}")
_FILE = re.compile(r"(\d{18})-([0-9a-f]{64})\.ndjson\.gz")
_MARK = re.compile(r"([a-z0-9._-]+)~([0-9a-f]{32})~(\d{18})~([0-9a-f]{64})")


class StoreFullError(OSError):
    """The disk has too little free space for more segments."""


class SegmentPlace(NamedTuple):
    """The place of a segment: robot, log, the number of its checkpoint, and its name."""

    robot: str
    log: str
    number: int
    name: str

    @property
    def mark(self) -> str:
        """Return the name of its markers."""
        return f"{self.robot}~{self.log}~{self.number:0{_DIGITS}}~{self.name}"


class SegmentStore:
    """The segments of a collector, in a folder. Thread-safe; one process writes."""

    def __init__(self, folder: Path, reserve: int) -> None:
        """Prepare the folders, and remove unfinished uploads. `reserve` bytes of the disk stay free."""
        self._folder = folder
        self._reserve = reserve
        self._lock = threading.Lock()
        for name in ("segments", "pending", "gaps", "forks", "incoming"):
            make_folder(folder / name)

    def remove_unfinished(self) -> None:
        """Remove the uploads that a killed collector left; no other may run."""
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
        """Return a new file for an upload; the caller closes and removes it."""
        return tempfile.NamedTemporaryFile(dir=self._folder / "incoming", delete=False)

    def path(self, place: SegmentPlace) -> Path:
        """Return the path of a segment."""
        bucket = f"{place.number // _BUCKET:0{_DIGITS}}"
        name = f"{place.number:0{_DIGITS}}-{place.name}.ndjson.gz"
        return self._folder / "segments" / place.robot / place.log / bucket / name

    def has(self, place: SegmentPlace) -> bool:
        """Whether the segment is stored."""
        return self.path(place).exists()

    def header(self, place: SegmentPlace) -> SegmentHeader:
        """Return the header of a stored segment. Raises `OSError`, `EOFError` and `msgspec.MsgspecError`."""
        with gzip.open(self.path(place)) as file:
            return msgspec.json.decode(file.readline(LONGEST_LINE), type=SegmentHeader)

    def keep(self, robot: str, upload: Path, summary: SegmentSummary) -> SegmentPlace:
        """Store a verified upload; when this returns, the segment is on the disk. Raises `OSError`."""
        header = summary.header
        place = SegmentPlace(robot, header.end.log, header.end.number, summary.name)
        path = self.path(place)
        _sync(upload)
        with self._lock:
            if not path.exists():
                self._make_folders(path.parent)
                self._mark(place, header)
                os.link(upload, path)
            self._settle(place, header)
        return place

    def settle(self, place: SegmentPlace, header: SegmentHeader) -> None:
        """Complete a stored segment that a killed collector may have left half done. Raises `OSError`."""
        with self._lock:
            self._settle(place, header)

    def _settle(self, place: SegmentPlace, header: SegmentHeader) -> None:
        _sync(self.path(place).parent)
        for following in self.numbered(place.robot, place.log, place.number + 1):
            if self.header(following).follows(header):
                (self._folder / "gaps" / following.mark).unlink(missing_ok=True)

    def _make_folders(self, bucket: Path) -> None:
        for folder in (bucket.parent.parent, bucket.parent, bucket):
            if not folder.exists():
                make_folder(folder)
                _sync(folder.parent)

    def _mark(self, place: SegmentPlace, header: SegmentHeader) -> None:
        """Write the markers that the segment needs, on the disk."""
        if not self._follows_a_stored_one(place, header):
            self._touch("gaps", place)
        for other in self.numbered(place.robot, place.log, place.number):
            for one in (other, place):
                self._touch("forks", one)
        self._touch("pending", place)

    def _touch(self, kind: str, place: SegmentPlace) -> None:
        (self._folder / kind / place.mark).touch(mode=0o600)
        _sync(self._folder / kind)

    def _follows_a_stored_one(self, place: SegmentPlace, header: SegmentHeader) -> bool:
        if place.number == 1 or (header.begin is None and self.head(place.robot, place.log) is None):
            return True
        before = self.numbered(place.robot, place.log, place.number - 1)
        return any(header.follows(self.header(one)) for one in before)

    def numbered(self, robot: str, log: str, number: int) -> list[SegmentPlace]:
        """Return the stored segments with this number: one, unless the robot signed two histories."""
        bucket = self.path(SegmentPlace(robot, log, number, "")).parent
        return [one for one in _in_bucket(robot, log, bucket) if one.number == number]

    def head(self, robot: str, log: str, upto: int = 10**_DIGITS - 1) -> SegmentPlace | None:
        """Return the stored segment of a log with the largest number up to `upto`, or None."""
        last = f"{upto // _BUCKET:0{_DIGITS}}"
        for bucket in reversed(_folders(self._folder / "segments" / robot / log)):
            if bucket.name > last:
                continue
            found = [one for one in _in_bucket(robot, log, bucket) if one.number <= upto]
            if found:
                return found[-1]
        return None

    def logs(self, robot: str) -> list[str]:
        """Return the logs of which a robot has segments."""
        return [one.name for one in _folders(self._folder / "segments" / robot) if _LOG.fullmatch(one.name)]

    def segments(self, robot: str, log: str) -> Iterator[SegmentPlace]:
        """Yield the stored segments of a log, by number."""
        for bucket in _folders(self._folder / "segments" / robot / log):
            yield from _in_bucket(robot, log, bucket)

    def received(self, place: SegmentPlace) -> int:
        """Return when the segment arrived, in nanoseconds since the epoch. Raises `OSError`."""
        return self.path(place).stat().st_mtime_ns

    def marked(self, kind: str, most: int) -> list[SegmentPlace]:
        """Return at most `most` segments with markers of a kind (`pending`, `gaps`, `forks`), in any order."""
        found = []
        with os.scandir(self._folder / kind) as entries:
            for entry in entries:
                match = _MARK.fullmatch(entry.name)
                if match is not None:
                    found.append(SegmentPlace(match[1], match[2], int(match[3]), match[4]))
                if len(found) == most:
                    break
        return found

    def indexed(self, place: SegmentPlace) -> None:
        """Note that the index has a segment."""
        (self._folder / "pending" / place.mark).unlink(missing_ok=True)

    def forget_absent(self, place: SegmentPlace) -> None:
        """Remove the marker of a segment that a crash left unstored; the robot pushes it again."""
        with self._lock:  # `keep` writes the marker before the segment
            if not self.has(place):
                self.indexed(place)

    def wait_for_index(self, place: SegmentPlace) -> None:
        """Mark a stored segment for the index again. Raises `OSError`."""
        self._touch("pending", place)


def _folders(folder: Path) -> list[Path]:
    return sorted(one for one in folder.iterdir() if one.is_dir()) if folder.is_dir() else []


def _in_bucket(robot: str, log: str, bucket: Path) -> list[SegmentPlace]:
    names = sorted(os.listdir(bucket)) if bucket.is_dir() else []  # noqa: PTH208  names, not paths
    found = [match for match in map(_FILE.fullmatch, names) if match is not None]
    return [SegmentPlace(robot, log, int(match[1]), match[2]) for match in found]


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
