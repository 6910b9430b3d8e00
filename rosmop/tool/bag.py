"""Run monitors on a bag, and write the messages that subscribers would have received into another bag.

Messages of a topic with a different definition than the specifications expect are dropped.
"""

import struct
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from types import TracebackType

from rosbags.interfaces import Connection, ConnectionExtRosbag1
from rosbags.rosbag1 import ReaderError, Writer
from rosbags.rosbag1.writer import WriterError

from rosmop.run.engine import MonitorSet
from rosmop.run.outcomes import MessageSender, Outcome, Verdict, bound
from rosmop.tool.bounded_bag import BoundedReader
from rosmop.tool.command_context import CommandContext
from roswire.definitions import Definitions
from roswire.errors import DefinitionError
from roswire.message_text import MessageDefinition

_OWN = "/rosrv"  # caller id of messages that monitors publish; monitors do not receive them
# The exceptions that `rosbags` and its decompressors raise for a damaged bag.
_DAMAGE = (
    ReaderError, ValueError, LookupError, AssertionError, struct.error, MemoryError, OverflowError, OSError,
    EOFError, RuntimeError,
)  # fmt: skip


@dataclass(frozen=True)
class ReplayStep:
    """The outcome of one message or, without a topic, of a tick or deadline."""

    outcome: Outcome
    index: int | None = None
    topic: str | None = None


def ros_type(name: str) -> str:
    """Return `package/Type` for the bag reader's `package/msg/Type`."""
    package, _, kind = name.partition("/")
    return f"{package}/{kind.rpartition('/')[2]}"


def open_bag(program: CommandContext, path: Path) -> BoundedReader:
    """Open a recording. Raises a usage error for a file that is not a bag."""
    try:
        reader = BoundedReader(program, path)
        reader.open()
    except _DAMAGE as error:
        advice = (
            "; it must be a ROS 1 bag; `rosbag reindex` repairs a truncated bag" if path.is_file() else ""
        )
        raise program.usage_error(
            f"cannot read the bag {path}: {_text_of(error).rstrip('.')}{advice}"
        ) from error
    return reader


def messages_of(reader: BoundedReader) -> Iterator[tuple[Connection, int, bytes]]:
    """Yield connection, time in nanoseconds and bytes of every message, in order.

    Raises a usage error for a damaged bag.
    """
    try:
        yield from reader.in_order()
    except _DAMAGE as error:
        raise reader.program.usage_error(f"the bag {reader.path} is damaged: {_text_of(error)}") from error


def _text_of(error: Exception) -> str:
    return str(error) or type(error).__name__


def definitions_of(reader: BoundedReader) -> Definitions:
    """Return the message definitions in the bag, without those that cannot be parsed."""
    found: dict[str, MessageDefinition] = {}
    sent = dict.fromkeys((ros_type(row.msgtype), row.msgdef.data) for row in reader.connections)
    for name, text in sent:
        try:
            own = Definitions.from_full_text(name, text)
        except DefinitionError:
            continue
        found |= {kind: own.message(kind) for kind in own.message_types}
    return Definitions(found)


class RecordedBag:
    """The messages of a bag on topics that match a pattern, read again for each pass.

    `definitions` has the message definitions of the bag. Raises a usage error for a bag that cannot be read, has no
    messages, or has two types on one topic.
    """

    def __init__(self, program: CommandContext, path: Path, patterns: Sequence[str]) -> None:
        self._program = program
        self._path = path
        self.name = path.name
        self.topics: dict[str, str] = {}
        with closing(open_bag(program, path)) as reader:
            self.began, self.ended = reader.start_time, reader.end_time - 1
            self.message_count = reader.message_count
            if not self.message_count:
                raise program.usage_error(f"the bag {path} has no messages")
            self.definitions = definitions_of(reader)
            for connection in reader.connections:
                if not _fits(connection, patterns):
                    continue
                kind = ros_type(connection.msgtype)
                other = self.topics.setdefault(connection.topic, kind)
                if other != kind:
                    raise program.usage_error(f"{path}: {connection.topic} carries both {other} and {kind}")

    def messages(self) -> Iterator[tuple[str, int, bytes]]:
        """Yield topic, time in nanoseconds and bytes of every message, in order."""
        with closing(open_bag(self._program, self._path)) as reader:
            for connection, time_ns, data in messages_of(reader):
                if connection.topic in self.topics:
                    yield connection.topic, time_ns, data


# Topic, type, definition, md5sum, caller, latching
_Header = tuple[str, str, str, str, str | None, int | None]


class OutputBag:
    """Write a bag of the messages that subscribers would have received."""

    def __init__(self, program: CommandContext, path: Path, definitions: Definitions) -> None:
        self._path = path
        self._definitions = definitions
        self._connections: dict[_Header, Connection] = {}
        try:
            self._writer = Writer(path)
            self._writer.open()
        except (WriterError, OSError) as error:
            raise program.usage_error(f"cannot write the bag {path}: {error}") from error

    def __enter__(self) -> "OutputBag":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.close()

    def relay(self, connection: Connection, time_ns: int, data: bytes) -> None:
        """Write a message of a recorded publisher."""
        sent = connection.topic, connection.msgtype, connection.msgdef.data, connection.digest
        self._write((*sent, *_sender(connection)), time_ns, data)

    def publish(self, outcome: Outcome) -> None:
        """Write the messages that monitors published."""
        for message in outcome.published:
            package, _, kind = message.type.partition("/")
            text, digest = self._definitions.full_text(message.type), self._definitions.md5sum(message.type)
            header = (message.topic, f"{package}/msg/{kind}", text, digest, _OWN, None)
            self._write(header, outcome.time, message.data)

    def _write(self, header: _Header, time_ns: int, data: bytes) -> None:
        if header not in self._connections:
            topic, kind, text, digest, caller, latching = header
            self._connections[header] = self._writer.add_connection(
                topic, kind, msgdef=text, md5sum=digest, callerid=caller, latching=latching
            )
        self._writer.write(self._connections[header], time_ns, data)


def _sender(connection: Connection) -> ConnectionExtRosbag1:
    """Return the caller id of a recorded publisher, and whether it latches."""
    assert isinstance(connection.ext, ConnectionExtRosbag1)  # noqa: S101  `BoundedReader` reads no other bags
    return connection.ext


def replay(
    monitors: MonitorSet,
    reader: BoundedReader,
    output: OutputBag | None,
    topics: Sequence[str] = ("*",),
    span: tuple[int, int] = (0, 1 << 63),
) -> Iterator[ReplayStep]:
    """Run the monitors on the messages of a bag, in its order and by its clock.

    `topics` are patterns; `span` is the first and last time in nanoseconds since the epoch.
    """
    started: Outcome | None = None
    refusals = {
        connection.id: _refusal(monitors, connection)
        for connection in reader.connections
        if _fits(connection, topics) and _sender(connection).callerid != _OWN
    }
    expected = frozenset(
        connection.topic for connection in reader.connections if refusals.get(connection.id, "") is None
    )
    begun = False
    selection = _ExplainOnce()
    monitors.explain_when(selection, selection)
    for index, (connection, time_ns, data) in enumerate(messages_of(reader)):
        if connection.id not in refusals or not span[0] <= time_ns <= span[1]:
            continue
        if not begun:
            started, begun = monitors.start(time_ns, expected), True
        selection.now = time_ns
        outcome = _outcome(
            monitors, connection, time_ns, data, refusals[connection.id], MessageSender(index + 1)
        )
        if started is not None:
            outcome = _after(started, outcome)
            started = None
        for earlier in outcome.before:
            if output is not None:
                output.publish(earlier)
            yield ReplayStep(earlier)
        if output is not None:
            if outcome.result != "dropped":
                output.relay(connection, time_ns, bytes(outcome.buffer))
            output.publish(outcome)
        yield ReplayStep(outcome, index, connection.topic)


class _ExplainOnce:
    """Select verdicts for explanation: in each second, the first of each category and binding of a property."""

    def __init__(self) -> None:
        self.now = 0
        self._second = 0
        self._explained: set[tuple[str, int, str, str]] = set()

    def __call__(self, verdict: Verdict, _source: int) -> bool:
        if self._second != self.now // 10**9:
            self._second = self.now // 10**9
            self._explained.clear()
        key = verdict.monitor, verdict.property, verdict.category, bound(verdict)
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
    """Return the outcome of the first message, with the output of `init` in front."""
    outcome.log = [*started.log, *outcome.log]
    outcome.published = [*started.published, *outcome.published]
    outcome.faults = [*started.faults, *outcome.faults]
    return outcome


def _refusal(monitors: MonitorSet, connection: Connection) -> str | None:
    """Return why the monitors drop the messages of a connection, or None."""
    wanted = monitors.topics.get(connection.topic)
    if wanted is None:
        return None
    kind = ros_type(connection.msgtype)
    if kind != wanted:
        return f"{connection.topic} carries {kind}, but the specifications expect {wanted}"
    if connection.digest not in ("*", monitors.md5sum(wanted)):
        return f"the publisher of {connection.topic} has a different definition of {kind} than the specifications"
    return None


def _fits(connection: Connection, topics: Sequence[str]) -> bool:
    return any(fnmatchcase(connection.topic, pattern) for pattern in topics)


def refusals(monitors: MonitorSet, reader: BoundedReader, topics: Sequence[str] = ("*",)) -> list[str]:
    """Return the reasons why messages on topics that match a pattern are dropped."""
    found = [_refusal(monitors, connection) for connection in reader.connections if _fits(connection, topics)]
    return sorted({text for text in found if text is not None})
