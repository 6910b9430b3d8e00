"""Compute a recording's timeline, and find its messages around a time, for the analysis of an incident.

The numbers of columns, topics, events and messages are limited, however large the recording is. Omissions are reported.
`roswire/message_view.py` bounds the values shown of a message.

Events come from the audit records in the bag, because retention may have removed them from the log since. In the bag, a
publisher's header has a host, and the recorder's own header has none.
"""

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any, get_args

import msgspec

from appliance.audit.record import Severity
from appliance.audit.record_format import without_binding
from appliance.channel.answers.recording_answers import (
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
from appliance.recorder.bag_reader import BagReader, MessagePosition
from appliance.recorder.bag_writer import INDEX_ENTRY
from appliance.recorder.recording import LOG, RECORDS
from appliance.recorder.triggers import kinds_of
from roswire.message_view import PublisherReader

COLUMNS, MOST_COLUMNS = 200, 1000
NEIGHBOURS, MOST_NEIGHBOURS = 5, 25
MOST_TOPICS = 300
MOST_EVENTS = 500
_MOST_BYTES = 1 << 20  # bytes read of a message; people are shown far fewer
_LONGEST_RECORD = 1 << 22
_SECOND = 1_000_000_000
_NOTABLE = (Severity.NOTICE, Severity.WARNING, Severity.ALARM)


class _Said(msgspec.Struct):
    """The fields of an audit record that are used here."""

    id: str
    event: str
    severity: Severity
    decision: str | None = None
    host: str | None = None
    caller_id: str | None = None
    resource: str | None = None
    reason: str = ""
    detail: dict[str, Any] = {}


class _Columns:
    """Columns of equal length that divide the time from `since` to `until` (both inclusive)."""

    def __init__(self, since: int, until: int, number: int) -> None:
        self.since, self.until, self.number = since, until, number
        self._width = (until - since) // number + 1

    def count(self, times: Iterable[int], counts: list[int]) -> None:
        """Count each time in its column; ignore times outside."""
        for time in times:
            if self.since <= time <= self.until:
                counts[(time - self.since) // self._width] += 1

    def only(self, first: int, last: int) -> int | None:
        """Return the column that contains both times; None if no column does."""
        if first < self.since or last > self.until:
            return None
        column = (first - self.since) // self._width
        return column if (last - self.since) // self._width == column else None


def timeline(
    recording: Recording,
    bag: Path,
    since: int | None = None,
    until: int | None = None,
    columns: int = COLUMNS,
) -> Timeline:
    """Return the timeline from `since` to `until` (nanoseconds since the epoch; None: the recording's start or end).

    Raises `OSError`, and `ValueError` if the recording has no such time or the bag is invalid.
    """
    start = recording.began if since is None else max(since, recording.began)
    end = recording.ended if until is None else min(until, recording.ended)
    if start >= end:
        raise ValueError("that time is outside the recording")
    wanted = _Columns(start, end, columns)
    with BagReader.of(bag) as reader:
        flows, counts = _flows(reader, wanted), defaultdict[str, list[int]](lambda: [0] * columns)
        events: list[RecordedEvent] = []
        happened = 0
        for event in _events(reader, start, end):
            wanted.count((event.time,), counts[event.kind])
            happened += 1
            if len(events) < MOST_EVENTS:
                events.append(event)
    kept = sorted(flows, key=lambda flow: -sum(flow.counts))[:MOST_TOPICS]
    return Timeline(
        recording.id,
        start,
        end,
        sorted(kept, key=lambda flow: flow.topic),
        len(flows) - len(kept),
        [EventMarks(kind, counts[kind]) for kind in get_args(EventKind) if kind in counts],
        events,
        happened - len(events),
    )


def _flows(reader: BagReader, wanted: _Columns) -> list[RecordedFlow]:
    """Return the number of messages on each topic in each column."""
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


def _events(reader: BagReader, since: int, until: int) -> Iterator[RecordedEvent]:
    """Yield the events of a period, in order."""
    records = {
        number
        for number, header in reader.connections.items()
        if header["topic"] == RECORDS and "host" not in header
    }
    for place, _number in reader.messages(records, since):
        if place.time > until:
            return
        _size, body = reader.body(place, _LONGEST_RECORD)
        said = msgspec.json.decode(body[4:], type=_Said)
        kind = _kind(said)
        if kind is not None:
            yield RecordedEvent(
                time=place.time,
                kind=kind,
                record=said.id,
                event=said.event,
                severity=said.severity.value,
                decision=said.decision,
                host=said.host,
                caller_id=said.caller_id,
                resource=said.resource,
                reason=without_binding(said.reason, said.detail),
            )


def _kind(said: _Said) -> EventKind | None:
    """Return the kind of event that the timeline shows for a record; None if the record is not shown."""
    kinds = kinds_of(said.event, said.decision, said.severity)
    if kinds:
        return kinds[0]  # type: ignore[return-value]  # a record's kinds of trigger are kinds of event
    if said.decision == "would deny":
        return "denial"
    return "notice" if said.severity in _NOTABLE else None


def messages_around(
    recording: Recording,
    bag: Path,
    at: int | MessagePosition,
    topics: Collection[str] = (),
    neighbours: int = NEIGHBOURS,
) -> RecordedMessages:
    """Return at most `neighbours` messages before a time or position, and at most one more from it on.

    `topics` limits the result to these topics (empty: all). Raises `OSError`, and `ValueError` if the bag is invalid.
    """
    place = at if isinstance(at, MessagePosition) else MessagePosition(at, 0, 0)
    with BagReader.of(bag) as reader:
        wanted = {
            number
            for number in _of_nodes(reader)
            if not topics or reader.connections[number]["topic"] in topics
        }
        before = reader.before(place, wanted, neighbours)
        later = (found for found in reader.messages(wanted, place.time) if found[0] >= place)
        readers: dict[int, PublisherReader] = {}
        messages = []
        for found, number in [*before, *islice(later, neighbours + 1)]:
            header = reader.connections[number]
            if number not in readers:
                readers[number] = PublisherReader(header)
            size, data = reader.body(found, _MOST_BYTES)
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
                )
            )
    return RecordedMessages(recording.id, messages, len(before))


def _of_nodes(reader: BagReader) -> Iterator[int]:
    """Yield the connections of publishers; omit those of the recorder itself."""
    for number, header in reader.connections.items():
        if header["topic"] not in (RECORDS, LOG) or "host" in header:
            yield number


def _sender(header: Mapping[str, str]) -> Sender:
    return Sender(header.get("callerid", ""), header.get("host", ""))
