"""A replay of a recording has the verdicts that the monitors in force had."""

from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from random import Random

import pytest
from rosbags.rosbag1 import Writer

from rosmop.check.sources import compiled_from
from rosmop.learn.exercised import coverage
from rosmop.learn.passes import AlarmFacts, AlarmStep, facts_of
from rosmop.recordings.recording import RecordedFile, open_recording
from rosmop.recordings.replay import EVER, replay
from rosmop.run.engine import MonitorSet
from rosmop.tests.acting import definitions
from rosmop.tests.random_messages import RandomMessages
from rosmop.tests.test_shipped import MONITORS

Sent = tuple[str, str, int, bytes, str]  # topic, type, nanoseconds, message, caller
BEGIN, END = 10**12, 10**12 + 6 * 10**9
TFSM = """
quiet() {
    event e() /e std_msgs/Int8 '{}' { }
    tfsm: idle [ e -> busy ] busy [ e -> busy, timeout 2s -> late ] late [ e -> busy, timeout 3s -> idle ]
    @late { ROS_WARN("late"); }
}
"""
SHIPPED = {
    path.stem: path.read_text() for path in sorted(MONITORS.rglob("*.rv")) if "released" not in path.parts
}
TIMED = {name: text for name, text in SHIPPED.items() if " every " in text} | {"quiet": TFSM}


def record(path: Path, sent: list[Sent]) -> Path:
    path.unlink(missing_ok=True)
    known = definitions()
    with Writer(path) as writer:
        rows = {}
        for topic, kind, time, data, caller in sent:
            if (topic, caller) not in rows:
                rows[topic, caller] = writer.add_connection(
                    topic, kind.replace("/", "/msg/"), msgdef=known.full_text(kind), md5sum=known.md5sum(kind),
                    callerid=caller, latching=0,
                )  # fmt: skip
            writer.write(rows[topic, caller], time, data)
    return path


def recordings(folder: Path, topics: Mapping[str, str]) -> tuple[Path, Path, Path]:
    """Write two seconds of messages: alone, before one of the appliance's own node, and before one of another node."""
    messages = RandomMessages(definitions(), Random(1))  # noqa: S311  draws examples, not keys
    sent = [
        (topic, kind, BEGIN + place * 10**8, messages.whole(kind), "/node")
        for place in range(20)
        for topic, kind in topics.items()
    ]
    return (
        record(folder / "alone.bag", sent),
        record(folder / "own.bag", [*sent, ("/rosrv/log", "std_msgs/Int8", END, b"\0", "/rosrv")]),
        record(folder / "beside.bag", [*sent, ("/beside", "std_msgs/Int8", END, b"\0", "/node")]),
    )


@pytest.mark.parametrize("name", TIMED)
def test_time_goes_on_to_the_end_of_a_recording(name: str, tmp_path: Path) -> None:
    compiled = compiled_from({f"{name}.rv": TIMED[name]}, definitions())
    topics = MonitorSet.of(compiled).topics
    alone, own, beside = recordings(tmp_path, topics)

    def timed(bag: Path, patterns: Sequence[str] = ("*",), span: tuple[int, int] = EVER) -> list[object]:
        with closing(open_recording(bag)) as reader:
            steps = [step.outcome for step in replay(MonitorSet.of(compiled), reader, None, patterns, span)]
        return [(one.time, one.timer, one.published, one.verdicts, one.log) for one in steps if one.timer]

    expected = timed(beside)
    assert timed(own) == timed(beside, [*topics]) == timed(alone, span=(0, END)) == expected
    assert expected or name not in {"deadman", "quiet", "sensor"}


def test_coverage_and_alarms_reach_the_end_of_a_recording(tmp_path: Path) -> None:
    texts, known = {"quiet.rv": TFSM}, definitions()
    monitors = MonitorSet.of(compiled_from(texts, known))
    topics = dict(monitors.topics)
    _alone, own, beside = recordings(tmp_path, topics)
    with closing(open_recording(beside)) as reader:
        said = [line for step in replay(monitors, reader, None) for line in step.outcome.log]
    says = {line.monitor: [(number, line.text) for number, line in enumerate(said)] for line in said}
    results = []
    for bag, read in ((own, topics), (beside, topics | {"/beside": "std_msgs/Int8"})):
        recording = RecordedFile(bag, [*read], kinds=read, known=known)
        step = AlarmStep(0, BEGIN, END, 0, 1, read, tuple(texts.values()), says)
        results.append((coverage(texts, known, recording), facts_of(step, recording, known)))
    assert results[0] == results[1]
    assert results[0][1] != AlarmFacts()
