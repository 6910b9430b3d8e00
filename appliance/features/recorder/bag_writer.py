"""Write ROS 1 bags (format 2.0) in pieces; after a crash, another writer can finish the bag.

`rosbags` can neither write an extra field (the host) into a connection's header nor continue a bag. Format:
http://wiki.ros.org/Bags/Format/2.0.
"""

import os
import struct
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO, NamedTuple

MAGIC = b"#ROSBAG V2.0\n"
_HEAD_SIZE = 4096
_FIRST = len(MAGIC) + _HEAD_SIZE
_U32, _U64 = struct.Struct("<I"), struct.Struct("<Q")
MESSAGE, BAG, INDEX, CHUNK, CHUNK_INFO, CONNECTION = (bytes([op]) for op in (2, 3, 4, 5, 6, 7))
INDEX_ENTRY = struct.Struct("<III")
_COUNT = struct.Struct("<II")
MESSAGE_SIZE = 46 + INDEX_ENTRY.size
"""The bytes that a message takes besides its body."""

_CHUNK_SIZE, _INFO_SIZE = 212, 108  # bytes for one connection, and bytes of them in the index
_BILLION = 1_000_000_000


class BagMessage(NamedTuple):
    """A message; `time` is nanoseconds since the epoch."""

    connection: int
    time: int
    body: bytes | memoryview


class BagWriter:
    """Writes a bag after the first `size` bytes of the file."""

    def __init__(self, path: Path, connections: Mapping[int, Mapping[str, str]], size: int = 0) -> None:
        self._connections = dict(connections)
        self._file: BinaryIO = path.open("r+b" if size and path.exists() else "w+b")
        whole = self._whole(size)
        self.lost = whole < size
        """Whether some of the first `size` bytes are missing or damaged, as after a power cut."""
        self._index = sum(map(len, self._chunk_infos(whole))) + sum(
            map(connection_size, connections.values())
        )
        self._file.truncate(whole)
        self._file.seek(whole)
        if not whole:
            self._file.write(MAGIC + _bag_header(0, 0, 0))

    @property
    def closed_size(self) -> int:
        """The bytes of the bag if it is closed now."""
        return self._file.tell() + self._index

    def connect(self, header: Mapping[str, str]) -> int:
        number = len(self._connections)
        self._index += connection_size(header)
        self._connections[number] = dict(header)
        return number

    def write(self, messages: Iterable[BagMessage]) -> int:
        chunk, index = bytearray(), dict[int, list[bytes]]()
        first, last = 1 << 63, 0
        for message in messages:
            if message.connection not in index:
                index[message.connection] = []
                chunk += self._connection(message.connection)
            stamp = divmod(message.time, _BILLION)
            index[message.connection].append(INDEX_ENTRY.pack(*stamp, len(chunk)))
            conn, time = _U32.pack(message.connection), struct.pack("<II", *stamp)
            chunk += _record({"op": MESSAGE, "conn": conn, "time": time}, message.body)
            first, last = min(first, message.time), max(last, message.time)
        if index:
            size = _U32.pack(len(chunk))
            self._file.write(_record({"op": CHUNK, "compression": b"none", "size": size}, chunk))
            for number, entries in index.items():
                fields = {"op": INDEX, "ver": _U32.pack(1), "conn": _U32.pack(number)}
                self._file.write(_record(fields | {"count": _U32.pack(len(entries))}, b"".join(entries)))
            self._index += _INFO_SIZE + _COUNT.size * len(index)
        self._file.flush()
        return self._file.tell()

    def leave(self) -> None:
        """Close without an index, so that another writer can continue."""
        with suppress(OSError):
            self._file.close()

    def close(self) -> None:
        with self._file:
            end = self._file.tell()
            infos = self._chunk_infos(end)
            self._file.seek(end)
            for number in self._connections:
                self._file.write(self._connection(number))
            for info in infos:
                self._file.write(info)
            self._file.seek(len(MAGIC))
            self._file.write(_bag_header(end, len(self._connections), len(infos)))

    def _connection(self, number: int) -> bytes:
        return _connection_record(number, self._connections[number])

    def _whole(self, size: int) -> int:
        whole, at, there = 0, _FIRST, self._file.seek(0, os.SEEK_END)
        try:
            for place, fields, length in self._records(min(size, there)):
                if fields["op"] == CHUNK:
                    whole = place
                at = self._file.tell() + length
        except (struct.error, ValueError, LookupError):
            return whole
        return size if at == size <= there else whole

    def _records(self, end: int) -> Iterator[tuple[int, dict[str, bytes], int]]:
        at = _FIRST
        while at < end:
            self._file.seek(at)
            fields = read_fields(self._file)
            size = _U32.unpack(self._file.read(4))[0]
            following = self._file.tell() + size
            yield at, fields, size
            at = following

    def _chunk_infos(self, end: int) -> list[bytes]:
        chunks: list[tuple[int, list[tuple[int, int]], list[tuple[int, int]]]] = []
        for at, fields, size in self._records(end):
            if fields["op"] == CHUNK:
                chunks.append((at, [], []))
            else:
                times = [(entry[0], entry[1]) for entry in INDEX_ENTRY.iter_unpack(self._file.read(size))]
                chunks[-1][1].append((_U32.unpack(fields["conn"])[0], len(times)))
                chunks[-1][2].extend((min(times), max(times)))
        # `rosbag info` reads the start from the first record and the end from the last.
        last = max((max(times) for _place, _counts, times in chunks), default=None)
        chunks.sort(key=lambda chunk: (max(chunk[2]) == last, min(chunk[2])))
        return [
            _record(
                {
                    "op": CHUNK_INFO,
                    "ver": _U32.pack(1),
                    "chunk_pos": _U64.pack(place),
                    "start_time": struct.pack("<II", *min(times)),
                    "end_time": struct.pack("<II", *max(times)),
                    "count": _U32.pack(len(counts)),
                },
                b"".join(_COUNT.pack(*count) for count in counts),
            )
            for place, counts, times in chunks
        ]


def connection_size(header: Mapping[str, str]) -> int:
    """Return the bytes that a connection takes in the index, and in each chunk with its messages."""
    return len(_connection_record(0, header))


def chunk_size(header: Mapping[str, str]) -> int:
    """Return the most bytes that a chunk of one connection takes besides its messages."""
    return _CHUNK_SIZE + _COUNT.size + 2 * connection_size(header)


def _connection_record(number: int, header: Mapping[str, str]) -> bytes:
    fields = {"op": CONNECTION, "conn": _U32.pack(number), "topic": header["topic"].encode()}
    return _record(
        fields,
        _fields({name: value.encode("utf-8", "surrogateescape") for name, value in header.items()}),
    )


def read_fields(file: BinaryIO) -> dict[str, bytes]:
    """Return the fields of a record. The file is then positioned at the length of the record's data."""
    data = file.read(_U32.unpack(file.read(4))[0])
    return fields_of(data)


def fields_of(data: bytes) -> dict[str, bytes]:
    fields, at = {}, 0
    while at < len(data):
        end = at + 4 + _U32.unpack_from(data, at)[0]
        name, _, value = data[at + 4 : end].partition(b"=")
        fields[name.decode()] = value
        at = end
    return fields


def _bag_header(index: int, connections: int, chunks: int) -> bytes:
    fields = {"op": BAG, "index_pos": _U64.pack(index)}
    fields |= {"conn_count": _U32.pack(connections), "chunk_count": _U32.pack(chunks)}
    padding = _HEAD_SIZE - len(_record(fields, b""))
    return _record(fields, b" " * padding)


def _record(fields: Mapping[str, bytes], data: bytes | bytearray | memoryview) -> bytes:
    head = _fields(fields)
    return b"".join((_U32.pack(len(head)), head, _U32.pack(len(data)), data))


def _fields(fields: Mapping[str, bytes]) -> bytes:
    lines = [name.encode() + b"=" + value for name, value in fields.items()]
    return b"".join(_U32.pack(len(line)) + line for line in lines)
