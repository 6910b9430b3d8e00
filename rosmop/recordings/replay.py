"""Run monitors on a recording, and write a bag with the messages that subscribers would have received.

Messages are dropped if their topic's definition differs from that of the specifications.
"""

import struct
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Writer
from rosbags.rosbag1.writer import WriterError

from rosmop.recordings.recording import (
    OWN,
    Reader,
    RecordingError,
    inputs,
    messages_of,
    ros_type,
    sender_of,
)
from rosmop.run.engine import MonitorSet
from rosmop.run.outcomes import DROPPED, MessageSender, Outcome, Verdict, binding
from roswire.definitions import Definitions

EVER = (0, 1 << 63)
"""The span, in nanoseconds, of a whole recording."""


@dataclass(frozen=True)
class ReplayStep:
    """The outcome of a message, or of a tick or deadline if there is no topic.

    A message without an index was published by the monitor `publisher`, and judged by the monitors after it.
    """

    outcome: Outcome
    index: int | None = None
    topic: str | None = None
    publisher: str = ""


# Topic, type, definition, md5sum, caller, latching
_Header = tuple[str, str, str, str, str | None, int | None]


class OutputBag:
    """A bag that is being written.

    Tools order messages of the same time by their connections. To keep their order, a message before or after
    one of a monitor is at least a nanosecond later than its predecessor.
    """

    def __init__(self, path: Path, definitions: Definitions) -> None:
        self._path = path
        self._definitions = definitions
        self._connections: dict[_Header, Connection] = {}
        self._last, self._published = 0, False
        with self._errors():
            self._writer = Writer(path)
            self._writer.open()

    def __enter__(self) -> "OutputBag":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._errors():  # also after an error, what was written gets its index
            self._writer.__exit__(None, None, None)

    def relay(self, connection: Connection, time_ns: int, data: bytes) -> None:
        sent = connection.topic, connection.msgtype, connection.msgdef.data, connection.digest
        self._write((*sent, *sender_of(connection)), time_ns, data, published=False)

    def publish(self, outcome: Outcome) -> None:
        for message in (one for one in outcome.sent_messages() if not one.is_call):
            package, _, kind = message.type.partition("/")
            text, digest = self._definitions.full_text(message.type), self._definitions.md5sum(message.type)
            header = (message.topic, f"{package}/msg/{kind}", text, digest, OWN, None)
            self._write(header, outcome.time, message.data, published=True)
        for judged in outcome.judged.values():
            self.publish(judged)

    def _write(self, header: _Header, time_ns: int, data: bytes, *, published: bool) -> None:
        time_ns = max(time_ns, self._last + (published or self._published))
        self._last, self._published = time_ns, published
        with self._errors():
            if header not in self._connections:
                topic, kind, text, digest, caller, latching = header
                self._connections[header] = self._writer.add_connection(
                    topic, kind, msgdef=text, md5sum=digest, callerid=caller, latching=latching
                )
            self._writer.write(self._connections[header], time_ns, data)

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except (WriterError, OSError, ValueError, struct.error) as error:
            raise RecordingError(f"cannot write the bag {self._path}: {error}") from error


def replay(
    monitors: MonitorSet,
    reader: Reader,
    output: OutputBag | None,
    topics: Sequence[str] = ("*",),
    span: tuple[int, int] = EVER,
    *,
    own: str = OWN,
) -> Iterator[ReplayStep]:
    """Run monitors on a recording in its order, with its times as their clock, up to its end or that of the span.

    `topics` are patterns; `span` is the first and last time in nanoseconds since the epoch; `own` is the node name
    under which monitors published.
    """
    started: Outcome | None = None
    refusals = {connection.id: _refusal(monitors, connection) for connection in inputs(reader, topics, own)}
    expected = frozenset(
        connection.topic for connection in reader.connections if refusals.get(connection.id, "") is None
    )
    begun = False
    selection, caller = _ExplainOnce(), _Caller()
    monitors.name_senders(caller)
    monitors.explain_when(selection, selection)
    for index, (connection, time_ns, data) in enumerate(messages_of(reader)):
        if connection.id not in refusals or not span[0] <= time_ns <= span[1]:
            continue
        if not begun:
            started, begun = monitors.start(time_ns, expected), True
        selection.now, caller.name = time_ns, sender_of(connection).callerid or ""
        caller.host = reader.hosts.get(connection.id, "")
        outcome = _outcome(
            monitors, connection, time_ns, data, refusals[connection.id], MessageSender(index + 1)
        )
        if started is not None:
            outcome = _after(started, outcome)
            started = None
        yield from _timed(outcome.before, output)
        if output is not None:
            if outcome.result != "dropped":
                output.relay(connection, time_ns, bytes(outcome.buffer))
            output.publish(outcome)
        yield from _steps(ReplayStep(outcome, index, connection.topic))
    if begun:
        selection.now = reader.end_time - 1 if span[1] == EVER[1] else span[1]
        yield from _timed(monitors.advance(selection.now), output)


def _timed(outcomes: Iterable[Outcome], output: OutputBag | None) -> Iterator[ReplayStep]:
    for outcome in outcomes:
        if output is not None:
            output.publish(outcome)
        yield from _steps(ReplayStep(outcome))


def _steps(step: ReplayStep) -> Iterator[ReplayStep]:
    yield step
    for number, judged in step.outcome.judged.items():
        message = step.outcome.published[number]
        yield from _steps(ReplayStep(judged, None, message.topic, message.monitor))


class _Caller:
    """The sender of a recorded message; only the flight recorder notes its host."""

    host = name = ""

    def __call__(self, _source: int) -> tuple[str, str]:
        return self.host, self.name


class _ExplainOnce:
    def __init__(self) -> None:
        self.now = 0
        self._second = 0
        self._explained: set[tuple[str, int, str, str]] = set()

    def __call__(self, verdict: Verdict, _source: int) -> bool:
        if self._second != self.now // 10**9:
            self._second = self.now // 10**9
            self._explained.clear()
        key = verdict.monitor, verdict.property, verdict.category, binding(verdict)
        is_new = key not in self._explained
        self._explained.add(key)
        return is_new


def _outcome(  # noqa: PLR0917  a message and its facts
    monitors: MonitorSet,
    connection: Connection,
    time_ns: int,
    data: bytes,
    refusal: str | None,
    sender: MessageSender,
) -> Outcome:
    if refusal is None:
        return monitors.judge(connection.topic, data, time_ns, sender)
    outcome = Outcome(data, time_ns)
    outcome.result, outcome.reason, outcome.before = "dropped", refusal, monitors.advance(time_ns)
    return outcome


def _after(started: Outcome, outcome: Outcome) -> Outcome:
    shift = len(started.published)
    outcome.judged = {**started.judged, **{shift + number: one for number, one in outcome.judged.items()}}
    outcome.handling = {
        number if number == DROPPED else shift + number: one for number, one in outcome.handling.items()
    }
    outcome.log = [*started.log, *outcome.log]
    outcome.published = [*started.published, *outcome.published]
    outcome.faults = [*started.faults, *outcome.faults]
    return outcome


def _refusal(monitors: MonitorSet, connection: Connection) -> str | None:
    wanted = monitors.topics.get(connection.topic)
    if wanted is None:
        return None
    kind = ros_type(connection.msgtype)
    if kind != wanted:
        return f"{connection.topic} carries {kind}, but the specifications expect {wanted}"
    if connection.digest not in ("*", monitors.md5sum(wanted)):
        return f"the publisher of {connection.topic} has a different definition of {kind} than the specifications"
    return None


def refusals(
    monitors: MonitorSet,
    reader: Reader,
    topics: Sequence[str] = ("*",),
    *,
    own: str = OWN,
    strict: str | None = None,
) -> list[str]:
    """Return why connections are not judged.

    With `strict`, the recording's name, raise `RecordingError` if none of a topic's connections is.
    """
    rows = [(connection.topic, _refusal(monitors, connection)) for connection in inputs(reader, topics, own)]
    judged = {topic for topic, text in rows if text is None}
    for topic, text in sorted(rows, key=lambda row: row[1] or ""):
        if strict is not None and topic not in judged:
            raise RecordingError(f"{strict}: {text}")
    return sorted({text for _topic, text in rows if text is not None})
