"""Open recordings: bags and MCAP files, distinguished by their first bytes. Errors are a `RecordingError`."""

import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from fnmatch import fnmatchcase
from pathlib import Path

import zstandard
from mcap.exceptions import McapError
from rosbags.interfaces import Connection, ConnectionExtRosbag1
from rosbags.rosbag1 import ReaderError

from rosmop.recordings.bounded_bag import BoundedReader
from rosmop.recordings.bounded_mcap import MAGIC, BoundedMcap
from rosmop.recordings.regular_files import open_regular
from roswire.definitions import Definitions
from roswire.errors import DefinitionError
from roswire.message_text import MessageDefinition
from roswire.standard import standard_definitions

Reader = BoundedReader | BoundedMcap
OWN = "/rosrv"
"""The caller id of messages that monitors published, by default; monitors do not receive them."""
# The exceptions that the libraries and their decompressors raise for a damaged file.
_DAMAGE = (
    ReaderError, McapError, zstandard.ZstdError, ValueError, LookupError, AssertionError, struct.error, MemoryError,
    OverflowError, OSError, EOFError, RuntimeError,
)  # fmt: skip


class RecordingError(Exception):
    """A recording cannot be used. The message names the recording and the reason."""


def ros_type(name: str) -> str:
    package, _, kind = name.partition("/")
    return f"{package}/{kind.rpartition('/')[2]}"


def open_recording(path: Path) -> Reader:
    is_mcap = False
    try:
        if path.is_file():
            with open_regular(path) as file:
                is_mcap = file.peek(len(MAGIC))[: len(MAGIC)] == MAGIC
        if is_mcap:
            return BoundedMcap(path)
        reader = BoundedReader(path)
        reader.open()
    except _DAMAGE as error:
        advice = "; it must be a ROS 1 bag or an MCAP file; `rosbag reindex` repairs a truncated bag"
        text = f"cannot read the bag {path}: {_text_of(error).rstrip('.')}"
        if is_mcap:
            raise RecordingError(
                f"cannot read the MCAP file {path}: {_text_of(error).rstrip('.')}"
            ) from error
        raise RecordingError(text + (advice if path.is_file() else "")) from error
    return reader


def messages_of(reader: Reader) -> Iterator[tuple[Connection, int, bytes]]:
    """Yield messages, with times in nanoseconds."""
    try:
        yield from reader.in_order()
    except _DAMAGE as error:
        raise RecordingError(f"the bag {reader.path} is damaged: {_text_of(error)}") from error


def _text_of(error: Exception) -> str:
    return str(error) or type(error).__name__


def definitions_of(reader: Reader) -> Definitions:
    return _definitions_of(by_size(reader))


def by_size(reader: Reader) -> list[Connection]:
    """Return the connections, those with the most messages first: they determine a type that has two definitions."""
    counts = reader.message_counts
    return sorted(reader.connections, key=lambda row: -counts[row.id])


def _definitions_of(connections: Iterable[Connection]) -> Definitions:
    """Return the definitions in the texts of connections.

    Those with the md5sum of their connection go before all others: small client libraries send no text, or a wrong one.
    """
    definitions: dict[str, MessageDefinition] = {}
    doubtful: dict[str, MessageDefinition] = {}
    sent = dict.fromkeys((ros_type(row.msgtype), row.msgdef.data, row.digest) for row in connections)
    for name, text, digest in sent:
        try:
            own = Definitions.from_full_text(name, text)
            parts = {part.name: part for part in own.parts(name)}
            if digest == own.md5sum(name):
                definitions = parts | definitions
            elif text.strip():
                doubtful = parts | doubtful
        except DefinitionError:
            continue
    standard = standard_definitions().message_names
    return Definitions({name: part for name, part in doubtful.items() if name not in standard} | definitions)


def _md5sum(definitions: Definitions, kind: str, unknown: str) -> str:
    try:
        return definitions.md5sum(kind)
    except DefinitionError:
        return unknown


def sender_of(connection: Connection) -> ConnectionExtRosbag1:
    assert isinstance(connection.ext, ConnectionExtRosbag1)  # noqa: S101  the readers make no other connections
    return connection.ext


def inputs(reader: Reader, patterns: Sequence[str], own: str = OWN) -> list[Connection]:
    """Return the connections on topics that match a pattern whose messages monitors got. Monitors publish as `own`."""
    return [
        row
        for row in by_size(reader)
        if sender_of(row).callerid != own
        and row.id not in reader.dropped
        and any(fnmatchcase(row.topic, pattern) for pattern in patterns)
    ]


class RecordedFile:
    """The messages of nodes in a recording on topics that match a pattern, read again for each pass.

    The recording must have messages. Connections are left out, and named in `notes`, if their type is not that of
    their topic in `kinds`, or if its definition is not in `known`; topics that `kinds` lacks may have any. Without
    those, the connections with the most messages determine both, and ROS the types that none defines. `name` is for
    messages to the user.
    """

    def __init__(
        self,
        path: Path,
        patterns: Sequence[str],
        name: str | None = None,
        kinds: Mapping[str, str] | None = None,
        known: Definitions | None = None,
    ) -> None:
        self._path = path
        self.name = name or path.name
        self.topics: dict[str, str] = {}
        self.caller = ""
        with closing(open_recording(path)) as reader:
            self.began, self.ended = reader.start_time, reader.end_time - 1
            self.message_count = reader.message_count
            if not self.message_count:
                raise RecordingError(f"the bag {path} has no messages")
            rows = inputs(reader, patterns)
            self.definitions = known or standard_definitions().merge(_definitions_of(rows))
            wanted = dict(kinds or {})
            self._connections: set[int] = set()
            self.notes: list[str] = []
            for row in rows:
                kind = ros_type(row.msgtype)
                other = wanted.get(row.topic, kind)
                is_free = kinds is not None and row.topic not in kinds
                digests = "*", _md5sum(self.definitions, kind, row.digest)
                if is_free or (other == kind and row.digest in digests):
                    self.topics[row.topic] = wanted[row.topic] = kind
                    self._connections.add(row.id)
                    continue
                why = f"{kind} instead of {other}" if kind != other else f"another definition of {kind}"
                sender = sender_of(row).callerid or "a node"
                self.notes.append(
                    f"{self.name}: {sender} sends {why} on {row.topic}; its messages are left out"
                )

    def messages(self) -> Iterator[tuple[str, int, bytes]]:
        with closing(open_recording(self._path)) as reader:
            for connection, time_ns, data in messages_of(reader):
                if connection.id in self._connections:
                    self.caller = sender_of(connection).callerid or ""
                    yield connection.topic, time_ns, data
