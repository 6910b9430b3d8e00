"""Read the recorder's bags by their index, so that only the needed parts of a large bag are read.

Times are nanoseconds since the epoch. A file that is not a complete bag of the recorder raises `ValueError`.
"""

import heapq
import re
import struct
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, NamedTuple, Self

from appliance.features.recorder.bag_writer import (
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
_PLACE = re.compile(r"\d{6,20}-\d{1,12}-\d{1,12}", re.ASCII)  # does not match any date
_U32, _U64, _STAMP = struct.Struct("<I"), struct.Struct("<Q"), struct.Struct("<II")


class MessagePosition(NamedTuple):
    """The position of a message: `chunk` is an offset in the file, `offset` in the chunk."""

    time: int
    chunk: int
    offset: int

    @classmethod
    def parse(cls, text: str) -> Self | None:
        return cls(*map(int, text.split("-"))) if _PLACE.fullmatch(text) else None

    def __str__(self) -> str:
        return "-".join(map(repr, self))


class Chunk(NamedTuple):
    """The times of the first and last message, and the chunk's offset in the file."""

    first: int
    last: int
    place: int


class BagReader:
    """An open bag: `connections` by number, and `chunks` in the order of their first times."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.connections: dict[int, Mapping[str, str]] = {}
        self.chunks: list[Chunk] = []
        if file.read(len(MAGIC)) != MAGIC:
            raise ValueError("not a bag of format 2.0")
        head = read_fields(file)
        self._end = _U64.unpack(head["index_pos"])[0]
        if head["op"] != BAG or not self._end:
            raise ValueError("the bag has no index: it was not closed")
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
        """Open a bag. Raise `OSError` or `ValueError`, even while the bag is read in the block."""
        with path.open("rb") as file:
            try:
                yield cls(file)
            except (struct.error, LookupError) as error:
                raise ValueError(f"not a bag that the recorder wrote: {error!r}") from None

    def index(self, chunk: Chunk) -> Iterator[tuple[int, bytes]]:
        self._file.seek(chunk.place)
        if read_fields(self._file)["op"] != CHUNK:
            raise ValueError("a chunk is not at the offset in the index")
        self._file.seek(_U32.unpack(self._file.read(4))[0], 1)
        while self._file.tell() < self._end:
            fields = read_fields(self._file)
            data = self._file.read(_U32.unpack(self._file.read(4))[0])
            if fields["op"] != INDEX:
                return
            after = self._file.tell()
            yield _U32.unpack(fields["conn"])[0], data
            self._file.seek(after)

    def places(self, chunk: Chunk, connections: Collection[int]) -> Iterator[tuple[MessagePosition, int]]:
        for number, entries in self.index(chunk):
            if number in connections:
                for seconds, nanoseconds, offset in INDEX_ENTRY.iter_unpack(entries):
                    yield MessagePosition(seconds * _SECOND + nanoseconds, chunk.place, offset), number

    def messages(self, connections: Collection[int], since: int = 0) -> Iterator[tuple[MessagePosition, int]]:
        waiting: list[tuple[MessagePosition, int]] = []
        for chunk in (chunk for chunk in self.chunks if chunk.last >= since):
            while waiting and waiting[0][0].time < chunk.first:
                yield heapq.heappop(waiting)
            for found in self.places(chunk, connections):
                if found[0].time >= since:
                    heapq.heappush(waiting, found)
        while waiting:
            yield heapq.heappop(waiting)

    def before(
        self, position: MessagePosition, connections: Collection[int], most: int
    ) -> list[tuple[MessagePosition, int]]:
        found: list[tuple[MessagePosition, int]] = []
        for chunk in sorted(self.chunks, key=lambda chunk: -chunk.last):
            if len(found) == most and chunk.last < found[-1][0].time:
                break
            if chunk.first <= position.time:
                earlier = (entry for entry in self.places(chunk, connections) if entry[0] < position)
                found = heapq.nlargest(most, [*found, *earlier])
        return found[::-1]

    def body(self, position: MessagePosition, most: int) -> tuple[int, bytes]:
        self._file.seek(position.chunk)
        read_fields(self._file)
        self._file.seek(4 + position.offset, 1)
        read_fields(self._file)
        size = _U32.unpack(self._file.read(4))[0]
        return size, self._file.read(min(size, most))

    def _record(self, op: bytes) -> tuple[dict[str, bytes], bytes]:
        fields = read_fields(self._file)
        if fields["op"] != op:
            raise ValueError("the index of the bag is not in order")
        return fields, self._file.read(_U32.unpack(self._file.read(4))[0])


def _time(stamp: bytes) -> int:
    seconds, nanoseconds = _STAMP.unpack(stamp)
    return int(seconds) * _SECOND + int(nanoseconds)
