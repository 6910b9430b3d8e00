import math
import random
from collections.abc import Iterable, Sequence
from typing import Any, Self

from rosmop.run.engine import MonitorSet
from rosmop.run.outcomes import MessageSender, Outcome
from rosmop.tests.acting import fields, message
from tests.support.features.guards.running_guard import Value, named, on_its_module, part_with

MS = 10**6
BEGIN = 1_700_000_000 * 10**9
TWIST = "geometry_msgs/Twist"
NODES = ("", *(f"/{letter}" for letter in "abcdefghijk"))
SPEEDS = (0.0, -0.0, 0.2, -0.2, 0.5, -0.5, 0.5000001, 1.0, -3.0, 1e300, math.inf, -math.inf, math.nan)


def twist(*legs: float) -> bytes:
    names = [f"{part}__{axis}" for part in ("linear", "angular") for axis in "xyz"]
    return message(TWIST, **dict(zip(names, legs, strict=False)))


def legs_of(data: bytes) -> tuple[float, ...]:
    read = fields(TWIST, data)
    return (read.linear.x, read.linear.y, read.linear.z, read.angular.x, read.angular.y, read.angular.z)


def same(one: Iterable[float], other: Iterable[float]) -> bool:
    return all(a == b or (math.isnan(a) and math.isnan(b)) for a, b in zip(one, other, strict=True))


class Guarded:
    """A base behind a guard, and behind the monitors of the texts `before` it; `got` is what arrives there."""

    def __init__(
        self, preset: str, types: dict[str, str] | None = None, *, before: Sequence[str] = (), **values: Value
    ) -> None:
        part, given = part_with(preset, types or {}, values, before=before)
        monitors = on_its_module(part)
        monitors.give({"guard": given})
        self.begin(monitors, named(preset).given_topics)

    @classmethod
    def by(cls, monitors: MonitorSet, topics: dict[str, str]) -> Self:
        """Return a base behind these monitors; `topics` are those of the guard."""
        guarded = cls.__new__(cls)
        guarded.begin(monitors, topics)
        return guarded

    def begin(self, monitors: MonitorSet, topics: dict[str, str]) -> None:
        self.monitors, self.topics = monitors, topics
        self.monitors.name_senders(lambda source: ("10.0.0.1", NODES[source]))
        self.got: list[tuple[int, Any]] = []
        self.monitors.start(BEGIN - 100 * MS)
        self.advance(0)

    def advance(self, at: int) -> None:
        for one in self.monitors.advance(BEGIN + at * MS):
            self.receive(one, (one.time - BEGIN) // MS)

    def tell(self, given: str, data: bytes, at: int, node: str = "/a", *, faults: bool = False) -> Outcome:
        """Give a message to the guard. With `faults`, it must be too much for the guard."""
        self.advance(at)
        topic = self.topics[given]
        outcome = self.monitors.judge(
            topic, bytearray(data), BEGIN + at * MS, MessageSender(NODES.index(node))
        )
        assert bool(outcome.faults) == faults
        self.receive(outcome, at)
        if given == "command" and outcome.result != "dropped":
            self.got.append((at, bytes(outcome.buffer)))
        return outcome

    def drive(self, data: bytes, at: int, node: str = "/a") -> tuple[float, ...]:
        outcome = self.tell("command", data, at, node)
        return () if outcome.result == "dropped" else legs_of(bytes(outcome.buffer))

    def receive(self, outcome: Outcome, at: int) -> None:
        self.got += [(at, bytes(one.data)) for one in outcome.sent_messages()]


def seeded(seed: int) -> random.Random:
    return random.Random(seed)  # noqa: S311  of tests
