"""Reads bags that the recorder wrote: by their index, so that of a large bag only what is asked for is read.

Times are nanoseconds since the epoch. The order of messages is that of their places: by time, then by where they stand
in the file. What is no whole bag of the recorder is a `ValueError`.
"""

import heapq
import re
import struct
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, NamedTuple, Self

from appliance.recorder.bag_writer import (
    BAG,
    CHUNK,
    CHUNK_INFO,
    CONNECTION,
    INDEX,
    INDEX_ENTRY,
    MAGIC,
    fields_of,
    read_fields,
)

_SECOND = 1_000_000_000
_PLACE = re.compile(r"\d{6,20}-\d{1,12}-\d{1,12}", re.ASCII)  # no date, of no calendar
_U32, _U64, _STAMP = struct.Struct("<I"), struct.Struct("<Q"), struct.Struct("<II")


class Place(NamedTuple):
    """Where a message is: its time, the place of its chunk in the file, and its own in the chunk."""

    time: int
    chunk: int
    offset: int

    @classmethod
    def parsed(cls, text: str) -> Self | None:
        """From its text (`str`); None when it is none."""
        return cls(*map(int, text.split("-"))) if _PLACE.fullmatch(text) else None

    def __str__(self) -> str:
        return "-".join(map(repr, self))


class Chunk(NamedTuple):
    """A chunk: the times of its first and last message, and its place in the file."""

    first: int
    last: int
    place: int


class BagReader:
    """What a bag has: the headers of its `connections` by number, and its `chunks` by their first times."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.connections: dict[int, Mapping[str, str]] = {}
        self.chunks: list[Chunk] = []
        if file.read(len(MAGIC)) != MAGIC:
            raise ValueError("this is no bag of format 2.0")
        head = read_fields(file)
        self._end = _U64.unpack(head["index_pos"])[0]
        if head["op"] != BAG or not self._end:
            raise ValueError("this bag has no index: it was not closed")
        file.seek(self._end)
        for _connection in range(_U32.unpack(head["conn_count"])[0]):
            fields, data = self._record(CONNECTION)
            self.connections[_U32.unpack(fields["conn"])[0]] = {
                name: value.decode("utf-8", "surrogateescape") for name, value in fields_of(data).items()
            }
        for _chunk in range(_U32.unpack(head["chunk_count"])[0]):
            fields, _counts = self._record(CHUNK_INFO)
            times = (_time(fields["start_time"]), _time(fields["end_time"]))
            self.chunks.append(Chunk(*times, _U64.unpack(fields["chunk_pos"])[0]))
        self.chunks.sort()

    @classmethod
    @contextmanager
    def of(cls, path: Path) -> Iterator[Self]:
        """The bag in a file. Raises `OSError` and `ValueError`, also while it is read."""
        with path.open("rb") as file:
            try:
                yield cls(file)
            except (struct.error, LookupError) as error:
                raise ValueError(f"this is no bag that the recorder wrote: {error!r}") from None

    def index(self, chunk: Chunk) -> Iterator[tuple[int, bytes]]:
        """The entries of a chunk (`INDEX_ENTRY`: seconds, nanoseconds, offset) by the number of their connection."""
        self._file.seek(chunk.place)
        if read_fields(self._file)["op"] != CHUNK:
            raise ValueError("a chunk is not where the index has it")
        self._file.seek(_U32.unpack(self._file.read(4))[0], 1)
        while self._file.tell() < self._end:
            fields = read_fields(self._file)
            data = self._file.read(_U32.unpack(self._file.read(4))[0])
            if fields["op"] != INDEX:
                return
            after = self._file.tell()
            yield _U32.unpack(fields["conn"])[0], data
            self._file.seek(after)

    def places(self, chunk: Chunk, connections: Collection[int]) -> Iterator[tuple[Place, int]]:
        """Where the messages of these connections are in a chunk, each with its connection."""
        for number, entries in self.index(chunk):
            if number in connections:
                for seconds, nanoseconds, offset in INDEX_ENTRY.iter_unpack(entries):
                    yield Place(seconds * _SECOND + nanoseconds, chunk.place, offset), number

    def messages(self, connections: Collection[int], since: int = 0) -> Iterator[tuple[Place, int]]:
        """Where the messages of these connections are from a time on, in their order."""
        waiting: list[tuple[Place, int]] = []
        for chunk in (chunk for chunk in self.chunks if chunk.last >= since):
            while waiting and waiting[0][0].time < chunk.first:
                yield heapq.heappop(waiting)
            for found in self.places(chunk, connections):
                if found[0].time >= since:
                    heapq.heappush(waiting, found)
        while waiting:
            yield heapq.heappop(waiting)

    def before(self, place: Place, connections: Collection[int], most: int) -> list[tuple[Place, int]]:
        """The last messages of these connections before a place, in their order."""
        found: list[tuple[Place, int]] = []
        for chunk in sorted(self.chunks, key=lambda chunk: -chunk.last):
            if len(found) == most and chunk.last < found[-1][0].time:
                break
            if chunk.first <= place.time:
                earlier = (entry for entry in self.places(chunk, connections) if entry[0] < place)
                found = heapq.nlargest(most, [*found, *earlier])
        return found[::-1]

    def body(self, place: Place, most: int) -> tuple[int, bytes]:
        """How many bytes a message has, and the first of them."""
        self._file.seek(place.chunk)
        read_fields(self._file)
        self._file.seek(4 + place.offset, 1)
        read_fields(self._file)
        size = _U32.unpack(self._file.read(4))[0]
        return size, self._file.read(min(size, most))

    def _record(self, op: bytes) -> tuple[dict[str, bytes], bytes]:
        fields = read_fields(self._file)
        if fields["op"] != op:
            raise ValueError("the index of this bag is not in its order")
        return fields, self._file.read(_U32.unpack(self._file.read(4))[0])


def _time(stamp: bytes) -> int:
    seconds, nanoseconds = _STAMP.unpack(stamp)
    return int(seconds) * _SECOND + int(nanoseconds)
