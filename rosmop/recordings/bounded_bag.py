"""Read a ROS 1 bag in time linear in its size, even if it is malicious, and in memory independent of its length.

`rosbags` trusts the headers of a bag, and holds the index of all messages. This reader holds the index only
of chunks whose times overlap (the flight recorder writes such chunks), and adds limits:

1. It reads at most `LARGEST_CHUNK` bytes at once, and unpacks a chunk to at most that size.
2. It unpacks and reads at most `PER_BYTE` bytes for each byte of the bag, plus one chunk. Otherwise, index entries
could name one message many times, or unpack many chunks in turn.
3. The index has at most as many entries as fit in the bag, so chunks cannot share an index.
"""

import bz2
import heapq
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator
from io import SEEK_CUR, BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import lz4.frame
from rosbags.interfaces import Connection, ConnectionExtRosbag1, MessageDefinition, MessageDefinitionFormat
from rosbags.rosbag1 import Reader, ReaderError
from rosbags.rosbag1.reader import (
    Chunk,
    ChunkInfo,
    Header,
    IndexData,
    RecordType,
    decompressors,
    normalize,
    read_bytes,
    read_uint32,
)
from rosbags.typesys.msg import normalize_msgtype

from rosmop.recordings import regular_files

PER_BYTE = 256
_HEADER, _ENTRY = 55, 12  # bytes of a chunk's index of one connection, and of each entry
_UNPACKERS: dict[Callable[[bytes], bytes], Callable[[], Any]] = {
    decompressors["bz2"]: bz2.BZ2Decompressor,
    decompressors["lz4"]: lz4.frame.LZ4FrameDecompressor,
}
_Entry = tuple[int, int, int]  # nanoseconds, offset of the chunk in the file, offset in the chunk


class _Content(NamedTuple):
    file: BinaryIO
    begin: int
    end: int


class BoundedReader(Reader):
    """A bag, read within the limits above. Beyond them it raises `ReaderError` or `ValueError`."""

    def __init__(self, path: Path) -> None:
        super().__init__(regular_files.BoundedPath(path))
        self._size = path.stat().st_size
        self._left = PER_BYTE * self._size + regular_files.LARGEST_CHUNK
        self.hosts: dict[int, str] = {}
        """The host of each connection by its id, if the flight recorder wrote it."""
        self.dropped: set[int] = set()
        """The ids of connections whose messages no monitor got, as the flight recorder wrote."""
        self._entries = 0
        self._unread = Counter[
            int
        ]()  # for each chunk, the number of index entries whose messages were not read yet
        self._unpacked = OrderedDict[int, _Content]()  # the latest used one is the last
        self._unpacked_size = 0

    @property
    def message_count(self) -> int:
        return sum(self.message_counts.values())

    @property
    def message_counts(self) -> Counter[int]:
        """Count the messages of each connection, by its id."""
        counts = Counter[int]()
        for info in self.chunk_infos:
            counts.update(info.connection_counts)
        return counts

    def read_connection(self) -> Connection:
        """Read a connection; bytes outside UTF-8, as in names and comments of old nodes, become U+FFFD."""
        assert self.bio is not None  # noqa: S101  the reader is open
        number = (record := Header.read(self.bio, RecordType.CONNECTION)).get_uint32("conn")
        header = Header.read(self.bio)
        for fields in (record, header):
            fields.update({name: data.decode("utf-8", "replace").encode() for name, data in fields.items()})
        latching = int(header["latching"] == b"1") if "latching" in header else None
        if "host" in header:
            self.hosts[number] = header.get_string("host")
        if header.get("carried") == b"0":
            self.dropped.add(number)
        caller = header.get_string("callerid") if "callerid" in header else None
        text = MessageDefinition(MessageDefinitionFormat.MSG, header.get_string("message_definition"))
        topic, kind = record.get_string("topic"), normalize_msgtype(header.get_string("type"))
        sender = ConnectionExtRosbag1(caller, latching)
        return Connection(number, normalize(topic), kind, text, header.get_string("md5sum"), 0, sender, self)

    def read_index_data(self, pos: int, indexes: dict[int, list[IndexData]]) -> None:
        """Do nothing: `in_order` reads the index of a chunk when its time has come."""

    def in_order(self) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield connection, time (ns) and bytes of messages, by time, then by position in the file."""
        connections = {connection.id: connection for connection in self.connections}
        self._entries = 0
        self._unread.clear()
        waiting: list[_Entry] = []
        infos = sorted(self.chunk_infos, key=lambda info: (info.start_time, info.pos))
        nexts = [*(info.start_time for info in infos), 1 << 63][1:]
        for info, following in zip(infos, nexts, strict=True):
            entries = self._index(info)
            self._unread[info.pos] += len(entries)
            for entry in entries:
                heapq.heappush(waiting, entry)
            while waiting and waiting[0][0] < following:
                time, place, offset = heapq.heappop(waiting)
                number, data = self._message(place, offset, time)
                yield connections[number], time, data

    def _message(self, place: int, offset: int, time: int) -> tuple[int, bytes]:
        file, begin, end = self._content(place)
        file.seek(begin + offset)
        while (header := Header.read(file)).get_uint8("op") == RecordType.CONNECTION:
            self._charge(file.seek(read_uint32(file), SEEK_CUR) - begin - offset)
        if header.get_uint8("op") != RecordType.MSGDATA or header.get_time("time") != time:
            raise ReaderError("its index does not fit its messages.")
        data = read_bytes(file, read_uint32(file))
        if file.tell() > end:
            raise ReaderError("a message goes beyond its chunk.")
        self._charge(file.tell() - begin - offset)
        self._unread[place] -= 1
        if not self._unread[place] and place in self._unpacked:
            self._unpacked_size -= self._unpacked.pop(place).end
        return header.get_uint32("conn"), data

    def _index(self, info: ChunkInfo) -> list[_Entry]:
        assert self.bio is not None  # noqa: S101  the reader is open
        chunk = self.chunks[info.pos]
        self.bio.seek(chunk.datapos + chunk.datasize)
        found: dict[int, list[IndexData]] = {number: [] for number in info.connection_counts}
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

    def _content(self, place: int) -> _Content:
        assert self.bio is not None  # noqa: S101  the reader is open
        chunk = self.chunks[place]
        if chunk.decompressor not in _UNPACKERS:
            return _Content(self.bio, chunk.datapos, chunk.datapos + chunk.datasize)
        if place in self._unpacked:
            self._unpacked.move_to_end(place)
            return self._unpacked[place]
        content = self._unpacked[place] = self._unpack(chunk)
        self._charge(content.end)
        self._unpacked_size += content.end
        while self._unpacked_size > regular_files.LARGEST_CHUNK:
            _place, oldest = self._unpacked.popitem(last=False)
            self._unpacked_size -= oldest.end
        return content

    def _unpack(self, chunk: Chunk) -> _Content:
        assert self.bio is not None  # noqa: S101  the reader is open
        self.bio.seek(chunk.datapos)
        unpacker = _UNPACKERS[chunk.decompressor]()
        data = unpacker.decompress(read_bytes(self.bio, chunk.datasize), regular_files.LARGEST_CHUNK)
        if not unpacker.eof:
            more = f"a chunk unpacks to more than {regular_files.LARGEST_CHUNK} bytes."
            raise ReaderError("a chunk is cut off." if unpacker.needs_input else more)
        return _Content(BytesIO(data), 0, len(data))

    def _charge(self, count: int) -> None:
        self._left -= count
        if self._left < 0:
            raise ReaderError(f"it unpacks to more than {PER_BYTE} times its size.")
