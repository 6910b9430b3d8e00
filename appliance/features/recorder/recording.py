"""Write a recording from the memory of the relays to a bag.

1. After each step, the file `progress` is replaced atomically. A new recorder cuts the bag at the length in it
   and continues: the memory still holds the unwritten messages.
2. Missing messages are reported, as a count by topic if possible.
3. The headers of connections have at most `_MAX_HEADERS` bytes, because publishers choose their content.
"""

import hashlib
import os
import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import msgspec

from appliance.audit.log.record import Severity
from appliance.audit.log.record_format import LogEntry, as_json
from appliance.base.atomic_files import write_whole
from appliance.base.counted import counted
from appliance.features.recorder.bag_writer import (
    MESSAGE_SIZE,
    BagMessage,
    BagWriter,
    chunk_size,
    connection_size,
)
from appliance.features.recorder.excluded_topics import NAMED
from appliance.features.recorder.recorder_link import CLOCK_STEP, RevisionsStated
from appliance.features.recorder.recording_answers import (
    OPERATORS,
    LeftOutTopic,
    OpenRecording,
    RecordedTopic,
    Recording,
    Trigger,
)
from appliance.features.recorder.recording_store import ABOUT, BAG, PROGRESS
from appliance.features.recorder.ring import (
    CARRIED,
    DROPPED,
    HEADER,
    LEFT_OUT,
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
from roswire.log_message import ERROR, INFO, TYPE, WARN, log_message
from roswire.standard import standard_definitions
from roswire.tcpros import decode_header

# Read a ring without trusting it: a compromised relay can only spoil its own messages.

_LONGEST_HEADER = 256 << 10
_NEEDED = frozenset({"topic", "type", "md5sum", "message_definition", "callerid", "host"})
_LONGEST_TYPE = 256
MAX_MESSAGES = 1 << 53
_NEVER = 1 << 64  # no time reaches it

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
    carried: bool
    """Whether monitors and subscribers got them."""


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

    def skip(self) -> dict[int, ReadPosition]:
        """Return the positions after all messages."""
        for _found in self.read(_NEVER, _NEVER):
            pass
        return self.places

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

    def _runs(self, blocks: _Blocks, position: ReadPosition | None) -> Iterator[_Run]:
        run: _Run | None = None
        broken = False
        for number in sorted(blocks):
            if position is not None and number < position.number:
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
                broken = broken or number != (0 if position is None else position.number)
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
                if mark not in {MARK, DROPPED} or first > MAX_MESSAGES:
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
                        batches.append(RecordedFrames(time, first, frames, mark == MARK))
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


RECORDS, LOG = "/rosrv/records", "/rosrv/log"
MAX_TRIGGERS = 200
MAX_RECORDS = 200_000
"""The number of audit records in a recording."""

_CHUNK = 1 << 20
_MAX_NAMED = 10
_MAX_LEFT_OUT = 100
_MAX_HEADERS = 8 << 20
_FOR_RECORDS = 16  # messages leave this fraction of the largest size to audit records
_LENGTH = struct.Struct("<I")
_LEVELS = {Severity.WARNING: WARN, Severity.ALARM: ERROR}


class Progress(msgspec.Struct):
    """The progress of a recording; times are nanoseconds since the epoch."""

    id: str
    memory: int
    """The time when the rings were created."""
    began: int
    ends: int
    triggers: list[Trigger]
    size: int = 0
    connections: list[dict[str, str]] = []
    places: list[dict[int, ReadPosition]] = []
    """For each ring, the position in each stream."""
    following: list[dict[int, int]] = []
    """For each ring, the number of each stream's next message."""
    not_there: list[tuple[int, int]] = []
    """For each ring, the losses before the recording."""
    topics: list[RecordedTopic] = []
    torn: list[str] = []
    unconnected: int = 0
    """The number of messages left out because headers exceed `_MAX_HEADERS`."""
    why_not: str = ""
    charged_to: str = OPERATORS
    hold: int = 0
    """An act extends the recording to this number of nanoseconds after it."""
    latest: int = 0
    left_out: list[LeftOutTopic] = []
    claims: int = 0
    """The number of topics left out because of their publishers' claims."""
    ahead: int = 0
    """How far the machine's clock is ahead of the monotonic one."""
    reached: int = 0
    """The time up to which messages were read."""


def load_progress(folder: Path) -> Progress:
    return msgspec.msgpack.decode((folder / PROGRESS).read_bytes(), type=Progress)


class RecordingInProgress:
    """A recording in `folder` that continues from `progress`."""

    def __init__(
        self, folder: Path, progress: Progress, rings: Sequence[memoryview], *, largest: int
    ) -> None:
        folder.mkdir(mode=0o750, exist_ok=True)
        folder.chmod(0o750)
        self.progress = progress
        self._folder = folder
        self._largest = largest
        self._bag = BagWriter(folder / BAG, dict(enumerate(progress.connections)), progress.size)
        if self._bag.lost:
            progress.why_not = progress.why_not or "the disk lost the last data written"
        self._numbers = {_key(header): number for number, header in enumerate(progress.connections)}
        self._records_fit = True
        self._headers = sum(map(connection_size, progress.connections))
        self._left_out = set(progress.left_out)
        self._topics = {(row.topic, row.type, row.md5sum): row for row in progress.topics}
        places = progress.places or [{} for _ring in rings]
        self._readers = [RingReader(ring, dict(read)) for ring, read in zip(rings, places, strict=False)]
        if not progress.following:
            progress.following = [{} for _ring in rings]
            progress.not_there = [reader.not_there for reader in self._readers]

    @property
    def opened(self) -> OpenRecording:
        progress = self.progress
        return OpenRecording(progress.id, progress.began, progress.ends, progress.triggers[0])

    def step(self, now: int) -> None:
        """Read messages up to `now`: a later one has a time of a clock that was just set forward."""
        progress = self.progress
        for number, reader in enumerate(self._readers):
            for found in reader.read(progress.began, min(progress.ends, now + CLOCK_STEP)):
                self._take(found, progress.following[number])
        progress.places = [reader.places for reader in self._readers]
        progress.reached = max(progress.reached, min(progress.ends, now))
        new = self._folder / f"{PROGRESS}.new"
        new.write_bytes(msgspec.msgpack.encode(progress))
        new.replace(self._folder / PROGRESS)

    def _take(self, frames: StreamFrames, following: dict[int, int]) -> None:
        progress, header = self.progress, frames.header
        if LEFT_OUT in header:
            self._leave_out(header, seen=bool(frames.batches))
            return
        if frames.torn and frames.stream not in following and header["topic"] not in progress.torn:
            progress.torn.append(header["topic"])
        if not frames.batches:
            return
        heads = {
            batch.carried: header if batch.carried else header | {CARRIED: "0"} for batch in frames.batches
        }
        fitting = {
            carried: head
            for carried, head in heads.items()
            if _key(head) in self._numbers or self._headers + connection_size(head) <= _MAX_HEADERS
        }
        if not fitting:
            progress.unconnected += sum(len(batch.frames) for batch in frames.batches)
            return
        row = self._topics.get(kind := (header["topic"], header["type"], header["md5sum"]))
        if row is None:
            row = self._topics[kind] = RecordedTopic(*kind, 0, 0, 0)
            progress.topics.append(row)
        waiting: list[BagMessage] = []
        size = empty = chunk_size(header)
        for batch in frames.batches:
            gap = max(0, batch.first - following.get(frames.stream, batch.first))
            row.missed = min(row.missed + gap, MAX_MESSAGES)
            following[frames.stream] = batch.first + len(batch.frames)
            if batch.carried not in fitting:
                progress.unconnected += len(batch.frames)
                continue
            bodies = sum(map(len, batch.frames))
            longer = size + bodies + MESSAGE_SIZE * len(batch.frames)
            if self._bag.closed_size + longer > self._largest - self._largest // _FOR_RECORDS:
                progress.why_not = f"it reached {self._largest} bytes, an eighth of recorder.disk"
                row.missed += len(batch.frames)
                continue
            connection, size = self._connection(fitting[batch.carried]), longer
            waiting += [BagMessage(connection, batch.time, frame) for frame in batch.frames]
            row.messages += len(batch.frames)
            row.bytes += bodies
            if size > _CHUNK:
                progress.size = self._bag.write(waiting)
                waiting, size = [], empty
        progress.size = self._bag.write(waiting)

    def _leave_out(self, header: dict[str, str], *, seen: bool) -> None:
        """Note, once, a publisher whose messages are not recorded, if it sent any."""
        progress = self.progress
        row = LeftOutTopic(header["topic"], header["type"], header.get("host", ""), header[LEFT_OUT])
        if seen and row not in self._left_out:
            self._left_out.add(row)
            progress.claims += row.why != NAMED
            if len(progress.left_out) < _MAX_LEFT_OUT:
                progress.left_out.append(row)

    def _connection(self, header: dict[str, str]) -> int:
        number = self._numbers.get(_key(header))
        if number is None:
            number = self._numbers[_key(header)] = self._bag.connect(header)
            self.progress.connections.append(dict(header))
            self._headers += connection_size(header)
        return number

    def leave(self) -> None:
        self._bag.leave()

    def finish(self, records: Iterable[LogEntry], revisions: RevisionsStated) -> Recording:
        progress = self.progress
        self._write_records(records)
        self._bag.close()
        bag = self._folder / BAG
        with bag.open("rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
            os.fchmod(file.fileno(), 0o640)
            os.fsync(file.fileno())
        why_not = self._missing()
        recording = Recording(
            id=progress.id,
            began=progress.began,
            ended=progress.ends,
            triggers=progress.triggers,
            topics=list(progress.topics),
            policy=revisions.policy,
            monitors=revisions.monitors,
            size=bag.stat().st_size,
            sha256=sha256,
            complete=not why_not,
            why_not=why_not,
            left_out=progress.left_out,
            charged_to=progress.charged_to,
        )
        about = msgspec.json.format(msgspec.json.encode(recording)) + b"\n"
        write_whole(self._folder / ABOUT, about, 0o640)
        return recording

    def _missing(self) -> str:
        progress = self.progress
        reasons = [progress.why_not] if progress.why_not else []
        if not self._records_fit:
            reasons.append("later audit records did not fit (the audit log has them)")
        missed = sum(row.missed for row in progress.topics)
        if missed:
            reasons.append(f"{counted(missed, 'message')} did not fit (see topics)")
        if progress.unconnected:
            reasons.append(f"{counted(progress.unconnected, 'message')} of too many different connections")
        if progress.claims:
            claims = [row.topic for row in progress.left_out if row.why != NAMED][:_MAX_NAMED]
            named = ", ".join(claims) + (" and others" if progress.claims > len(claims) else "")
            reasons.append(f"left out because of the publisher's type (recorder.never): {named}")
        if progress.torn:
            named = ", ".join(progress.torn[:_MAX_NAMED]) + (
                " and others" if progress.torn[_MAX_NAMED:] else ""
            )
            reasons.append(f"the beginning was no longer in recorder.memory: {named}")
        for reader, (missed_before, refused_before) in zip(self._readers, progress.not_there, strict=False):
            missed_now, refused_now = reader.not_there
            if missed_now > missed_before:
                reasons.append(
                    f"{counted(missed_now - missed_before, 'message was', 'messages were')} too long for"
                    " recorder.memory"
                )
            if refused_now > refused_before:
                reasons.append(
                    f"{counted(refused_now - refused_before, 'connection')} did not fit in recorder.memory"
                )
        return "; ".join(reasons)

    def _write_records(self, records: Iterable[LogEntry]) -> None:
        """Write each record as JSON, and as a log message for rqt_console, as far as they fit."""
        definitions = standard_definitions()
        headers = [
            {
                "topic": topic,
                "type": kind,
                "md5sum": definitions.md5sum(kind),
                "message_definition": definitions.full_text(kind),
                "callerid": "/rosrv",
                "latching": "0",
            }
            for topic, kind in ((RECORDS, "std_msgs/String"), (LOG, TYPE))
        ]
        of_record, of_log = map(self._connection, headers)
        waiting: list[BagMessage] = []
        size = empty = sum(map(chunk_size, headers))
        for number, entry in enumerate(records):
            record = entry.record
            line = as_json(entry).encode()
            text = f"{record.event}: {record.reason}" if record.reason else record.event
            level = _LEVELS.get(record.severity, INFO)
            file, function = record.resource or "", record.caller_id or ""
            said = log_message(
                entry.sequence, record.time, level, "/rosrv", text, file=file, function=function
            )
            size += len(line) + _LENGTH.size + len(said) + 2 * MESSAGE_SIZE
            if number == MAX_RECORDS or self._bag.closed_size + size > self._largest:
                self._records_fit = False
                break
            waiting.append(BagMessage(of_record, record.time, _LENGTH.pack(len(line)) + line))
            waiting.append(BagMessage(of_log, record.time, said))
            if size > _CHUNK:
                self._bag.write(waiting)
                waiting, size = [], empty
        self._bag.write(waiting)


def _key(header: dict[str, str]) -> tuple[tuple[str, str], ...]:
    return tuple(sorted(header.items()))
