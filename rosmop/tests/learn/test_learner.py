import math
import random
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from struct import pack

import pytest

from rosmop.check.sources import compiled_from
from rosmop.learn.candidates import WORDS
from rosmop.learn.learner import LearningResult, learn
from rosmop.learn.passes import named_files, run_here
from rosmop.learn.recordings import LearningError
from rosmop.run.engine import MonitorSet
from rosmop.tests.acting import message
from roswire.definitions import Definitions
from roswire.standard import standard_definitions

START = 1_700_000_000 * 10**9
TYPES = {
    "/speed": "std_msgs/Float64",
    "/mode": "std_msgs/String",
    "/ask": "std_msgs/Bool",
    "/answer": "std_msgs/Bool",
}
Row = tuple[str, int, bytes]


@dataclass(frozen=True)
class Recorded:
    name: str
    rows: tuple[Row, ...]
    topics: Mapping[str, str]
    caller: str = ""

    @property
    def began(self) -> int:
        return self.rows[0][1]

    @property
    def ended(self) -> int:
        return self.rows[-1][1]

    def messages(self) -> Iterator[Row]:
        return iter(self.rows)


def number(value: float) -> bytes:
    return message("std_msgs/Float64", data=value)


def drive(seed: int, seconds: float = 60.0) -> Recorded:
    chance = random.Random(seed)  # noqa: S311  no secret
    modes = ["idle", "armed", "firing"]
    rows: list[Row] = []
    for tick in range(int(seconds * 20)):
        time = START + seed * 10**12 + tick * 50_000_000 + int(chance.random() * 5e6)
        speed = math.sin(tick / 40 + seed) + chance.gauss(0, 0.01)
        rows.append(("/speed", time, number(speed)))
        if tick % 20 == 0:
            mode = modes[tick // 60 % 3]
            rows.append(("/mode", time + 1000, message("std_msgs/String", data=mode)))
        if chance.random() < 0.03:
            rows.append(("/ask", time + 10_000_000, message("std_msgs/Bool", data=True)))
            rows.append(
                ("/answer", time + int(12e6 + chance.random() * 3e6), message("std_msgs/Bool", data=True))
            )
    return Recorded(f"drive {seed}", tuple(sorted(rows, key=lambda row: row[1])), TYPES)


DRIVES = [drive(seed) for seed in range(1, 9)]


@pytest.fixture(scope="module")
def learnt() -> LearningResult:
    return learnt_from(DRIVES, 0.3)


def learnt_from(recordings: Sequence[Recorded], held_out: float) -> LearningResult:
    definitions = standard_definitions()
    return learn(recordings, definitions, held_out, run_here(recordings, definitions))


def warnings(learnt: LearningResult, rows: Sequence[Row]) -> list[str]:
    monitors = MonitorSet.of(compiled_from({"learnt.rv": learnt.text}, standard_definitions()))
    monitors.start(rows[0][1], frozenset(TYPES))
    found = []
    for topic, time, data in rows:
        outcome = monitors.process(topic, data, time)
        assert outcome.result == "passed"
        found += [line.text for each in (*outcome.before, outcome) for line in each.log]
    return found


def test_a_new_drive_gives_no_alarm(learnt: LearningResult) -> None:
    assert [warnings(learnt, drive(seed).rows) for seed in (20, 21)] == [[], []]


def test_the_recordings_are_split_and_named(learnt: LearningResult) -> None:
    assert {part.name for part in learnt.held_out}.isdisjoint(part.name for part in learnt.trained)
    assert len(learnt.held_out) == 2
    head = learnt.text.split("\n\n", maxsplit=1)[0]
    assert all(part.name in head for part in [*learnt.trained, *learnt.held_out])


def faulty(kind: str) -> list[Row]:
    rows = list(drive(30).rows)
    from_then = rows[0][1] + 20 * 10**9
    at = next(place for place, row in enumerate(rows) if row[0] == "/speed" and row[1] >= from_then)
    topic, time, data = rows[at]
    if kind == "out of range":
        rows[at] = (topic, time, number(7.5))
    elif kind == "NaN":
        rows[at] = (topic, time, number(math.nan))
    elif kind == "stuck":
        rows = [(name, when, data if name == topic and when > time else old) for name, when, old in rows]
    elif kind == "silent":
        rows = [row for row in rows if row[0] != topic or row[1] < time]
    elif kind == "too often":
        rows += [(name, when + 1000, old) for name, when, old in rows if name == topic and when >= time]
    elif kind == "unknown mode":
        rows.append(("/mode", time + 1, message("std_msgs/String", data="flying")))
    elif kind == "forbidden move":
        rows.append(("/mode", time + 1, message("std_msgs/String", data="idle")))
        rows.append(("/mode", time + 2, message("std_msgs/String", data="firing")))
    elif kind == "unanswered":
        rows.append(("/ask", time + 1, message("std_msgs/Bool", data=True)))
    return sorted(rows, key=lambda row: row[1])


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        ("out of range", "/speed data is out of range"),
        ("NaN", "/speed data is out of range"),
        ("stuck", "/speed data is stuck"),
        ("silent", "/speed is silent for"),
        ("too often", "/speed comes too often"),
        ("unknown mode", "/mode data has a new value: flying"),
        ("forbidden move", "/mode data makes a move that was never seen"),
        ("unanswered", "/ask was not followed by /answer"),
    ],
)
def test_a_fault_is_warned_of(learnt: LearningResult, kind: str, says: str) -> None:
    assert any(text.startswith(says) for text in warnings(learnt, faulty(kind)))


def test_contradictions_of_held_out_recordings_are_listed() -> None:
    odd = [drive(seed) for seed in range(1, 5)]
    rows = [(topic, time, number(50.0) if place == 600 else data) if topic == "/speed" else (topic, time, data)
            for place, (topic, time, data) in enumerate(odd[2].rows)]  # fmt: skip
    at = next(place for place, row in enumerate(rows) if row[0] == "/mode")
    rows[at] = (*rows[at][:2], message("std_msgs/String", data="flying"))
    speeds = [place for place, row in enumerate(rows) if row[0] == "/speed"]
    rows[speeds[300]] = (*rows[speeds[300]][:2], number(50.0))
    odd[2] = replace(odd[2], rows=tuple(rows))
    learnt = learnt_from(odd, 0.25)
    assert [part.name for part in learnt.held_out] == ["drive 3"]
    widened = {candidate.says for candidate in learnt.candidates if candidate.widened}
    assert "data is out of range" in widened
    assert "WIDENED after" in learnt.text
    assert "data has a new value" in {each.says for each in learnt.left_out}
    assert "// /mode data has a new value (one of" in learnt.text
    assert not any("out of range" in text for text in warnings(learnt, odd[2].rows))


def test_a_recording_alone_is_divided_in_time() -> None:
    learnt = learnt_from([drive(1, 200.0)], 0.3)
    (trained,), (held_out,) = learnt.trained, learnt.held_out
    assert trained.ended < held_out.began
    assert held_out.seconds == pytest.approx(60, rel=0.01)


def test_nothing_to_learn_from_is_an_error() -> None:
    other = replace(DRIVES[1], topics={**TYPES, "/speed": "std_msgs/Float32"})
    with pytest.raises(
        LearningError, match="/speed carries std_msgs/Float64 in one recording and std_msgs/Float32"
    ):
        learnt_from([DRIVES[0], other], 0.3)
    with pytest.raises(LearningError, match="no message"):
        learnt_from([replace(DRIVES[0], topics={})], 0.3)
    broken = replace(DRIVES[0], rows=(("/speed", START, b"abc"), *DRIVES[0].rows[1:]))
    with pytest.raises(LearningError, match="drive 1: a message on /speed is not of type std_msgs/Float64"):
        learnt_from([broken], 0)
    learnt = learnt_from([broken, *DRIVES[1:]], 0.3)
    assert list(learnt.failed) == [0]
    assert "partly, learnt from: drive 1: a message on /speed" in learnt.text


def test_omitted_conditions_are_listed() -> None:
    chance = random.Random(7)  # noqa: S311  no secret

    def joints() -> bytes:
        arrays = {name: [chance.gauss(0, 1) for _ in range(6)] for name in ("position", "velocity", "effort")}
        return message("sensor_msgs/JointState", name=[f"joint{number}" for number in range(6)], **arrays)

    rows = tuple(("/arm", START + tick * 50_000_000, joints()) for tick in range(600))
    learnt = learnt_from([Recorded("arm", rows, {"/arm": "sensor_msgs/JointState"})], 0)
    kinds = [candidate.kind for candidate in learnt.candidates]
    assert (kinds.count("range"), kinds.count("length")) == (10, 4)
    assert re.search(r"^// \d+ conditions more on /arm are not here", learnt.text, re.MULTILINE)
    assert "// Nothing was held out: it is untested." in learnt.text


def test_what_is_too_long_for_one_file_is_in_several() -> None:
    """A condition that is too long for a file, such as that a robot's description is always the same, is left out."""
    texts = {f"/part{number}": "x" * 12_000 for number in range(14)} | {"/robot_description": "y" * 100_000}
    rows = tuple(
        (topic, START + second * 10**9 + place, message("std_msgs/String", data=text))
        for second in range(30)
        for place, (topic, text) in enumerate(texts.items())
    )
    learnt = learnt_from([Recorded("r", rows, dict.fromkeys(texts, "std_msgs/String"))], 0.3)
    files = named_files(learnt.texts)
    assert [*files] == ["learnt.rv", "learnt_2.rv"]
    for name, text in files.items():
        assert not compiled_from({name: text}, standard_definitions()).warnings
    assert {row.topic for row in learnt.candidates if row.kind == "constant"} == texts.keys() - {
        "/robot_description"
    }
    assert "// 1 conditions more on /robot_description are not here: they are many, or long" in learnt.text


def test_names_that_ros_allows_give_a_valid_specification() -> None:
    """Fields may have words of the language, which no pattern names: they are left out, and told."""
    words = [*sorted(WORDS - {"__RESET"}), "MESSAGE", "vector", "numeric_limits", "true", "false", "x"]
    definitions = standard_definitions().merge(
        Definitions.from_files({"own/Words.msg": "".join(f"float64 {word}\n" for word in words)})
    )
    chance = random.Random(5)  # noqa: S311  no secret
    kinds = dict.fromkeys(("/1/words", "/robot/1", "/other/2", "/robot/_x"), "own/Words")
    rows = tuple(
        (topic, START + tick * 10**8, pack(f"<{len(words)}d", *(chance.choice([0, 5e-324]) for _ in words)))
        for tick in range(200)
        for topic in kinds
    )
    recorded = Recorded("r", rows, kinds)
    learnt = learn([recorded], definitions, 0.3, run_here([recorded], definitions))
    compiled_from({"learnt.rv": learnt.text}, definitions)
    named = {(row.topic, row.path) for row in learnt.candidates if row.path in words}
    assert named == {(topic, word) for topic in kinds for word in words if word not in WORDS}
    assert "// Not looked at: new of /robot/1 (own/Words): specifications cannot name it" in learnt.text


def test_numbers_of_any_size_give_a_valid_specification() -> None:
    chance = random.Random(1)  # noqa: S311  no secret
    topics: dict[str, tuple[str, Callable[[], float]]] = {
        "/unsigned": ("std_msgs/UInt64", lambda: chance.getrandbits(64)),
        "/signed": ("std_msgs/Int64", lambda: chance.getrandbits(64) - (1 << 63)),
        "/few": ("std_msgs/UInt64", lambda: chance.choice([(1 << 64) - 1, 1 << 63, 5])),
        "/real": ("std_msgs/Float64", lambda: chance.uniform(-1.7e308, 1.7e308)),
        "/high": ("std_msgs/Float64", lambda: chance.uniform(1e308, 1.7e308)),
    }
    rows = tuple(
        (topic, START + second * 10**9 + place, message(kind, data=value()))
        for second in range(200)
        for place, (topic, (kind, value)) in enumerate(topics.items())
    )
    recorded = Recorded("r", rows, {topic: kind for topic, (kind, _) in topics.items()})
    learnt = learnt_from([recorded], 0.2)
    assert MonitorSet.of(compiled_from({"learnt.rv": learnt.text}, standard_definitions())).warnings == ()
    assert {row.topic for row in learnt.candidates if row.kind == "range"} == {"/unsigned", "/signed"}
    assert "data <= 18446744073709551615u" in learnt.text
