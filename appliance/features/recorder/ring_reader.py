"""Read a ring without trusting it: a compromised relay can only spoil its own messages."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

from appliance.features.recorder.ring import (
    HEADER,
    MARK,
    MISSED,
    NONE_BEGINS,
    PAD,
    RECORD,
    REFUSED,
    BlockRow,
    birth_at,
    geometry,
    rows,
    used_at,
    words_of,
)
from roswire.errors import ProtocolError
from roswire.tcpros import decode_header

_LENGTH = struct.Struct("<I")
_LONGEST_HEADER = 256 << 10
_NEEDED = frozenset({"topic", "type", "md5sum", "message_definition", "callerid", "host"})
_LONGEST_TYPE = 256
MOST_MESSAGES = 1 << 53

_Blocks = dict[int, tuple[int, BlockRow]]


class ReadPosition(NamedTuple):
    """A block of the chain, and a byte in it."""

    number: int
    offset: int


class RecordedFrames(NamedTuple):
    """One batch of messages. `time` is nanoseconds since the epoch, and `first` counts from 1."""

    time: int
    first: int
    frames: list[memoryview]


class StreamFrames(NamedTuple):
    stream: int
    header: dict[str, str]
    batches: list[RecordedFrames]
    torn: bool
    """Whether frames before or between the batches were overwritten or are damaged."""


@dataclass(slots=True)
class _Run:
    number: int
    begins: int
    data: bytearray
    broken: bool  # whether data before this run is missing


class RingReader:
    """Reads a ring; `places` are the positions up to which streams were read."""

    def __init__(self, memory: memoryview, places: dict[int, ReadPosition] | None = None) -> None:
        self._memory = memory
        self._words = words_of(memory)
        self._geometry = geometry(len(memory))
        self.places = places or {}

    @property
    def not_there(self) -> tuple[int, int]:
        return self._words[MISSED], self._words[REFUSED]

    def read(self, since: int, until: int) -> Iterator[StreamFrames]:
        """Yield the new frames of each stream, up to `until` (ns since the epoch).

        A later message is left for another call, but skipped if an earlier one follows it: then the clock was set
        back.
        """
        headers: dict[int, _Blocks] = {}
        data: dict[int, _Blocks] = {}
        for block, row in rows(self._memory):
            if row.sound:
                chains = headers if row.kind == HEADER else data
                chains.setdefault(row.stream, {})[row.number] = block, row
        self.places = {stream: place for stream, place in self.places.items() if stream in data}
        for stream, blocks in data.items():
            header = self._header(headers.get(stream, {}))
            if header is not None:
                batches, torn = self._new(stream, blocks, since, until)
                if batches or torn:
                    yield StreamFrames(stream, header, batches, torn)

    def _header(self, blocks: _Blocks) -> dict[str, str] | None:
        text = bytearray()
        for number in range(len(blocks)):
            part = self._copy(*blocks[number]) if number in blocks else None
            if part is None or len(text) + len(part) > _LONGEST_HEADER:
                return None
            text += part
        try:
            header = decode_header(bytes(text[_LENGTH.size :]))
        except ProtocolError:
            return None
        return _readable(header) if header.keys() >= _NEEDED else None

    def _copy(self, block: int, row: BlockRow) -> bytes | None:
        """Copy a block up to its current `used`, because it may have been filled while the table was copied."""
        start = self._geometry.data + block * self._geometry.block
        part = bytes(self._memory[start : start + min(self._words[used_at(block)], self._geometry.block)])
        return part if self._words[birth_at(block)] == row.birth else None

    def _runs(self, blocks: _Blocks, place: ReadPosition | None) -> Iterator[_Run]:
        run: _Run | None = None
        broken = False
        for number in sorted(blocks):
            if place is not None and number < place.number:
                continue
            block, row = blocks[number]
            part = self._copy(block, row)
            if run is not None and (
                part is None or number != run.number + len(run.data) // self._geometry.block
            ):
                yield run
                run = None
                broken = True
            if part is not None and run is None:
                broken = broken or number != (0 if place is None else place.number)
                if broken and row.begins == NONE_BEGINS:
                    continue  # the middle of a record whose start is missing
                run = _Run(number, row.begins, bytearray(), broken)
            if part is not None and run is not None:
                run.data += part
        if run is not None:
            yield run

    def _new(self, stream: int, blocks: _Blocks, since: int, until: int) -> tuple[list[RecordedFrames], bool]:
        batches: list[RecordedFrames] = []
        place, torn = self.places.get(stream), False
        for run in self._runs(blocks, place):
            at = done = run.begins if run.broken else 0 if place is None else place.offset
            # The first record's time alone shows whether the missing data belongs to the requested period.
            in_doubt = run.broken
            view = memoryview(bytes(run.data))
            while at + _LENGTH.size <= len(view):
                if _LENGTH.unpack_from(view, at)[0] == PAD:
                    at = (at // self._geometry.block + 1) * self._geometry.block
                    continue
                if at + RECORD.size > len(view):
                    break
                mark, messages, size, time, first = RECORD.unpack_from(view, at)
                if mark != MARK or first > MOST_MESSAGES:
                    torn, done = True, len(view)  # the start of the next record is unknown
                    break
                torn, in_doubt = torn or (in_doubt and time >= since), False
                end = at + RECORD.size + size
                if end > len(view):
                    break
                body, at = view[at + RECORD.size : end], end
                if time > until:
                    continue
                done = end
                if time >= since:
                    frames = _frames(body, messages)
                    if frames is None:
                        torn = True
                    else:
                        batches.append(RecordedFrames(time, first, frames))
            torn = torn or in_doubt
            blocks_read, offset = divmod(done, self._geometry.block)
            self.places[stream] = ReadPosition(run.number + blocks_read, offset)
        return batches, torn


def _readable(header: dict[str, str]) -> dict[str, str]:
    definition = header["message_definition"].encode("utf-8", "surrogateescape").decode("utf-8", "replace")
    plain = {name: header[name][:_LONGEST_TYPE] for name in ("type", "md5sum")}
    if "latching" in header:
        plain["latching"] = "1" if header["latching"] == "1" else "0"
    return header | plain | {"message_definition": definition}


def _frames(view: memoryview, messages: int) -> list[memoryview] | None:
    found: list[memoryview] = []
    at = 0
    while at + _LENGTH.size <= len(view) and len(found) < messages:
        end = at + _LENGTH.size + _LENGTH.unpack_from(view, at)[0]
        if end > len(view):
            return None
        found.append(view[at + _LENGTH.size : end])
        at = end
    return found if at == len(view) and len(found) == messages else None
