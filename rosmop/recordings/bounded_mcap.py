"""Read an MCAP file with ROS 1 messages, with the limits of `bounded_bag`.

The package `mcap` would unpack a chunk to any size, and hold all overlapping chunks. Here, waiting messages
of such chunks have at most `LARGEST_CHUNK` bytes in total.
"""

import heapq
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from io import SEEK_END
from pathlib import Path
from typing import BinaryIO, NamedTuple

import lz4.frame
import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, ChunkIndex, Footer, McapRecord, Message, Schema, Statistics
from mcap.stream_reader import StreamReader, breakup_chunk
from rosbags.interfaces import Connection, ConnectionExtRosbag1, MessageDefinition, MessageDefinitionFormat
from rosbags.typesys.msg import normalize_msgtype

from rosmop.recordings import regular_files
from rosmop.recordings.bounded_bag import PER_BYTE
from roswire.definitions import Definitions
from roswire.errors import DefinitionError

MAGIC = b"\x89MCAP0\r\n"
_FOOTER = 1 + 8 + 20 + len(MAGIC)  # bytes of the footer and of what follows it


class _ChunkPlace(NamedTuple):
    first: int
    offset: int
    last: int


class BoundedMcap:
    """An open MCAP file, whose `connections` are its ROS 1 channels.

    Raises `McapError`, `ValueError` and the errors of the decompressors for a damaged file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file: BinaryIO = regular_files.BoundedPath(path).open()
        self._left = PER_BYTE * path.stat().st_size + regular_files.LARGEST_CHUNK
        try:
            self._read_summary()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        self._file.close()

    def in_order(self) -> Iterator[tuple[Connection, int, bytes]]:
        connections = {connection.id: connection for connection in self.connections}
        waiting: list[tuple[int, int, int, int, bytes]] = []
        held = 0
        nexts = [*(place.first for place in self._chunks), 1 << 64][1:]
        for place, following in zip(self._chunks, nexts, strict=True):
            for number, record in enumerate(self._records(place)):
                if isinstance(record, Message) and record.channel_id in connections:
                    if record.log_time < place.first:
                        raise ValueError("a chunk has messages before its first time")
                    entry = (record.log_time, place.offset, number, record.channel_id, record.data)
                    held += len(record.data)
                    heapq.heappush(waiting, entry)
            while waiting and waiting[0][0] < following:
                time, _offset, _number, channel, data = heapq.heappop(waiting)
                held -= len(data)
                yield connections[channel], time, data
            if held > regular_files.LARGEST_CHUNK:
                limit = regular_files.LARGEST_CHUNK
                raise ValueError(
                    f"chunks of the same time have more than {limit} bytes: sort the file by time"
                )

    def _read_summary(self) -> None:
        self._file.seek(0)
        if self._file.read(len(MAGIC)) != MAGIC:
            raise ValueError("it does not begin as an MCAP file")
        self._file.seek(-_FOOTER, SEEK_END)
        footer = next(self._stream(self._file), None)
        if not isinstance(footer, Footer) or not footer.summary_start:
            raise ValueError("it has no index; `mcap recover` writes one")
        self._file.seek(footer.summary_start)
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        chunks: list[_ChunkPlace] = []
        count: int | None = None
        self.message_counts = Counter[
            int
        ]()  # by the id of a connection; empty if the file does not have them
        for record in self._stream(self._file):
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, ChunkIndex):
                chunks.append(
                    _ChunkPlace(record.message_start_time, record.chunk_start_offset, record.message_end_time)
                )
            elif isinstance(record, Statistics):
                count, self.message_counts = record.message_count, Counter(record.channel_message_counts)
        ros = [channel for _number, channel in sorted(channels.items()) if channel.message_encoding == "ros1"]
        # Writers may leave out each part of an index.
        if (count != 0 and not (chunks and channels)) or any(row.schema_id not in schemas for row in ros):
            raise ValueError("its index lacks chunks, channels or schemas; `mcap recover` writes them")
        self._chunks = sorted(chunks)
        self.message_count = count or len(chunks)
        self.start_time = min((chunk.first for chunk in chunks), default=0)
        self.end_time = max((chunk.last + 1 for chunk in chunks), default=0)
        self.hosts = {row.id: row.metadata["host"] for row in ros if "host" in row.metadata}
        self.dropped = {row.id for row in ros if row.metadata.get("carried") == "0"}
        self.connections = [self._connection(channel, schemas[channel.schema_id]) for channel in ros]
        if channels and not self.connections:
            encodings = ", ".join(sorted({channel.message_encoding for channel in channels.values()}))
            raise ValueError(f"it has no messages of ROS 1, only of encoding {encodings}")

    def _connection(self, channel: Channel, schema: Schema) -> Connection:
        text = schema.data.decode("utf-8", "replace")
        digest = channel.metadata.get("md5sum") or _md5sum(schema.name, text)
        latching = channel.metadata.get("latching") == "1"
        sender = ConnectionExtRosbag1(channel.metadata.get("callerid"), int(latching))
        definition = MessageDefinition(MessageDefinitionFormat.MSG, text)
        kind = normalize_msgtype(schema.name)
        return Connection(channel.id, channel.topic, kind, definition, digest, 0, sender, self)

    def _records(self, place: _ChunkPlace) -> list[McapRecord]:
        self._file.seek(place.offset)
        chunk = next(self._stream(self._file), None)
        if not isinstance(chunk, Chunk):
            raise ValueError("its index does not fit its chunks")
        data = _unpack(chunk)
        self._charge(len(chunk.data) + len(data))
        return breakup_chunk(replace(chunk, compression="", data=data))

    def _stream(self, file: BinaryIO) -> Iterator[McapRecord]:
        limit = regular_files.LARGEST_CHUNK
        return iter(StreamReader(file, skip_magic=True, emit_chunks=True, record_size_limit=limit).records)

    def _charge(self, count: int) -> None:
        self._left -= count
        if self._left < 0:
            raise ValueError(f"it unpacks to more than {PER_BYTE} times its size")


def _unpack(chunk: Chunk) -> bytes:
    limit = regular_files.LARGEST_CHUNK
    if chunk.compression == "lz4":
        data: bytes = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, limit + 1)
    elif chunk.compression == "zstd":
        with zstandard.ZstdDecompressor().stream_reader(chunk.data) as packed:
            data = packed.read(limit + 1)
    elif chunk.compression == "":
        data = chunk.data
    else:
        raise McapError(f"its compression {chunk.compression!r} is not known")
    if len(data) > limit:
        raise ValueError(f"a chunk unpacks to more than {limit} bytes")
    if len(data) != chunk.uncompressed_size:
        raise ValueError("a chunk is cut off")
    return data


def _md5sum(kind: str, text: str) -> str:
    try:
        return Definitions.from_full_text(kind, text).md5sum(kind)
    except DefinitionError:
        return "unknown"
