from pathlib import Path

from rosbags.rosbag1 import Writer

from rosmop.tests.acting import message
from roswire.standard import standard_definitions


def make_bag(path: Path, messages: list[tuple[str, str, float, bytes]], md5sum: str | None = None) -> Path:
    definitions = standard_definitions()
    with Writer(path) as writer:
        connections = {}
        for topic, kind, seconds, data in messages:
            if topic not in connections:
                package, _, name = kind.partition("/")
                connections[topic] = writer.add_connection(
                    topic,
                    f"{package}/msg/{name}",
                    msgdef=definitions.full_text(kind),
                    md5sum=md5sum or definitions.md5sum(kind),
                    callerid="/talker",
                )
            writer.write(connections[topic], int(seconds * 10**9), data)
    return path


def number(value: int) -> bytes:
    return message("std_msgs/Int32", data=value)
