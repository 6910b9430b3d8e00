"""Convert a bag to MCAP, piece by piece, for tools that cannot read bags. Format: https://mcap.dev/spec.

`rosbags` writes MCAP for ROS 2 only. Messages are copied unchanged (profile `ros1`), in order of time, to uncompressed
chunks with indexes. The summary at the end lists all chunks.
"""

import struct
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path

from appliance.recorder.bag_reader import BagReader

_MAGIC = b"\x89MCAP0\r\n"
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _MESSAGE_INDEX, _CHUNK_INDEX = range(1, 9)
_STATISTICS, _DATA_END = 0x0B, 0x0F
_CHUNK_BYTES = 1 << 20
_LONGEST = 1 << 32
_OF_SENDER = ("md5sum", "callerid", "host", "latching")


def as_mcap(bag: Path) -> Iterator[bytes]:
    """Yield the pieces of an MCAP file with a bag's messages; the bag may be removed during the iteration.

    Raises `OSError`, and `ValueError` for an invalid bag; either may also come during the iteration.
    """
    opened = ExitStack()
    return _pieces(opened, opened.enter_context(BagReader.of(bag)))


def _pieces(opened: ExitStack, reader: BagReader) -> Iterator[bytes]:
    with opened:
        writer = _Writer(reader.connections)
        head = _MAGIC + _record(_HEADER, _text("ros1"), _text("rosrv"))
        yield head
        writer.position = len(head)
        for place, connection in reader.messages(reader.connections.keys()):
            writer.add(connection, place.time, reader.body(place, _LONGEST)[1])
            if len(writer.chunk) >= _CHUNK_BYTES:
                yield writer.close_chunk()
        yield writer.close_chunk()
        yield writer.summary()


class _Writer:
    """A buffer for the current chunk and the summary; `position` is the offset of the next piece."""

    def __init__(self, connections: Mapping[int, Mapping[str, str]]) -> None:
        self._connections = connections
        self.position = 0
        self.chunk = bytearray()
        self._index: dict[int, list[tuple[int, int]]] = {}
        self._schemas: dict[tuple[str, str], int] = {}
        self._described: list[bytes] = []  # the records of schemas and channels
        self._numbers: dict[int, int] = {}
        self._chunks: list[bytes] = []
        self._counts: Counter[int] = Counter()
        self._times: tuple[int, int] = (0, 0)

    def add(self, connection: int, time: int, data: bytes) -> None:
        """Add a message; before the first message of a connection, add the connection's description."""
        channel = self._numbers.get(connection) or self._describe(connection)
        self._index.setdefault(channel, []).append((time, len(self.chunk)))
        head = struct.pack("<HIQQ", channel, self._counts[channel] & 0xFFFFFFFF, time, time)
        self.chunk += _record(_MESSAGE, head, data)
        first, last = self._times
        self._times = (min(first, time), max(last, time)) if self._counts else (time, time)
        self._counts[channel] += 1

    def _describe(self, connection: int) -> int:
        header = self._connections[connection]
        name, text = header["type"], header["message_definition"]
        schema = self._schemas.get((name, text))
        if schema is None:
            schema = self._schemas[name, text] = len(self._schemas) + 1
            head = struct.pack("<H", schema)
            self._tell(_record(_SCHEMA, head, _text(name), _text("ros1msg"), _text(text)))
        channel = self._numbers[connection] = len(self._numbers) + 1
        of_sender = {"latching": "0"} | {key: header[key] for key in _OF_SENDER if key in header}
        fields = b"".join(_text(key) + _text(value) for key, value in of_sender.items())
        head = struct.pack("<HH", channel, schema)
        self._tell(_record(_CHANNEL, head, _text(header["topic"]), _text("ros1"), _map(fields)))
        return channel

    def _tell(self, description: bytes) -> None:
        self.chunk += description
        self._described.append(description)

    def close_chunk(self) -> bytes:
        """Return the chunk and its indexes; empty if it has no messages."""
        if not self._index:
            return b""
        times = [time for entries in self._index.values() for time, _offset in entries]
        size = len(self.chunk)
        head = struct.pack("<QQQI", min(times), max(times), size, 0) + _text("") + struct.pack("<Q", size)
        chunk = _record(_CHUNK, head, self.chunk)
        indexes, offsets = bytearray(), {}
        for channel, entries in self._index.items():
            offsets[channel] = self.position + len(chunk) + len(indexes)
            packed = b"".join(struct.pack("<QQ", *entry) for entry in entries)
            indexes += _record(_MESSAGE_INDEX, struct.pack("<H", channel), _map(packed))
        self._chunks.append(
            _record(
                _CHUNK_INDEX,
                struct.pack("<QQQQ", min(times), max(times), self.position, len(chunk)),
                _numbers(offsets),
                struct.pack("<Q", len(indexes)),
                _text(""),
                struct.pack("<QQ", size, size),
            )
        )
        self.position += len(chunk) + len(indexes)
        self.chunk, self._index = bytearray(), {}
        return chunk + bytes(indexes)

    def summary(self) -> bytes:
        """Return the end of the file."""
        end = _record(_DATA_END, struct.pack("<I", 0))
        start = self.position + len(end)
        statistics = struct.pack(
            "<QHIIIIQQ",
            self._counts.total(), len(self._schemas), len(self._numbers), 0, 0, len(self._chunks), *self._times,
        )  # fmt: skip
        footer = _record(_FOOTER, struct.pack("<QQI", start, 0, 0))
        counted = _record(_STATISTICS, statistics, _numbers(self._counts))
        return b"".join((end, *self._described, counted, *self._chunks, footer, _MAGIC))


def _record(op: int, *parts: bytes | bytearray) -> bytes:
    return struct.pack("<BQ", op, sum(map(len, parts))) + b"".join(parts)


def _text(text: str) -> bytes:
    return _map(text.encode("utf-8", "replace"))


def _map(content: bytes) -> bytes:
    return struct.pack("<I", len(content)) + content


def _numbers(numbers: Mapping[int, int]) -> bytes:
    return _map(b"".join(struct.pack("<HQ", *row) for row in numbers.items()))
