"""Read a ROS 1 bag in time linear in its size, even if the bag is malicious, and in memory independent of its length.

`rosbags` trusts the headers of a bag, and keeps the index of all messages. This reader keeps the index of one chunk, or
of chunks whose times overlap, and adds limits:

1. It reads at most `LARGEST_CHUNK` bytes at once, and unpacks a chunk to at most that size.
2. It unpacks and reads at most `PER_BYTE` bytes for each byte of the bag, plus one chunk. Without this limit, index
   entries could name one message many times, or unpack two chunks in turn.
3. The index has at most as many entries as fit in the bag, so chunks cannot share an index.
"""

import bz2
import heapq
from collections.abc import Callable, Iterator
from io import SEEK_CUR, BytesIO
from pathlib import Path
from typing import Any

import lz4.frame
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader, ReaderError
from rosbags.rosbag1.reader import (
    ChunkInfo,
    Header,
    IndexData,
    RecordType,
    decompressors,
    read_bytes,
    read_uint32,
)

from rosmop.recordings import regular_files

PER_BYTE = 256
_HEADER, _ENTRY = 55, 12  # bytes of a chunk's index of one connection, and of each entry
_UNPACKERS: dict[Callable[[bytes], bytes], Callable[[], Any]] = {
    decompressors["bz2"]: bz2.BZ2Decompressor,
    decompressors["lz4"]: lz4.frame.LZ4FrameDecompressor,
}
_Entry = tuple[int, int, int]  # nanoseconds, offset of the chunk in the file, offset in the chunk


class BoundedReader(Reader):
    """The reader of `rosbags`; raises `ReaderError` and `ValueError` beyond a limit."""

    def __init__(self, path: Path) -> None:
        super().__init__(regular_files.BoundedPath(path))
        self._size = path.stat().st_size
        self._left = PER_BYTE * self._size + regular_files.LARGEST_CHUNK
        self._entries = 0

    @property
    def message_count(self) -> int:
        """Return the number of messages that the headers of the chunks name."""
        return sum(sum(info.connection_counts.values()) for info in self.chunk_infos)

    def read_index_data(self, pos: int, indexes: dict[int, list[IndexData]]) -> None:
        """Skip the index of one connection in one chunk: `in_order` reads it when the chunk's time has come."""

    def in_order(self) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield connection, nanoseconds and bytes of every message: by time, then by position in the file."""
        connections = {connection.id: connection for connection in self.connections}
        self._entries = 0
        waiting: list[_Entry] = []
        here, content = -1, BytesIO()
        infos = sorted(self.chunk_infos, key=lambda info: (info.start_time, info.pos))
        nexts = [*(info.start_time for info in infos), 1 << 63][1:]
        for info, following in zip(infos, nexts, strict=True):
            for entry in self._index(info):
                heapq.heappush(waiting, entry)
            while waiting and waiting[0][0] < following:
                time, place, offset = heapq.heappop(waiting)
                if place != here:
                    here, content = place, BytesIO(self._content(place))
                content.seek(offset)
                while (header := Header.read(content)).get_uint8("op") == RecordType.CONNECTION:
                    self._charge(content.seek(read_uint32(content), SEEK_CUR) - offset)
                if header.get_uint8("op") != RecordType.MSGDATA or header.get_time("time") != time:
                    raise ReaderError("its index does not fit its messages.")
                data = read_bytes(content, read_uint32(content))
                self._charge(content.tell() - offset)
                yield connections[header.get_uint32("conn")], time, data

    def _index(self, info: ChunkInfo) -> list[_Entry]:
        """Return the index of a chunk, in the order of its connections."""
        assert self.bio is not None  # noqa: S101  the reader is open
        chunk = self.chunks[info.pos]
        self.bio.seek(chunk.datapos + chunk.datasize)
        found: dict[int, list[IndexData]] = {connection.id: [] for connection in self.connections}
        for _connection in info.connection_counts:
            begin = self.bio.tell()
            super().read_index_data(info.pos, found)
            self._entries += (self.bio.tell() - begin - _HEADER) // _ENTRY
            if self._entries * _ENTRY > self._size:
                raise ReaderError("its chunks share an index.")
        entries = [(entry.time, entry.chunk_pos, entry.offset) for row in found.values() for entry in row]
        if any(entry[0] < info.start_time for entry in entries):
            raise ReaderError("a chunk has messages before its first time.")
        return entries

    def _content(self, place: int) -> bytes:
        """Return an unpacked chunk."""
        assert self.bio is not None  # noqa: S101  the reader is open
        chunk = self.chunks[place]
        self.bio.seek(chunk.datapos)
        data = read_bytes(self.bio, chunk.datasize)
        if chunk.decompressor in _UNPACKERS:
            unpacker = _UNPACKERS[chunk.decompressor]()
            data = unpacker.decompress(data, regular_files.LARGEST_CHUNK)
            if not unpacker.eof:
                more = f"a chunk unpacks to more than {regular_files.LARGEST_CHUNK} bytes."
                raise ReaderError("a chunk is cut off." if unpacker.needs_input else more)
        self._charge(len(data))
        return data

    def _charge(self, count: int) -> None:
        self._left -= count
        if self._left < 0:
            raise ReaderError(f"it unpacks to more than {PER_BYTE} times its size.")
