"""Read the last messages of topics from recordings."""

from collections.abc import Iterable, Mapping
from contextlib import closing
from pathlib import Path

from rosmop.recordings.recording import messages_of, open_recording, ros_type

Spans = Iterable[tuple[str, Path, tuple[int, int]]]
"""The name and the path of each recording, and the period to read, in nanoseconds, both ends included."""


def last_messages(spans: Spans, topics: Mapping[str, str], most: int) -> dict[str, list[tuple[int, bytes]]]:
    """Return up to `most` last messages of each topic that have its type in `topics`, with times in nanoseconds.

    Raises:
        RecordingError: A recording cannot be read.
    """
    messages: dict[str, list[tuple[int, bytes]]] = {topic: [] for topic in topics}
    for _name, path, (since, until) in spans:
        with closing(open_recording(path)) as reader:
            for connection, time, data in messages_of(reader):
                if topics.get(connection.topic) == ros_type(connection.msgtype) and since <= time <= until:
                    messages[connection.topic].append((time, bytes(data)))
                    del messages[connection.topic][:-most]
    return messages
