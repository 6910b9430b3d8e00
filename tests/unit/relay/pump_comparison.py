"""Compare the pump with the path in Python: two relays have the same peers, and one never uses the pump.

    .venv/bin/python -m tests.unit.relay.pump_comparison SEED BATCHES

A seed determines random batches, subscribers, monitors, broken connections and frames. Both relays must send each
subscriber the same bytes, count the same messages and effects of monitors, and keep the same state of monitors.
"""

import contextlib
import socket
import struct
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from random import Random
from types import FrameType
from typing import Any

import msgspec
from msgspec import structs

from appliance.base import clock
from appliance.channel.messages import (
    GrantInstalled,
    MonitorsCounted,
    MonitorsReported,
    MonitorSwitched,
    PublicationPlaced,
    SpecificationsStated,
    SpecificationsTaken,
    StateGiven,
    TrafficReported,
    UpstreamFound,
    UpstreamWanted,
)
from appliance.relay.monitors.loader import Loader
from appliance.relay.monitors.state_keeper import StateKeeper
from appliance.relay.relay_limits import MIB
from appliance.relay.transport.frames import Batch
from roswire.tcpros import encode_header
from tests.support.processes import LIMIT
from tests.support.stated import stated
from tests.unit.relay.monitors.monitored import GUARD, SPECIFICATIONS, TYPED, WANTED, Monitored, string
from tests.unit.relay.world import LIMITS, LOOPBACK, Peer

_TOPICS = ("/chatter", "/other")
_MANY = replace(
    LIMITS, queue_messages=1_000_000, queue_bytes=512 * MIB, retry_first=0.001, retry_longest=0.01, report_every=0.005,
    connections=1000, connections_per_host=1000,
)  # fmt: skip
_COUNT = """count() { int n; int m;
    event e(std::string s) /chatter std_msgs/String '{data:s}' { n = n + s.size(); }
    event o(std::string s) /other std_msgs/String '{data:s}' { m = m + n; if (s == "one") s = "two"; } }"""
_TURNS = """turns() { int drops;
    event a(std::string s) /chatter std_msgs/String '{data:s}' { }
    event b() /other std_msgs/String '{}' { }
    fsm: first [ a -> second, default first ] second [ b -> first, default third ] third [ a -> first, default third ]
    @third { ROS_WARN("out of turn"); drops = drops + 1; return; } }"""
_SILENT = """silent() { int n;
    event e(std::string s) /chatter std_msgs/String '{data:s}' { n = n + 1; if (s == "bad") { return; } } }"""
_SAYS = """says() { int n; event e(std::string s) /chatter std_msgs/String '{data:s}' { n = n + 1;
    if (s == "x") { ROS_INFO("an x"); } } }"""
_EACH = """each() { event e(std::string s) /chatter std_msgs/String '{data:s}' { if (s == "one") { s[0] = 'X'; } }
    event p(std::string s) /chatter std_msgs/String '{data:s}' { if (s == "x") { s[0] = 'Y'; } } }"""
_TIMED = """timed() { event e(std::string s) /chatter std_msgs/String '{data:s}' { }
    event o() /other std_msgs/String '{}' { }
    tfsm: calm [ e -> busy, default calm ] busy [ o -> calm, timeout 1000s -> late, default busy ] late [ default late ]
    @late { return; } }"""
_SETS = (
    (_SILENT,), (_SILENT, _COUNT), (_SAYS,), (_EACH,), (_EACH, _SILENT), (_TIMED,), (_TIMED, _COUNT),
    (_COUNT,), (_COUNT,), (_COUNT,), (_TURNS,), (GUARD,), (SPECIFICATIONS["IN-PLACE"],), (SPECIFICATIONS["LONGER"],),
    (GUARD, _COUNT), (_TURNS, SPECIFICATIONS["IN-PLACE"]), (),
)  # fmt: skip
_WORDS = ("bad", "one", "long", "count", "", "x", "hello", "a message of usual length, such as a status")


class ComparedRelay(Monitored):
    def __init__(self, *, pumped: bool) -> None:
        super().__init__(_MANY)
        self.pumped = pumped
        self.port.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 64 << 10)  # accepted sockets inherit it
        self.memory = memoryview(bytearray(1 << 20))
        self.given = StateGiven(True, "boot", clock.wall_ns() - clock.now_ns())
        self.engine.interceptor.remember(StateKeeper(self.given, self.memory))
        self.state(PublicationPlaced("k", "/other", "*"))
        self.publishers: dict[str, Peer] = {}
        self.subscribers: dict[str, Peer] = {}
        self.expected = Counter[str]()
        self.counted: Counter[tuple[str, str]] = Counter()
        if not pumped:
            for topic in _TOPICS:
                self.engine.topics["k", topic].tap(_nothing, latched=False)

    def until(self, condition: Callable[[], Any], seconds: float = LIMIT) -> Any:
        for _ in range(20):
            self.loop.turn(0)
            found = condition()
            if found:
                return found
        return super().until(condition, seconds)

    def publish(self, topic: str) -> None:
        self.hears(UpstreamWanted, key="k", topic=topic)
        self.state(UpstreamFound("k", topic, LOOPBACK, self.publisher.getsockname()[1]))
        peer = self.accept(self.publisher)
        while self.gets_header(peer)["callerid"] == "/rosrv_newcomer":  # which asked for a greeting
            peer.sock.close()
            peer = self.accept(self.publisher)
        peer.send(encode_header(TYPED | {"topic": topic}))
        peer.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.publishers[topic] = peer

    def subscribe(self, topic: str, name: str) -> None:
        self.state(GrantInstalled("k", topic, LOOPBACK, name))
        peer = self.connect(encode_header(WANTED | {"topic": topic, "callerid": name}))
        if topic not in self.publishers:
            self.publish(topic)
        self.gets_header(peer)
        # A buffer of a fixed size: the kernel enlarges others by time, and what does not fit is dropped.
        peer.sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        self.subscribers[name] = peer

    def arrived(self, topic: str) -> bool:
        return self.engine.topics["k", topic].counters.following - 1 == self.expected[topic]

    def take_all(self) -> None:
        self.until(lambda: all(map(self.arrived, _TOPICS)))

    def answered(self, revision: int) -> None:
        self.until(lambda: self.taken(SpecificationsTaken, revision))

    def collect(self) -> None:
        self.told += [message for message, _fds in self.control.receive()]
        kept = []
        for message in self.told:
            if isinstance(message, TrafficReported):
                for row in message.rows:
                    self._count(row)
            elif isinstance(message, MonitorsReported):
                for event in message.events:
                    self.counted[event.resource, f"{event.kind} of {event.monitor}"] += event.count or 1
            elif not isinstance(message, MonitorsCounted):
                kept.append(message)
        self.told = kept[-1000:]

    def _count(self, row: Any) -> None:
        self.counted[row.resource, "messages"] += row.messages
        self.counted[row.resource, "bytes"] += row.bytes
        self.counted[row.resource, "dropped"] += row.dropped
        self.counted[row.resource, "delayed"] += sum(row.delays)

    def totals(self) -> dict[str, Any]:
        self.loop.turn(0)
        self.collect()
        for topic in _TOPICS:
            row = self.engine.topics["k", topic].traffic()
            if row is not None:
                self._count(row)
        interceptor = self.engine.interceptor
        monitors = interceptor.monitors
        rows = [] if monitors is None else interceptor.observer.rows(monitors, interceptor.now())
        # The two do not take the same real time.
        rows = [msgspec.structs.replace(row, timed=0, late=0, latest=0.0) for row in rows]
        return {"counted": dict(self.counted), "rows": rows}

    def recovered(self, statement: SpecificationsStated) -> list[bytes]:
        left = StateKeeper(self.given, self.memory).recover()
        monitors = Loader.load(statement, str)
        if left is None or isinstance(monitors, list):
            return []
        monitors.recover(left.groups, left.lost, self.engine.interceptor.now())
        return [group.base() for group in monitors.kept_groups() if "timed" not in group.names]


def _nothing(_batch: Batch) -> None:
    """Do nothing: a tap keeps the pump from a topic."""


class PumpComparison:
    def __init__(self, seed: int) -> None:
        self._random = Random(seed)  # noqa: S311  repeats a run
        self.both = ComparedRelay(pumped=True), ComparedRelay(pumped=False)
        self.done: Counter[str] = Counter()
        self._revision = 0
        self._statement: SpecificationsStated | None = None
        self._ordered = False
        self._statements: dict[tuple[str, ...], SpecificationsStated] = {}
        self._slow: dict[str, str] = {}
        self._fast = {"/listener": "/chatter", "/other_listener": "/other"}
        self._number = 0
        for side in self.both:
            for name, topic in self._fast.items():
                side.subscribe(topic, name)

    def close(self) -> None:
        for side in self.both:
            side.close()

    def step(self) -> None:
        steps = (
            (900, self._batch), (60, self._read), (12, self._leave), (8, self._join), (8, self._both_at_once),
            (8, self._switch), (5, self._load), (5, self._break), (5, self._end), (5, self._large), (10, self._compare),
        )  # fmt: skip
        (chosen,) = self._random.choices([step for _, step in steps], [weight for weight, _ in steps])
        chosen()
        self.done[chosen.__name__.strip("_")] += 1

    def run(self, batches: int) -> None:
        while self.done["batch"] < batches:
            self.step()
        self._compare()

    # --- steps ---

    def _batch(self) -> None:
        topic = _TOPICS[self._random.random() < 0.2]
        count = self._random.choice((1, 1, 1, 1, 2, 3, 10, 60)) if self._random.random() < 0.998 else 4200
        frames = [self._message() for _ in range(count)]
        data = b"".join(frames)
        pieces = [data]
        if self._random.random() < 0.1:
            cuts = sorted(self._random.randrange(len(data) + 1) for _ in range(self._random.randint(1, 3)))
            pieces = [data[one:other] for one, other in zip([0, *cuts], [*cuts, len(data)], strict=True)]
        watched = self._random.random() < 0.02
        for side in self.both:
            side.expected[topic] += count
            with self._watching(side) if watched else contextlib.nullcontext():
                for piece in pieces:
                    side.push(side.publishers[topic], piece)
                    side.loop.turn(0)
        self._settle()

    def _both_at_once(self) -> None:
        if self._ordered:
            return
        messages = [self._message() for _ in _TOPICS]
        for side in self.both:
            for topic, message in zip(_TOPICS, messages, strict=True):
                side.expected[topic] += 1
                side.publishers[topic].send(message)
        self._settle()

    def _large(self) -> None:
        message = string("L" * self._random.choice((131_065, 131_064, 131_070, 200_000, 1_000_000)))
        topic = self._random.choice(_TOPICS)
        for side in self.both:
            side.expected[topic] += 1
            side.push(side.publishers[topic], message)
        self._settle()

    def _read(self) -> None:
        if self._slow:
            name = self._random.choice([*self._slow])
            for side in self.both:
                side.subscribers[name].read()
            self._compare_bytes(name)

    def _join(self) -> None:
        if len(self._slow) < self._random.choice((2, 3, 18)):
            self._number += 1
            name, topic = f"/slow_{self._number}", self._random.choice(_TOPICS)
            self._slow[name] = topic
            for side in self.both:
                side.subscribe(topic, name)
            self._settle()

    def _leave(self) -> None:
        if self._slow:
            name = self._random.choice([*self._slow])
            topic = self._slow.pop(name)
            reset = self._random.random() < 0.3
            for side in self.both:
                peer = side.subscribers.pop(name)
                peer.reset() if reset else peer.sock.close()
                self._served(side, topic)

    def _served(self, side: ComparedRelay, topic: str) -> None:
        there = [*self._slow.values(), *self._fast.values()].count(topic)
        side.until(lambda: len(side.engine.topics["k", topic].members) == there)

    def _switch(self) -> None:
        name, on = (
            self._random.choice(("count", "turns", "guard", "silent", "each", "timed", "a", "b")),
            self._random.random() < 0.7,
        )
        for side in self.both:
            side.state(MonitorSwitched(name, on))
        self._settle()

    def _load(self) -> None:
        texts = self._random.choice(_SETS)
        if texts not in self._statements:
            files = [(f"{number}.rv", text) for number, text in enumerate(texts)]
            self._statements[texts] = stated(1, files)
        self._revision += 1
        self._statement = self._statements[texts]
        self._ordered = any("/other" in text for text in texts)
        for side in self.both:
            side.engine.interceptor.tick()  # what was counted since the last second belongs to the earlier monitors
            side.state(structs.replace(self._statements[texts], revision=self._revision))
            side.answered(self._revision)
        self._settle()

    def _break(self) -> None:
        self._end_with(struct.pack("<I", self._random.choice((5 << 20, 0xFFFFFFFF))))

    def _end(self) -> None:
        self._end_with(self._message()[: self._random.randrange(6)])

    def _end_with(self, data: bytes) -> None:
        topic = self._random.choice(_TOPICS)
        for side in self.both:
            peer = side.publishers[topic]
            peer.send(data)
            peer.sock.close()
            side.publish(topic)
            side.loop.turn(0)
        self._settle()

    # --- comparison ---

    def _settle(self) -> None:
        for side in self.both:
            side.take_all()
        for name in self._fast:
            self._catch_up(name)
        for side in self.both:
            side.collect()

    def _catch_up(self, name: str) -> None:
        def same() -> bool:
            for side in self.both:
                side.loop.turn(0)
                side.subscribers[name].read()
            self._compare_bytes(name)
            return not any(side.subscribers[name].data for side in self.both)

        self.both[0].until(same, 20)

    def _compare_bytes(self, name: str) -> None:
        one, other = (side.subscribers[name].data for side in self.both)
        common = min(len(one), len(other))
        if one[:common] != other[:common]:
            at = next(at for at in range(common) if one[at] != other[at])
            part = slice(max(0, at - 40), at + 40)
            raise AssertionError(f"{name} gets {one[part]!r} by the pump, {other[part]!r} without")
        self.done["bytes compared"] += common
        del one[:common], other[:common]

    def _compare(self) -> None:
        for name in (*self._slow, *self._fast):
            self._catch_up(name)
        for side in self.both:
            side.loop.turn(0)
        for name in (*self._slow, *self._fast):
            self._catch_up(name)
        for side in self.both:
            side.engine.interceptor.tick()  # reports the actions that were counted
            side.engine.interceptor.observations.flush()
        totals: list[dict[str, Any]] = []

        def equal() -> bool:
            totals[:] = [side.totals() for side in self.both]
            return totals[0] == totals[1]

        one, other = self.both
        with contextlib.suppress(AssertionError):  # the message below is better
            one.until(equal)
        if self._statement is not None:
            assert one.recovered(self._statement) == other.recovered(self._statement), (
                "the states of monitors differ"
            )
        for (what, value), another in zip(totals[0].items(), totals[1].values(), strict=True):
            assert value == another, f"{what}: {value} by the pump, {another} without"

    @contextlib.contextmanager
    def _watching(self, side: ComparedRelay) -> Any:
        seen: list[bool] = []

        def watch(frame: FrameType, event: str, _argument: Any) -> None:
            if event == "call" and frame.f_code.co_qualname in {"RelayedTopic.received", "RelayedTopic.sent"}:
                seen.append(True)

        sys.setprofile(watch)
        try:
            yield
        finally:
            sys.setprofile(None)
        self.done[f"{'pump' if side.pumped else 'plain'}: {'by Python' if seen else 'without Python'}"] += 1

    def _message(self) -> bytes:
        word = self._random.choice(_WORDS)
        if self._random.random() < 0.1:
            word = "y" * self._random.choice((100, 1000, 4085, 4092, 10_000, 60_000))
        return string(word)


def main(arguments: list[str]) -> None:
    comparison = PumpComparison(int(arguments[0]))
    comparison.run(int(float(arguments[1])))
    comparison.close()
    counts = "\n".join(f"{number:>12}  {name}" for name, number in sorted(comparison.done.items()))
    sys.stdout.write(f"{counts}\n")


if __name__ == "__main__":
    main(sys.argv[1:])
