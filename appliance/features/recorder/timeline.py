"""Compute a recording's timeline, and find its messages around a time.

Events come from the audit records in the bag, because retention may have removed them from the log. In the bag, a
publisher's header has a host, and the recorder's own header has none.
"""

import re
from collections import defaultdict, deque
from collections.abc import Collection, Iterable, Iterator, Mapping
from datetime import UTC, datetime, timedelta
from itertools import chain, islice
from pathlib import Path
from typing import Any, get_args

import msgspec

from appliance.audit.log.folding import FoldSettings
from appliance.audit.log.record import AuditRecord, Severity
from appliance.audit.log.record_format import without_binding
from appliance.audit.search.equality import times_of
from appliance.audit.search.query import Filter
from appliance.audit.search.search import export
from appliance.features.recorder.bag_reader import BagReader, MessagePosition
from appliance.features.recorder.bag_writer import INDEX_ENTRY
from appliance.features.recorder.recording import LOG, RECORDS
from appliance.features.recorder.recording_answers import (
    EventKind,
    EventMarks,
    RecordedEvent,
    RecordedFlow,
    RecordedMessage,
    RecordedMessages,
    Recording,
    Sender,
    Timeline,
)
from appliance.features.recorder.recording_plan import kinds_of
from appliance.features.recorder.ring import CARRIED
from roswire.message_view import PublisherReader

COLUMNS, MAX_COLUMNS = 200, 1000
NEIGHBOURS, MAX_NEIGHBOURS = 5, 25
MAX_TOPICS = 300
MAX_EVENTS = 500
_MAX_BYTES = 1 << 20  # bytes read of a message; people are shown far fewer
_LONGEST_RECORD = 1 << 22
_MAX_LATER = 20_000  # records after a recording that are searched for repetitions during it
_SECOND = 1_000_000_000
_ROUNDED = 1000  # nanoseconds by which a record's rounded time may differ from that of its message
_RECORD_ID = re.compile("[0-9a-f]{20}")
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_NOTABLE = (Severity.NOTICE, Severity.WARNING, Severity.ALARM)


class _Columns:
    def __init__(self, since: int, until: int, number: int) -> None:
        self.since, self.until, self.number = since, until, number
        self._width = (until - since) // number + 1

    def count(self, times: Iterable[int], counts: list[int]) -> None:
        for time in times:
            if self.since <= time <= self.until:
                counts[(time - self.since) // self._width] += 1

    def spread(self, first: int, last: int, number: int, counts: list[int]) -> None:
        first, last = min(first, last), max(first, last)
        for column in range(self._column(first), self._column(last) + 1):
            begin = self.since + column * self._width
            end = min(begin + self._width, self.until + 1)
            counts[column] += _part(number, first, last, end) - _part(number, first, last, begin)

    def _column(self, time: int) -> int:
        return (min(max(time, self.since), self.until) - self.since) // self._width

    def only(self, first: int, last: int) -> int | None:
        if first < self.since or last > self.until:
            return None
        column = (first - self.since) // self._width
        return column if (last - self.since) // self._width == column else None


def _part(number: int, first: int, last: int, time: int) -> int:
    return number * min(max(time - first, 0), last - first + 1) // (last - first + 1)


def timeline(
    recording: Recording,
    bag: Path,
    since: int | None = None,
    until: int | None = None,
    columns: int = COLUMNS,
    *,
    record: str = "",
    log: Path | None = None,
) -> Timeline:
    """Return the timeline; `since` and `until` are ns since the epoch.

    It lists the first events, or those around the event of the audit record with the id `record`. `log` is the audit
    log, for repetitions that it counted only after the recording's end.

    Raise `OSError`, `LogUnreadableError`, or `ValueError`.
    """
    start = recording.began if since is None else max(since, recording.began)
    end = recording.ended if until is None else min(until, recording.ended)
    if start >= end:
        raise ValueError("that time is outside the recording")
    wanted = _Columns(start, end, columns)
    with BagReader.of(bag) as reader:
        flows, counts = _flows(reader, wanted), defaultdict[str, list[int]](lambda: [0] * columns)
        listed = _Listed(record)
        later = [] if log is None else _counted_later(log, recording)
        for event, first, last in _events(chain(_records(reader, start), later)):
            if first <= end:
                wanted.spread(first, last, event.times, counts[event.kind])
            if event.time <= end:
                listed.add(event)
    kept = sorted(flows, key=lambda flow: -sum(flow.counts))[:MAX_TOPICS]
    return Timeline(
        recording.id,
        start,
        end,
        sorted(kept, key=lambda flow: flow.topic),
        len(flows) - len(kept),
        [EventMarks(kind, counts[kind]) for kind in get_args(EventKind) if kind in counts],
        listed.events,
        listed.happened - len(listed.events),
    )


class _Listed:
    """The first `MAX_EVENTS`, or those around the event of `record` if it comes later."""

    def __init__(self, record: str) -> None:
        self._record = record
        self._first: list[RecordedEvent] = []
        self._around: deque[RecordedEvent] = deque(maxlen=MAX_EVENTS)
        self._found = self.happened = 0
        """The number of events up to that of `record` (0: none yet), and of all events."""

    @property
    def events(self) -> list[RecordedEvent]:
        return list(self._around) if self._found > MAX_EVENTS else self._first

    def add(self, event: RecordedEvent) -> None:
        self.happened += 1
        if event.record == self._record:
            self._found = self.happened
        if len(self._first) < MAX_EVENTS:
            self._first.append(event)
        if not self._found or self.happened < self._found + MAX_EVENTS // 2:
            self._around.append(event)


def _flows(reader: BagReader, wanted: _Columns) -> list[RecordedFlow]:
    flows: dict[tuple[str, str], RecordedFlow] = {}
    of: dict[int, RecordedFlow] = {}
    for number in _of_nodes(reader):
        header = reader.connections[number]
        kind = (header["topic"], header["type"])
        flow = of[number] = flows.setdefault(kind, RecordedFlow(*kind, [], [0] * wanted.number))
        if (sender := _sender(header)) not in flow.senders:
            flow.senders.append(sender)
    for chunk in reader.chunks:
        if chunk.first > wanted.until or chunk.last < wanted.since:
            continue
        column = wanted.only(chunk.first, chunk.last)
        for number, entries in reader.index(chunk):
            if number not in of:
                continue
            if column is not None:
                of[number].counts[column] += len(entries) // INDEX_ENTRY.size
            else:
                times = (entry[0] * _SECOND + entry[1] for entry in INDEX_ENTRY.iter_unpack(entries))
                wanted.count(times, of[number].counts)
    return list(flows.values())


def _counted_later(log: Path, recording: Recording) -> list[AuditRecord]:
    ended = recording.ended
    written = Filter(since=ended + 1, until=ended + int((FoldSettings().seconds + 1) * _SECOND))
    found = (entry.record for entry in islice(export(log, written), _MAX_LATER))
    return [one for one in found if _is_before(one.detail.get("first_time"), ended)]


def _is_before(time: object, end: int) -> bool:
    return isinstance(time, int) and time <= end


def _events(records: Iterable[AuditRecord]) -> Iterator[tuple[RecordedEvent, int, int]]:
    """Yield the events of records, each of which may count several between a first and a last time."""
    for said in records:
        kind = _kind(said)
        if kind is None:
            continue
        time, times = said.time, times_of(said.event, said.detail)
        first, last = map(said.detail.get, ("first_time", "last_time"))
        spread = times > 1 and isinstance(first, int) and isinstance(last, int)
        event = RecordedEvent(
            time=time,
            kind=kind,
            record=said.id,
            event=said.event,
            severity=said.severity.value,
            decision=said.decision,
            host=said.host,
            caller_id=said.caller_id,
            resource=said.resource,
            reason=without_binding(said.reason, said.detail),
            times=times,
        )
        yield event, *((first, last) if spread else (time, time))


def _records(reader: BagReader, since: int = 0) -> Iterator[AuditRecord]:
    numbers = {
        number
        for number, header in reader.connections.items()
        if header["topic"] == RECORDS and "host" not in header
    }
    for place, _number in reader.messages(numbers, since):
        _size, body = reader.body(place, _LONGEST_RECORD)
        said = msgspec.json.decode(body[4:], type=dict[str, Any])
        yield msgspec.convert(said | {"time": place.time}, AuditRecord)


def _kind(said: AuditRecord) -> EventKind | None:
    kinds = kinds_of(said.event, said.decision, said.severity)
    if kinds:
        return kinds[0]  # type: ignore[return-value]  # a record's kinds of trigger are kinds of event
    if said.decision == "would deny":
        return "denial"
    return "notice" if said.severity in _NOTABLE else None


def is_record(text: str) -> bool:
    return _RECORD_ID.fullmatch(text) is not None


def messages_around(
    recording: Recording,
    bag: Path,
    at: int | MessagePosition | str,
    topics: Collection[str] = (),
    neighbours: int = NEIGHBOURS,
) -> RecordedMessages:
    """Return at most `neighbours` messages on each side of `at`: a time, a position or the id of an audit record.

    The message of a time is the last one at or before it; that of a record is the message that the record is
    about, or else the message of its time.
    """
    with BagReader.of(bag) as reader:
        wanted = {
            number
            for number in _of_nodes(reader)
            if not topics or reader.connections[number]["topic"] in topics
        }
        place = _place_of_record(reader, recording, at, wanted) if isinstance(at, str) else at
        if not isinstance(place, MessagePosition):
            place = _last_until(reader, place, wanted)
        before = reader.before(place, wanted, neighbours)
        later = (found for found in reader.messages(wanted, place.time) if found[0] >= place)
        readers: dict[int, PublisherReader] = {}
        messages = []
        for found, number in [*before, *islice(later, neighbours + 1)]:
            header = reader.connections[number]
            if number not in readers:
                readers[number] = PublisherReader(header)
            size, data = reader.body(found, _MAX_BYTES)
            fields, why = readers[number].read(data)
            messages.append(
                RecordedMessage(
                    found.time,
                    str(found),
                    header["topic"],
                    header["type"],
                    _sender(header),
                    size,
                    fields,
                    why,
                    header.get(CARRIED) != "0",
                )
            )
    return RecordedMessages(recording.id, messages, len(before))


def _last_until(reader: BagReader, time: int, wanted: Collection[int]) -> MessagePosition:
    for place, _number in reader.before(MessagePosition(time + 1, 0, 0), wanted, 1):
        return place
    return MessagePosition(time, 0, 0)


def _place_of_record(
    reader: BagReader, recording: Recording, record: str, wanted: Collection[int]
) -> MessagePosition | int:
    """Return the position of the message that a record is about, or the record's time if the bag lacks it.

    A monitor's record has the time of its message. Messages that were received together also have the same time, so
    their first bytes are compared as well.
    """
    said = next((audit_record for audit_record in _records(reader) if audit_record.id == record), None)
    if said is None:
        times = [trigger.time for trigger in recording.triggers if trigger.record == record]
        if not times:
            raise ValueError(f"the recording has no record {record}")
        return times[0]
    happened = said.detail.get("happened")
    if not isinstance(happened, str):
        return said.time
    time = (datetime.fromisoformat(happened) - _EPOCH) // timedelta(microseconds=1) * 1000
    own = {number for number in wanted if _is_sender(reader.connections[number], said)}
    start = bytes.fromhex(str(said.detail.get("before", "")))
    chosen: MessagePosition | None = None
    for place, _number in reader.messages(own, time - _ROUNDED):
        if place.time > time + _ROUNDED:
            break
        if chosen is None or reader.body(place, len(start))[1] == start:
            chosen = place
    return time if chosen is None else chosen


def _is_sender(header: Mapping[str, str], said: AuditRecord) -> bool:
    sender = _sender(header)
    return (header["topic"], sender.host, sender.node) == (
        said.resource,
        said.host or "",
        said.caller_id or "",
    )


def _of_nodes(reader: BagReader) -> Iterator[int]:
    for number, header in reader.connections.items():
        if header["topic"] not in (RECORDS, LOG) or "host" in header:
            yield number


def _sender(header: Mapping[str, str]) -> Sender:
    return Sender(header.get("callerid", ""), header.get("host", ""))
