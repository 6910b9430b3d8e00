"""The heartbeat of relays ends on every cause, and returns when the cause has been over for a second."""

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import pytest

from appliance.base import clock
from appliance.relay.monitors.heartbeat import PERIOD, REST, Heartbeat
from appliance.relay.relay_limits import RelayLimits
from rosmop.tests.acting import message
from tests.support.virtual_clock import VirtualClock, let_time_pass
from tests.unit.relay.monitors.quiet import QuietMonitors

LATE = 0.02
GUARD = """begin s() { double v = 0;
    event e(double v) /cmd_vel geometry_msgs/Twist '{linear.x:v}' { if (v > 9) { return; } }
    event n(int n) /n std_msgs/Int32 '{data:n}' { v = 1 / n; } event tick() every 100ms { } }"""
OBSERVER = "o() { event e() /cmd_vel geometry_msgs/Twist '{}' { } }"
ZERO = message("std_msgs/Int32")


@pytest.fixture(autouse=True)
def virtual_time() -> Iterator[None]:
    with clock.using(VirtualClock()):
        yield


class Relay:
    """One relay in virtual time. `edges` has when its topic got an edge."""

    def __init__(self, memory: memoryview | None = None, index: int = 0, **limits: Any) -> None:
        self.monitors = QuietMonitors(late=LATE)
        self.loop, self.interceptor = self.monitors.loop, self.monitors.interceptor
        self.edges: list[float] = []
        self.delays = {"late": 0, "longest": 0.0}
        self.stop = ""
        self.asked = 0
        topic = SimpleNamespace(topic="/cmd_vel", take_late=self._take_late)
        self.heartbeat = Heartbeat(
            self.loop,
            RelayLimits(late=LATE * 1e3, heartbeat="/beat", **limits),
            self.interceptor,
            publish=lambda _data: self.edges.append(clock.now()),
            topics=lambda: [topic],
            unwritten=lambda: self.stop,
        )
        if memory is not None:
            self.heartbeat.share(memory, index)

        def ask() -> None:
            self.asked += 1

        self.heartbeat.line_wanted = ask

    def _take_late(self) -> tuple[int, float]:
        late, longest = self.delays["late"], self.delays["longest"]
        self.delays = {"late": 0, "longest": 0.0}
        return int(late), longest

    def load(self, *texts: str, **more: Any) -> None:
        self.monitors.load(*texts, **more)

    @property
    def beats(self) -> bool:
        return bool(self.edges) and clock.now() - self.edges[-1] < PERIOD / 2


def run(seconds: float, *relays: Relay) -> None:
    for _ in range(round(seconds / PERIOD)):
        let_time_pass(PERIOD)
        for relay in relays:
            relay.loop.run_due()


@dataclass(frozen=True)
class Cause:
    begin: Callable[[Relay], object]
    words: str
    end: Callable[[Relay], object] = lambda _relay: None


def _fault(relay: Relay) -> None:
    relay.monitors.process("/n", ZERO, clock.now_ns() + relay.interceptor.offset)


def _delay(relay: Relay) -> None:
    relay.delays = {"late": 1, "longest": 0.05}


def _hold(relay: Relay) -> None:
    assert relay.interceptor.monitors is not None
    relay.interceptor.monitors.hold(relay.interceptor.monitors.monitor("s"), "its state is lost")


CAUSES = {
    "disabled": Cause(
        lambda relay: relay.interceptor.switch("s", False),
        "s is disabled",
        lambda relay: relay.interceptor.switch("s", True),
    ),
    "held": Cause(
        _hold, "s holds its topics: its state is lost", lambda relay: relay.interceptor.resume("s")
    ),
    "fault": Cause(_fault, "s had a fault: 0.rv:3:55: division by zero"),
    "late message": Cause(_delay, "s: a message of /cmd_vel came 50 ms late (limit 20 ms)"),
    "long turn": Cause(
        lambda relay: setattr(relay.loop, "_longest", 0.03),
        "s: the relay was busy, so a tick or a message came 30 ms late (limit 20 ms)",
    ),
    "stopped process": Cause(
        lambda _relay: let_time_pass(0.07),
        "s: the relay was busy, so a tick or a message came 70 ms late (limit 20 ms)",
    ),
    "left out": Cause(
        lambda relay: relay.load(GUARD, left_out=("estop.rv",)),
        "estop.rv has an error, and does not run",
        lambda relay: relay.load(GUARD),
    ),
    "stop not taken": Cause(
        lambda relay: setattr(relay, "stop", "/base does not take the stop on /cmd_vel"),
        "/base does not take the stop on /cmd_vel",
        lambda relay: setattr(relay, "stop", ""),
    ),
    "blocked": Cause(
        lambda relay: setattr(relay.interceptor, "blocked", "refused"),
        "refused",
        lambda relay: setattr(relay.interceptor, "blocked", ""),
    ),
}


@pytest.mark.parametrize("name", CAUSES)
def test_each_cause_ends_the_heartbeat(name: str) -> None:
    """At most one more edge comes, control gets the reason, and the edges return a second after the cause."""
    cause, relay = CAUSES[name], Relay()
    relay.load(GUARD, OBSERVER)
    run(2 * REST, relay)
    assert relay.beats and relay.interceptor.observations.unfit == ""
    cause.begin(relay)
    before = len(relay.edges)
    run(REST - PERIOD, relay)
    assert len(relay.edges) <= before + 1
    assert relay.interceptor.observations.unfit == cause.words
    cause.end(relay)
    run(2 * REST, relay)
    assert relay.beats and relay.interceptor.observations.unfit == ""


@pytest.mark.parametrize(
    ("texts", "more", "beats"),
    [
        ((), {}, False),
        ((OBSERVER,), {}, False),
        ((GUARD,), {"shadows": ("s",)}, False),
        ((GUARD, OBSERVER), {"shadows": ("o",)}, True),
        ((GUARD, OBSERVER), {"enabled": {"s": True, "o": False}}, True),
    ],
)
def test_a_monitor_that_acts_has_to_be_in_force(
    texts: tuple[str, ...], more: dict[str, Any], beats: bool
) -> None:
    relay = Relay()
    relay.load(*texts, **more)
    run(2 * REST, relay)
    assert relay.beats is beats


def test_each_relay_has_to_be_fit() -> None:
    """The one that has the topic makes edges only while all others have been fit lately, also those without a guard."""
    memory = memoryview(bytearray(2 * 16))
    first, other = (Relay(memory, index) for index in range(2))
    first.load(GUARD)
    run(2 * REST, first, other)
    assert not first.edges, "the other one has no specifications yet"
    other.load()
    run(2 * REST, first, other)
    assert first.beats
    before = len(first.edges)
    run(1.0, first)
    assert len(first.edges) == before + 1, "the other one is dead"
    run(2 * REST, first, other)
    assert first.beats


def test_a_relay_that_replaces_another_rests_first() -> None:
    """Also if it has its specifications before its first check: a drive has to notice the death."""
    memory = memoryview(bytearray(2 * 16))
    first, other = (Relay(memory, index) for index in range(2))
    for relay in (first, other):
        relay.load(GUARD)
    run(2 * REST, first, other)
    new, before = Relay(memory, 1), len(first.edges)
    new.load(GUARD)
    run(REST - PERIOD, first, new)
    assert len(first.edges) <= before + 1
    run(2 * PERIOD, first, new)
    assert first.beats


def test_a_line_that_is_lost_ends_both_heartbeats_until_there_is_another() -> None:
    relay = Relay(heartbeat_line="/dev/ttyUSB0")
    relay.load(GUARD)
    run(2 * REST, relay)
    assert not relay.edges and relay.asked
    assert relay.interceptor.observations.unfit == "/dev/ttyUSB0 cannot be opened or written to"
    ours, theirs = os.pipe()
    relay.heartbeat.use_line(theirs)
    run(2 * REST, relay)
    assert relay.beats
    assert set(os.read(ours, 100)) == {0x55, 0xAA}
    os.close(ours)
    relay.asked = 0
    run(2 * REST, relay)
    assert (relay.beats, relay.asked > 0) == (False, True)
