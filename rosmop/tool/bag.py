"""Recordings: a bag goes through the monitors, and what subscribers would have received into another bag.

A topic whose messages have another definition than the specifications mean is refused: its messages are dropped.
"""

import struct
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from types import TracebackType

from rosbags.interfaces import Connection
from rosbags.rosbag1 import ReaderError, Writer
from rosbags.rosbag1.writer import WriterError

from rosmop.run.causes import Sender
from rosmop.run.engine import MonitorSet
from rosmop.run.outcomes import Outcome, Verdict, bound
from rosmop.tool.bounded_bag import BoundedReader
from rosmop.tool.program import Program
from roswire.definitions import Definitions
from roswire.errors import DefinitionError
from roswire.message_text import MessageDefinition

_OWN = "/rosrv"  # the appliance: what monitors publish is not given to monitors
# What `rosbags` and what unpacks for it raise for a damaged bag, beside an error of their own.
_DAMAGE = (
    ReaderError, ValueError, LookupError, AssertionError, struct.error, MemoryError, OverflowError, OSError,
    EOFError, RuntimeError,
)  # fmt: skip


@dataclass(frozen=True)
class Replayed:
    """What came of one message (or, without a topic, of a tick or deadline)."""

    outcome: Outcome
    index: int | None = None
    topic: str | None = None


def ros_type(name: str) -> str:
    """`package/Type` of the name that the bag reader gives a type, `package/msg/Type`."""
    package, _, kind = name.partition("/")
    return f"{package}/{kind.rpartition('/')[2]}"


def open_bag(program: Program, path: Path) -> BoundedReader:
    """An open recording, or an end with the reason."""
    try:
        reader = BoundedReader(program, path)
        reader.open()
    except _DAMAGE as error:
        mend = (
            "; it takes a bag of ROS 1, and `rosbag reindex` mends one that was cut off"
            if path.is_file()
            else ""
        )
        raise program.usage_error(
            f"cannot read the bag {path}: {_said_by(error).rstrip('.')}{mend}"
        ) from error
    return reader


def messages_of(reader: BoundedReader) -> Iterator[tuple[Connection, int, bytes]]:
    """Connection, nanoseconds and bytes of every message, in the order of the bag, or an end with the reason."""
    try:
        yield from reader.in_order()
    except _DAMAGE as error:
        raise reader.program.usage_error(f"the bag {reader.path} is damaged: {_said_by(error)}") from error


def _said_by(error: Exception) -> str:
    return str(error) or type(error).__name__


def definitions_of(reader: BoundedReader) -> Definitions:
    """Return the definitions that the recorded publishers sent; those that cannot be read are left out."""
    found: dict[str, MessageDefinition] = {}
    sent = dict.fromkeys((ros_type(row.msgtype), row.msgdef.data) for row in reader.connections)
    for name, text in sent:
        try:
            own = Definitions.from_full_text(name, text)
        except DefinitionError:
            continue
        found |= {kind: own.message(kind) for kind in own.message_types}
    return Definitions(found)


class Recorded:
    """A bag as the learner takes it: read anew for each pass, and only the topics that fit one of the patterns.

    `definitions` are those that its publishers sent. Raises `typer.BadParameter` for a bag that cannot be read or has
    two types on one topic.
    """

    def __init__(self, program: Program, path: Path, patterns: Sequence[str]) -> None:
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
        """Topic, nanoseconds and bytes of every message, in the order of the bag."""
        with closing(open_bag(self._program, self._path)) as reader:
            for connection, time_ns, data in messages_of(reader):
                if connection.topic in self.topics:
                    yield connection.topic, time_ns, data


# Topic, type, definition, md5sum, caller, latching
_Header = tuple[str, str, str, str, str | None, int | None]


class Recording:
    """The bag that is written: what subscribers would have received."""

    def __init__(self, program: Program, path: Path, definitions: Definitions) -> None:
        self._path = path
        self._definitions = definitions
        self._connections: dict[_Header, Connection] = {}
        try:
            self._writer = Writer(path)
            self._writer.open()
        except (WriterError, OSError) as error:
            raise program.usage_error(f"cannot write the bag {path}: {error}") from error

    def __enter__(self) -> "Recording":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.close()

    def relay(self, connection: Connection, time_ns: int, data: bytes) -> None:
        """Write a message of a recorded publisher."""
        caller = getattr(connection.ext, "callerid", None)
        latching = getattr(connection.ext, "latching", None)
        sent = connection.topic, connection.msgtype, connection.msgdef.data, connection.digest
        self._write((*sent, caller, latching), time_ns, data)

    def publish(self, outcome: Outcome) -> None:
        """Write what monitors published."""
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


def replay(
    monitors: MonitorSet,
    reader: BoundedReader,
    output: Recording | None,
    topics: Sequence[str] = ("*",),
    span: tuple[int, int] = (0, 1 << 63),
) -> Iterator[Replayed]:
    """Give the messages of a bag on these topics (patterns), from a moment to another (nanoseconds since the epoch), to
    the monitors, in its order and with its clock.
    """
    started: Outcome | None = None
    refusals = {
        connection.id: _refusal(monitors, connection)
        for connection in reader.connections
        if _fits(connection, topics) and getattr(connection.ext, "callerid", None) != _OWN
    }
    expected = frozenset(
        connection.topic for connection in reader.connections if refusals.get(connection.id, "") is None
    )
    begun = False
    asked = _Asked()
    monitors.explain_when(asked, asked)
    for index, (connection, time_ns, data) in enumerate(messages_of(reader)):
        if connection.id not in refusals or not span[0] <= time_ns <= span[1]:
            continue
        if not begun:
            started, begun = monitors.start(time_ns, expected), True
        asked.now = time_ns
        outcome = _outcome(monitors, connection, time_ns, data, refusals[connection.id], Sender(index + 1))
        if started is not None:
            outcome = _after(started, outcome)
            started = None
        for earlier in outcome.before:
            if output is not None:
                output.publish(earlier)
            yield Replayed(earlier)
        if output is not None:
            if outcome.result != "dropped":
                output.relay(connection, time_ns, bytes(outcome.buffer))
            output.publish(outcome)
        yield Replayed(outcome, index, connection.topic)


class _Asked:
    """Of each category of a property, and each binding, the first verdict of a second is explained."""

    def __init__(self) -> None:
        self.now = 0
        self._second = 0
        self._told: set[tuple[str, int, str, str]] = set()

    def __call__(self, verdict: Verdict, _source: int) -> bool:
        if self._second != self.now // 10**9:
            self._second = self.now // 10**9
            self._told.clear()
        key = verdict.monitor, verdict.property, verdict.category, bound(verdict)
        told = key in self._told
        self._told.add(key)
        return not told


def _outcome(  # noqa: PLR0917  a message, and what is known of it
    monitors: MonitorSet,
    connection: Connection,
    time_ns: int,
    data: bytes,
    refusal: str | None,
    sender: Sender,
) -> Outcome:
    if refusal is None:
        return monitors.judge(connection.topic, data, time_ns, sender)
    outcome = Outcome(data, time_ns)
    outcome.result, outcome.reason, outcome.before = "dropped", refusal, monitors.advance(time_ns)
    return outcome


def _after(started: Outcome, outcome: Outcome) -> Outcome:
    """The outcome of the first message, with what `init` put out in front."""
    outcome.log = [*started.log, *outcome.log]
    outcome.published = [*started.published, *outcome.published]
    outcome.faults = [*started.faults, *outcome.faults]
    return outcome


def _refusal(monitors: MonitorSet, connection: Connection) -> str | None:
    """Why the messages of a recorded publisher are refused, None if they are not."""
    wanted = monitors.topics.get(connection.topic)
    if wanted is None:
        return None
    kind = ros_type(connection.msgtype)
    if kind != wanted:
        return f"{connection.topic} carries {kind}, but the specifications mean {wanted}"
    if connection.digest not in ("*", monitors.md5sum(wanted)):
        return f"the publisher of {connection.topic} has another definition of {kind} than the specifications"
    return None


def _fits(connection: Connection, topics: Sequence[str]) -> bool:
    return any(fnmatchcase(connection.topic, pattern) for pattern in topics)


def refusals(monitors: MonitorSet, reader: BoundedReader, topics: Sequence[str] = ("*",)) -> list[str]:
    """What to tell about topics that are refused, of those that fit one of the patterns."""
    found = [_refusal(monitors, connection) for connection in reader.connections if _fits(connection, topics)]
    return sorted({text for text in found if text is not None})
