"""Keep the latest messages of a relay in shared memory, which survives the relay and is read by the recorder.

One relay writes the memory, and one recorder reads it. Each connection to a publisher is a *stream*: a chain of
header blocks (the connection's TCPROS header) and a chain of data blocks, numbered from 0. The data are records,
which may span blocks: whether they were carried, number of frames, size in bytes, time, number of the first frame,
frames.

1. A block is valid up to `used`, which is stored after its data. A row is valid while `birth`, which is stored last,
   is not 0. So a writer that is killed at any instruction leaves at most one torn record at the end of a chain, which
   the reader ignores.
2. Before a block is reused, its `birth` is set to 0. The reader discards a copy if `birth` has changed.
3. Without a free block, the first of these is reused: the oldest block, if it is too old; the oldest of the writing
   topic or host, if that topic or host has used its quota; the oldest of a topic or host above its quota; the oldest
   of all. A block that an active stream is filling counts as new.
4. The reader trusts no content: it bounds every number by the memory's own size.
5. Header blocks take at most a quarter of the memory, and of the quota of a host. A new header replaces closed
   streams, oldest first. Streams without room are counted (`REFUSED`), and so are messages in a record larger
   than its topic's quota (`MISSED`).

`used` and `birth` are aligned words of 64 bits. If the processor reorders stores (ARM), the reader may see a record's
data only at its next check.
"""

import struct
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from appliance.base import clock
from roswire.tcpros import encode_header

SMALLEST = 1 << 20
"""The smallest ring in bytes."""

LEFT_OUT = "left_out"
"""The field of a header with the reason why its messages are not recorded; a publisher cannot set it."""

CARRIED = "carried"
"""The field of a connection in a bag: "0" if the relay dropped its messages before monitors; else it has none."""

HEADER, DATA = 1, 2
RECORD = struct.Struct("<IIQQQ")  # mark, frames, bytes of the frames, time, number of the first frame
MARK, PAD, DROPPED = 0x0001_D00D, 0x0002_D00D, 0x0003_D00D
_PAD = struct.Struct("<I")
NONE_BEGINS = (1 << 32) - 1

_BLOCKS = 4096
_SMALLEST_BLOCK, _LARGEST_BLOCK = 4 << 10, 256 << 10
_COUNTERS = 4096  # size in bytes of the counters, which precede the table
_WORDS = 8  # 64-bit words of a row
_ROW = struct.Struct("=QQQIIQ24x")  # birth, stream, number, kind, begins, used
MISSED, REFUSED = 0, 1  # indexes of the counters' words
_LONG = 4  # blocks; a longer record begins in a new block, so that it does not depend on a much older block
_MAX_NUMBER = 1 << 62
_MAX_HEADERS = 4  # headers may take a quarter


class Geometry(NamedTuple):
    """The layout of a ring; `data` is the offset of the first block."""

    block: int
    blocks: int
    data: int


def geometry(size: int) -> Geometry:
    if size < SMALLEST:
        raise ValueError(f"a ring of {size} bytes is too small: use at least {SMALLEST}")
    block = _SMALLEST_BLOCK
    while block < _LARGEST_BLOCK and block * _BLOCKS < size:
        block *= 2
    blocks = (size - _COUNTERS) // (block + _ROW.size)
    return Geometry(block, blocks, size - blocks * block)


class BlockRow(NamedTuple):
    """The table's entry for a block."""

    birth: int
    stream: int
    number: int
    kind: int
    begins: int
    used: int

    @property
    def sound(self) -> bool:
        """Return whether the numbers are possible: a compromised writer's numbers must not overflow a word."""
        return (
            0 < self.birth < _MAX_NUMBER
            and 0 < self.stream < _MAX_NUMBER
            and self.number < _MAX_NUMBER
            and self.kind in {HEADER, DATA}
        )


@dataclass(eq=False, slots=True)
class _Share:
    """The use of a quota; `blocks` are data blocks, oldest first."""

    most: int
    blocks: OrderedDict[int, None] = field(default_factory=OrderedDict)
    headers: int = 0
    streams: int = 0


@dataclass(eq=False, slots=True)
class _Chain:
    shares: tuple[_Share, ...] = ()
    names: tuple[str, str] = ("", "")
    headers: list[int] = field(default_factory=list)
    data: int = 0
    writer: "RingStream | None" = None


def words_of(memory: memoryview) -> memoryview:
    return memory[: len(memory) // 8 * 8].cast("Q")


def rows(memory: memoryview) -> list[tuple[int, BlockRow]]:
    table = bytes(memory[_COUNTERS : _COUNTERS + geometry(len(memory)).blocks * _ROW.size])
    return [(block, BlockRow._make(row)) for block, row in enumerate(_ROW.iter_unpack(table))]


def birth_at(block: int) -> int:
    return _COUNTERS // 8 + block * _WORDS


def used_at(block: int) -> int:
    return birth_at(block) + 4


class RingStream:
    """The open stream of one connection to a publisher."""

    keeps = True
    """Whether the stream stores messages."""

    __slots__ = ("_chain", "_end", "_number", "_place", "_ring", "_stream", "_used", "block", "written")

    def __init__(self, ring: "RingWriter", stream: int, chain: _Chain) -> None:
        self._ring = ring
        self._stream = stream
        self._chain = chain
        self._number = 0
        self.block = -1
        self.written = 0  # time of the last record
        self._place = self._end = 0  # offsets in the memory
        self._used = 0  # the index of the block's word

    def write(
        self, frames: memoryview, messages: int, first: int, judged: int = 0, *, carried: bool = True
    ) -> None:
        """Append a record of frames from number `first`. `judged` is the time when monitors got them, or 0."""
        ring, mark = self._ring, MARK if carried else DROPPED
        size = len(frames)
        now = self.written = ring.clock(judged)
        place = self._place
        end = place + RECORD.size + size
        if end <= self._end:
            RECORD.pack_into(ring.memory, place, mark, messages, size, now, first)
            ring.memory[place + RECORD.size : end] = frames
            ring.words[self._used] = end - self._end + ring.block
            self._place = end
        elif size > ring.longest:
            ring.count(MISSED, messages)
        else:
            self._append(memoryview(RECORD.pack(mark, messages, size, now, first)), frames)

    def close(self) -> None:
        self._ring.close_chain(self._stream, self._chain)

    def lose_block(self) -> None:
        self.block, self._place, self._end = -1, 0, 0

    def _append(self, head: memoryview, frames: memoryview) -> None:
        ring = self._ring
        left = len(head) + len(frames)
        if left > _LONG * ring.block and self._place + _PAD.size <= self._end:
            _PAD.pack_into(ring.memory, self._place, PAD)
            ring.words[self._used] = ring.block
            self._place = self._end
        for part in (head, frames):
            done = 0
            while done < len(part):
                if self._place == self._end:
                    begins = 0 if part is head and not done else left
                    self._next(begins if begins < ring.block else NONE_BEGINS)
                place = self._place
                count = min(len(part) - done, self._end - place)
                ring.memory[place : place + count] = part[done : done + count]
                self._place = place + count
                ring.words[self._used] = place + count - self._end + ring.block
                done += count
                left -= count

    def _next(self, begins: int) -> None:
        ring = self._ring
        block = self.block = ring.take(
            self._stream, self._number, DATA, begins, self._chain, now=self.written
        )
        self._number += 1
        self._used = used_at(block)
        self._place = ring.data + block * ring.block
        self._end = self._place + ring.block


class RingWriter:
    """Writes shared memory, and keeps the data of earlier writers."""

    def __init__(
        self,
        memory: memoryview,
        *,
        # The fractions that one topic and one host may keep when others need memory.
        topic_share: float,
        host_share: float,
        seconds: float,  # older blocks are reused first
        clock: Callable[[int], int] = lambda judged: judged or clock.wall_ns(),
    ) -> None:
        self.geometry = geometry(len(memory))
        self.block, self.data = self.geometry.block, self.geometry.data
        self.memory = memory
        self.words = words_of(memory)
        self.clock = clock
        self._keep = int(seconds * 1e9)
        self._most_of_topic = max(2, int(self.geometry.blocks * topic_share))
        self._most_of_host = max(2, int(self.geometry.blocks * host_share))
        self.longest = (self._most_of_topic - 1) * self.block - RECORD.size
        self._topics: dict[str, _Share] = {}
        self._hosts: dict[str, _Share] = {}
        self._chains: dict[int, _Chain] = {}
        # Data blocks, oldest first, each with its stream and time.
        self._order: OrderedDict[int, tuple[int, int]] = OrderedDict()
        self._beyond: dict[_Share, None] = {}
        self._headers = 0
        self._free: list[int] = []
        self._birth = self._last_stream = 0
        self._inherit()

    def open(self, topic: str, host: str, header: Mapping[str, str]) -> RingStream | None:
        text = memoryview(encode_header({**header, "topic": topic, "host": host}))
        needed = -(-len(text) // self.block)
        shares = tuple(
            known.get(name) or _Share(most)
            for known, name, most in (
                (self._topics, topic, self._most_of_topic),
                (self._hosts, host, self._most_of_host),
            )
        )
        if not self._room_for_header(needed, shares[1]):
            self.count(REFUSED, 1)
            return None
        self._topics[topic], self._hosts[host] = shares
        for share in shares:
            share.streams += 1
            share.headers += needed
        self._last_stream += 1
        chain = self._chains[self._last_stream] = _Chain(shares, (topic, host))
        for number in range(needed):
            part = text[number * self.block : (number + 1) * self.block]
            block = self.take(self._last_stream, number, HEADER, 0, chain, now=self.clock(0))
            place = self.geometry.data + block * self.block
            self.memory[place : place + len(part)] = part
            self.words[used_at(block)] = len(part)
        chain.writer = RingStream(self, self._last_stream, chain)
        return chain.writer

    def count(self, counter: int, by: int) -> None:
        self.words[counter] = (self.words[counter] + by) % (1 << 64)

    def take(self, stream: int, number: int, kind: int, begins: int, chain: _Chain, *, now: int) -> int:
        if not self._free:
            self._give_up(chain, now - self._keep)
        block = self._free.pop()
        self._birth += 1
        row = _COUNTERS + block * _ROW.size
        _ROW.pack_into(self.memory, row, 0, stream, number, kind, begins, 0)
        self.words[birth_at(block)] = self._birth
        if kind == HEADER:
            chain.headers.append(block)
            self._headers += 1
        else:
            chain.data += 1
            self._order[block] = stream, now
            for share in chain.shares:
                share.blocks[block] = None
                if len(share.blocks) > share.most:
                    self._beyond[share] = None
        return block

    def close_chain(self, stream: int, chain: _Chain) -> None:
        chain.writer = None
        if not chain.data:
            self._forget(stream, chain)

    def _give_up(self, chain: _Chain, old: int) -> None:
        """Free a block by invariant 3. A block written before the time `old` is too old."""
        oldest = self._oldest(old)
        if self._order[oldest][1] >= old or self._in_use(oldest, old):
            full = (share for share in chain.shares if len(share.blocks) >= share.most)
            share = next(full, None) or next(iter(self._beyond), None)
            oldest = oldest if share is None else next(iter(share.blocks))
        self._push_out(oldest)

    def _in_use(self, block: int, old: int) -> bool:
        """Return whether an active stream is filling the block, which may have all data of a slow stream."""
        writer = self._chains[self._order[block][0]].writer
        return writer is not None and writer.block == block and writer.written >= old

    def _oldest(self, old: int) -> int:
        for _ in range(len(self._order)):
            block = next(iter(self._order))
            if not self._in_use(block, old):
                return block
            self._order.move_to_end(block)
        return next(iter(self._order))

    def _push_out(self, block: int) -> None:
        stream, _since = self._order.pop(block)
        loser = self._chains[stream]
        for share in loser.shares:
            del share.blocks[block]
            if len(share.blocks) <= share.most:
                self._beyond.pop(share, None)
        loser.data -= 1
        self._release(block)
        if loser.writer is None and not loser.data:
            self._forget(stream, loser)
        elif loser.writer is not None and loser.writer.block == block:
            loser.writer.lose_block()

    def _room_for_header(self, needed: int, host: _Share) -> bool:

        def is_crowded(*, of_host: bool) -> bool:
            has, whole = (
                (host.headers, self._most_of_host) if of_host else (self._headers, self.geometry.blocks)
            )
            return has + needed > whole // _MAX_HEADERS

        for of_host in (False, True):
            closed = (
                stream
                for stream, chain in list(self._chains.items())
                if chain.writer is None and (not of_host or host in chain.shares)
            )
            while is_crowded(of_host=of_host):
                stream = next(closed, None)
                if stream is None:
                    return False
                for block in [block for block, (owner, _since) in self._order.items() if owner == stream]:
                    self._push_out(block)
        return True

    def _forget(self, stream: int, chain: _Chain) -> None:
        del self._chains[stream]
        for block in chain.headers:
            self._release(block)
        self._headers -= len(chain.headers)
        for known, name, share in zip((self._topics, self._hosts), chain.names, chain.shares, strict=False):
            share.streams -= 1
            share.headers -= len(chain.headers)
            if not share.streams:
                del known[name]

    def _release(self, block: int) -> None:
        self.words[birth_at(block)] = 0
        self._free.append(block)

    def _inherit(self) -> None:
        """Take over an earlier writer's blocks as the oldest ones, and its streams as closed."""
        left = sorted((row, block) for block, row in rows(self.memory) if row.sound)
        with_data = {row.stream for row, _block in left if row.kind == DATA}
        for row, block in left:
            if row.stream not in with_data:
                continue
            chain = self._chains.setdefault(row.stream, _Chain())
            if row.kind == DATA:
                chain.data += 1
                self._order[block] = row.stream, self.clock(0)
            else:
                chain.headers.append(block)
                self._headers += 1
            self._birth = max(self._birth, row.birth)
            self._last_stream = max(self._last_stream, row.stream)
        kept = {block for row, block in left if row.stream in with_data}
        for block in reversed(range(self.geometry.blocks)):
            if block not in kept:
                self._release(block)
