"""Monitors learnt from half of some drives of the simulated LandShark, judged by the other half and by seeded faults.

    python -m benchmarks.learning [--drives 240] [--faults 100] [--seed 1]

Every drive is another random mission of half a minute, with late receptions and noise. An alarm in the second half is
a false alarm. Each fault changes a drive of the second half, and is flagged if it causes an alarm that the same drive
does not have without it.
"""

import argparse
import json
import math
import random
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from examples.landshark.drive import TYPES, VELOCITY, Part, Simulation
from examples.landshark.messages import DEFINITIONS, Messages, long_name
from rosmop.check.sources import compiled_from
from rosmop.learn.learner import LearningResult, learn
from rosmop.learn.passes import run_here
from rosmop.run.engine import MonitorSet
from roswire.definitions import Definitions
from roswire.standard import standard_definitions

MESSAGES = Messages()
KNOWN = standard_definitions().merge(Definitions.from_files(DEFINITIONS))
SECOND = 10**9
JITTER = 0.004  # seconds: the usual lateness of a reception
NOISE: Mapping[str, Mapping[str, float]] = {
    "/landshark/gps": {"latitude": 2e-6, "longitude": 2e-6},
    "/landshark/battery": {"voltage": 0.01},
    "/landshark/odom": {"pose.pose.position.x": 1e-3, "pose.pose.position.y": 1e-3},
}
Row = tuple[str, int, bytes]


@dataclass(frozen=True)
class Drive:
    name: str
    rows: tuple[Row, ...]
    caller: str = ""

    @property
    def began(self) -> int:
        return self.rows[0][1]

    @property
    def ended(self) -> int:
        return self.rows[-1][1]

    @property
    def topics(self) -> Mapping[str, str]:
        return {topic: TYPES[topic] for topic, _, _ in self.rows}

    def messages(self) -> Iterator[Row]:
        return iter(self.rows)


def mission(chance: random.Random) -> list[Part]:
    parts = [Part(1.0, tilt=chance.uniform(-0.4, 0.5))]
    for _ in range(chance.randint(8, 16)):
        kind = chance.choice(("ahead", "ahead", "turn", "turn", "back", "aim", "stand"))
        seconds = chance.uniform(1.0, 6.0)
        if kind == "ahead":
            parts.append(Part(seconds, forward=chance.choice((0.5, 1.0, 1.5, 2.0))))
        elif kind == "back":
            parts.append(Part(seconds / 2, forward=-chance.choice((0.5, 1.0))))
        elif kind == "turn":
            parts.append(
                Part(seconds, forward=chance.choice((0.0, 0.5)), turn=chance.choice((-0.8, -0.4, 0.4, 0.8)))
            )
        elif kind == "aim":
            parts += [Part(1.5, tilt=chance.uniform(-0.4, 0.5)), Part(1.0, fire=True)]
        else:
            parts.append(Part(seconds / 2))
    return parts


def drive(number: int, seed: int) -> Drive:
    chance = random.Random(f"{seed} {number}")
    offset = number * 1000  # seconds: the offset differs from drive to drive
    rows: list[Row] = []
    last: dict[str, int] = {}
    for message in Simulation().run(mission(chance)).messages:
        late = int(chance.expovariate(1 / JITTER) * SECOND)
        time = max(message.time + late, last.get(message.topic, 0) + 1000)  # TCP keeps the order of a topic
        last[message.topic] = time

        def measure(fields: Any, topic: str = message.topic) -> None:
            if hasattr(fields, "header"):
                fields.header.stamp.sec += offset
            for path, sigma in NOISE.get(topic, {}).items():
                put(fields, path, get(fields, path) + chance.gauss(0, sigma))

        rows.append((message.topic, time + offset * SECOND, altered(message.topic, message.data, measure)))
    return Drive(f"drive-{number}", tuple(sorted(rows, key=lambda row: row[1])))


def altered(topic: str, data: bytes, change: Callable[[Any], None]) -> bytes:
    fields = MESSAGES.decode(TYPES[topic], data)
    for name in ("ranges", "position"):
        if isinstance(getattr(fields, name, None), np.ndarray):
            setattr(fields, name, getattr(fields, name).copy())
    change(fields)
    return bytes(MESSAGES.store.serialize_ros1(fields, long_name(TYPES[topic])))


def get(fields: Any, path: str) -> Any:
    """Return the field at a path; `a#1` is an element of an array."""
    path, _, element = path.partition("#")
    for step in path.split("."):
        fields = getattr(fields, step)
    return fields[int(element)] if element else fields


def put(fields: Any, path: str, value: Any) -> None:
    path, _, element = path.partition("#")
    *above, last = path.split(".")
    for step in above:
        fields = getattr(fields, step)
    if element:
        getattr(fields, last)[int(element)] = value
    else:
        setattr(fields, last, value)


MEASURED = {
    "/landshark/odom": ("pose.pose.position.x", "pose.pose.position.y", "twist.twist.linear.x"),
    "/landshark/joint_states": ("position#1",),
    "/landshark/scan": ("ranges",),
    "/landshark/gps": ("latitude", "longitude"),
    "/landshark/battery": ("voltage", "percentage"),
}
NUMBERS = {
    **MEASURED,
    "/landshark/scan": ("ranges#30", "angle_min"),
    VELOCITY: ("twist.linear.x", "twist.angular.z"),
}
CLOCKED = (*MEASURED, VELOCITY)
ENUMERATIONS: Mapping[str, tuple[tuple[str, object], ...]] = {
    "/landshark/gps": (("status.status", -1), ("position_covariance_type", 3), ("header.frame_id", "map")),
    "/landshark/battery": (("present", False), ("power_supply_status", 3), ("power_supply_health", 4)),
    "/landshark/joint_states": (("name#1", "turret_roll"), ("header.frame_id", "base")),
    "/landshark_control/trigger": (("trigger", 2),),
}


@dataclass
class Seeding:
    drive: Drive
    time: int
    chance: random.Random
    what: str = ""

    def field(self, fields: Mapping[str, Sequence[Any]]) -> tuple[str, Any]:
        topic = self.chance.choice(sorted(fields))
        found = self.chance.choice(fields[topic])
        self.what = f"{topic} {found}"
        return topic, found

    def after(self, topic: str, seconds: float = 1000.0) -> list[int]:
        return [
            place
            for place, row in enumerate(self.drive.rows)
            if row[0] == topic and self.time <= row[1] <= self.time + seconds * SECOND
        ]

    def value(self, place: int, path: str) -> Any:
        topic, _, data = self.drive.rows[place]
        return get(MESSAGES.decode(TYPES[topic], data), path)

    def span(self, topic: str, path: str) -> float:
        """Return the span of a field's values, or 1 for a constant."""
        values = [
            float(self.value(place, path)) for place, row in enumerate(self.drive.rows) if row[0] == topic
        ]
        finite = [value for value in values if math.isfinite(value)]
        return (max(finite) - min(finite) if finite else 0.0) or 1.0

    def with_values(self, places: Sequence[int], path: str, value: Callable[[Any], Any]) -> list[Row]:
        rows = list(self.drive.rows)
        for place in places:
            topic, time, data = rows[place]
            rows[place] = (
                topic,
                time,
                altered(topic, data, lambda all_: put(all_, path, value(get(all_, path)))),
            )
        return rows


def stuck(seeding: Seeding) -> list[Row]:
    topic, path = seeding.field(MEASURED)
    places = seeding.after(topic)
    held = seeding.value(places[0], path)
    return seeding.with_values(places, path, lambda _: held)


def out_of_range(seeding: Seeding) -> list[Row]:
    topic, path = seeding.field(NUMBERS)
    beyond = seeding.span(topic, path) * seeding.chance.choice((2, 10, 1000)) * seeding.chance.choice((-1, 1))
    return seeding.with_values(seeding.after(topic, 3.0), path, lambda value: value + beyond)


def spike(seeding: Seeding) -> list[Row]:
    topic, path = seeding.field(NUMBERS)
    jump = seeding.span(topic, path) * seeding.chance.uniform(0.5, 1.0)
    return seeding.with_values(seeding.after(topic)[:1], path, lambda value: value + jump)


def late(seeding: Seeding) -> list[Row]:
    topic = seeding.what = seeding.chance.choice(CLOCKED)
    places, by = set(seeding.after(topic, 5.0)), int(seeding.chance.uniform(0.1, 2.0) * SECOND)
    return [
        (name, time + by if place in places else time, data)
        for place, (name, time, data) in enumerate(seeding.drive.rows)
    ]


def too_often(seeding: Seeding) -> list[Row]:
    topic = seeding.what = seeding.chance.choice(CLOCKED)
    again = [seeding.drive.rows[place] for place in seeding.after(topic, 10.0)]
    return [*seeding.drive.rows, *((name, time + 3_000_000, data) for name, time, data in again)]


def silent(seeding: Seeding) -> list[Row]:
    topic = seeding.what = seeding.chance.choice(CLOCKED)
    gone = set(seeding.after(topic, seeding.chance.uniform(3.0, 10.0)))
    return [row for place, row in enumerate(seeding.drive.rows) if place not in gone]


def swapped(seeding: Seeding) -> list[Row]:
    topic = seeding.what = seeding.chance.choice(CLOCKED)
    first, second, *_ = seeding.after(topic)
    rows = list(seeding.drive.rows)
    (_, earlier, one), (_, later, other) = rows[first], rows[second]
    rows[first], rows[second] = (topic, earlier, other), (topic, later, one)
    return rows


def not_a_number(seeding: Seeding) -> list[Row]:
    topic, path = seeding.field(NUMBERS)
    return seeding.with_values(seeding.after(topic)[:1], path, lambda _: math.nan)


def wrong_value(seeding: Seeding) -> list[Row]:
    topic, (path, value) = seeding.field(ENUMERATIONS)
    return seeding.with_values(seeding.after(topic)[:3], path, lambda _: value)


def sign_flip(seeding: Seeding) -> list[Row]:
    topic, path = seeding.field(NUMBERS)
    return seeding.with_values(seeding.after(topic, 5.0), path, lambda value: -value)


KINDS: Mapping[str, Callable[[Seeding], list[Row]]] = {
    "stuck": stuck, "out of range": out_of_range, "spike": spike, "late": late, "too often": too_often,
    "silent": silent, "swapped": swapped, "not a number": not_a_number, "wrong value": wrong_value,
    "sign flip": sign_flip,
}  # fmt: skip


def seeded(kind: str, drives: Sequence[Drive], chance: random.Random) -> tuple[Drive, int, list[Row], str]:
    """Return a drive, the time of its fault, its messages with the fault, and the fault's description."""
    while True:
        drive_ = chance.choice(drives)
        time = drive_.began + int((drive_.ended - drive_.began) * chance.uniform(0.2, 0.6))
        seeding = Seeding(drive_, time, chance)
        try:
            rows = KINDS[kind](seeding)
        except (IndexError, ValueError):  # the topic has no message after this time
            continue
        if rows != list(drive_.rows):
            return drive_, time, sorted(rows, key=lambda row: row[1]), f"{kind}: {seeding.what}"


def alarms(learnt: LearningResult, rows: Sequence[Row]) -> list[tuple[int, str, str]]:
    """Return the time, specification and text of every warning."""
    monitors = MonitorSet.of(compiled_from({"learnt.rv": learnt.text}, KNOWN))
    monitors.start(rows[0][1], frozenset(TYPES))
    found = []
    for topic, time, data in rows:
        outcome = monitors.process(topic, data, time)
        for each in (*outcome.before, outcome):
            found += [(each.time, line.monitor, line.text) for line in each.log if line.level == "WARN"]
    return found


@dataclass(frozen=True)
class Judged:
    learnt: LearningResult
    hours: float
    false_alarms: list[tuple[int, str, str]]
    flagged: Counter[str]
    missed: list[str]


def judge(count: int, faults: int, seed: int) -> Judged:
    drives = [drive(number, seed) for number in range(count)]
    half = count // 2
    learnt = learn(drives[:half], KNOWN, 0.3, run_here(drives[:half], KNOWN))
    tests = drives[half:]
    quiet = {test.name: alarms(learnt, test.rows) for test in tests}
    chance = random.Random(seed)
    flagged: Counter[str] = Counter()
    missed = []
    for number in range(faults):
        kind = list(KINDS)[number % len(KINDS)]
        where, time, rows, what = seeded(kind, tests, chance)
        known = set(quiet[where.name])
        if any(alarm[0] >= time and alarm not in known for alarm in alarms(learnt, rows)):
            flagged[kind] += 1
        else:
            missed.append(what)
    hours = sum(test.ended - test.began for test in tests) / SECOND / 3600
    return Judged(learnt, hours, [alarm for rows in quiet.values() for alarm in rows], flagged, missed)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--drives", type=int, default=240)
    parser.add_argument("--faults", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rv", type=Path, metavar="FILE", help="write the learnt specifications")
    options = parser.parse_args()
    judged = judge(options.drives, options.faults, options.seed)
    if options.rv is not None:
        options.rv.write_text(judged.learnt.text)
    widened = sum(1 for candidate in judged.learnt.candidates if candidate.widened)
    print(
        json.dumps(
            {
                "conditions": len(judged.learnt.candidates), "widened": widened,
                "left out": len(judged.learnt.left_out),
                "hours judged": round(judged.hours, 3), "false alarms": len(judged.false_alarms),
                "which": Counter(f"{text.partition(':')[0]}" for _, _, text in judged.false_alarms),
                "faults": options.faults, "flagged": sum(judged.flagged.values()), "by kind": judged.flagged,
                "missed": judged.missed,
            },
            indent=2,
        )
    )  # fmt: skip


if __name__ == "__main__":
    main()
