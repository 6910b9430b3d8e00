"""Read a ROS 1 bag in time linear in its size, even if the bag is malicious.

`rosbags` trusts the headers of a bag. This reader adds limits:

1. It reads at most `LARGEST_CHUNK` bytes at once, and unpacks a chunk to at most that size.
2. It unpacks and reads at most `PER_BYTE` bytes for each byte of the bag, plus one chunk. Without this limit, index
   entries could name one message many times, or unpack two chunks in turn.
3. The index has at most as many entries as fit in the bag, so chunks cannot share an index.
"""

import bz2
from collections.abc import Callable, Iterator
from io import SEEK_CUR, BufferedReader, BytesIO
from pathlib import Path, PosixPath
from typing import Any, BinaryIO

import lz4.frame
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader, ReaderError
from rosbags.rosbag1.reader import Header, IndexData, RecordType, decompressors, read_bytes, read_uint32

from rosmop.tool.command_context import CommandContext, open_regular

LARGEST_CHUNK = 256 << 20
PER_BYTE = 256
_LONGEST_LINE = 64
_HEADER, _ENTRY = 55, 12  # bytes of a chunk's index of one connection, and of each entry
_UNPACKERS: dict[Callable[[bytes], bytes], Callable[[], Any]] = {
    decompressors["bz2"]: bz2.BZ2Decompressor,
    decompressors["lz4"]: lz4.frame.LZ4FrameDecompressor,
}


class _BoundedFile(BufferedReader):
    """A file with a limit for each read."""

    def read(self, size: int | None = -1, /) -> bytes:
        """Read bytes, at most `LARGEST_CHUNK`."""
        if size is None or not 0 <= size <= LARGEST_CHUNK:
            raise ReaderError(f"it has a record of more than {LARGEST_CHUNK} bytes.")
        return super().read(size)

    def readline(self, _size: int | None = -1, /) -> bytes:
        """Read the line with the format, at most `_LONGEST_LINE` bytes."""
        return super().readline(_LONGEST_LINE)


class _BagPath(PosixPath):
    def open(self, *_mode: object) -> BinaryIO:  # type: ignore[override] # rosbags asks for bytes
        return _BoundedFile(open_regular(Path(self)).detach())


class BoundedReader(Reader):
    """The reader of `rosbags`; raises `ReaderError` beyond a limit."""

    def __init__(self, program: CommandContext, path: Path) -> None:
        self.program = program
        super().__init__(_BagPath(path))
        self._size = path.stat().st_size
        self._left = PER_BYTE * self._size + LARGEST_CHUNK
        self._entries = 0

    @property
    def message_count(self) -> int:
        """Return the number of messages in the index."""
        return self._entries

    def read_index_data(self, pos: int, indexes: dict[int, list[IndexData]]) -> None:
        """Read the index of one connection in one chunk."""
        assert self.bio is not None  # noqa: S101  the reader is open
        begin = self.bio.tell()
        super().read_index_data(pos, indexes)
        self._entries += (self.bio.tell() - begin - _HEADER) // _ENTRY
        if self._entries * _ENTRY > self._size:
            raise ReaderError("its chunks share an index.")

    def in_order(self) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield connection, nanoseconds and bytes of every message: by time, then by position in the file."""
        connections = {connection.id: connection for connection in self.connections}
        everything = [entry for entries in self.indexes.values() for entry in entries]
        everything.sort(key=lambda entry: (entry.time, entry.chunk_pos, entry.offset))
        here, content = -1, BytesIO()
        for entry in everything:
            if entry.chunk_pos != here:
                here, content = entry.chunk_pos, BytesIO(self._content(entry.chunk_pos))
            content.seek(entry.offset)
            while (header := Header.read(content)).get_uint8("op") == RecordType.CONNECTION:
                self._charge(content.seek(read_uint32(content), SEEK_CUR) - entry.offset)
            if header.get_uint8("op") != RecordType.MSGDATA or header.get_time("time") != entry.time:
                raise ReaderError("its index does not fit its messages.")
            data = read_bytes(content, read_uint32(content))
            self._charge(content.tell() - entry.offset)
            yield connections[header.get_uint32("conn")], entry.time, data

    def _content(self, place: int) -> bytes:
        """Return an unpacked chunk."""
        assert self.bio is not None  # noqa: S101  the reader is open
        chunk = self.chunks[place]
        self.bio.seek(chunk.datapos)
        data = read_bytes(self.bio, chunk.datasize)
        if chunk.decompressor in _UNPACKERS:
            unpacker = _UNPACKERS[chunk.decompressor]()
            data = unpacker.decompress(data, LARGEST_CHUNK)
            if not unpacker.eof:
                more = f"a chunk unpacks to more than {LARGEST_CHUNK} bytes."
                raise ReaderError("a chunk is cut off." if unpacker.needs_input else more)
        self._charge(len(data))
        return data

    def _charge(self, count: int) -> None:
        self._left -= count
        if self._left < 0:
            raise ReaderError(f"it unpacks to more than {PER_BYTE} times its size.")
