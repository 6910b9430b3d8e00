"""The heartbeat in a deployed appliance falls on each fault, on a topic and on a serial line (a pseudo-terminal)."""

import contextlib
import itertools
import json
import math
import os
import signal
import struct
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Self

import pytest

from appliance.channel import admin
from appliance.channel.admin import StatusWanted
from appliance.features.guards.guard_answers import GuardTimes
from appliance.features.guards.presets import PRESETS, Guard, text_of
from appliance.features.guards.requests import GuardSet, GuardsWanted
from examples.landshark.lab import Lab
from tests.support.appliance import Appliance
from tests.support.features.guards.guarded_robot import GARBAGE, VELOCITY, Stream, scans, stream
from tests.support.nodes import RosSession
from tests.support.processes import Process
from tests.support.waiting import eventually

TIMES = int(os.environ.get("HEARTBEAT_TIMES", "3"))
"""How often each fault happens."""
FIGURES = os.environ.get("HEARTBEAT_FIGURES", "")
"""A file for the latest edge after each fault."""
WITHIN = 0.2
"""Seconds after a fault without an edge from then on."""
OBSERVED = 0.5
TOPIC = "/rosrv/heartbeat"
BUDGET = 300
"""Milliseconds: a monitor may keep the relay busy for longer than `relay.late` without a fault."""
BURN = """
burn() {
    int total = 0;
    event burn(int n) /burn std_msgs/Int32 '{data: n}' {
        int x = 0;
        for (int i = 0; i < n; i++) { x = x + i % 7; }
        total = x;
        if (n < 0) { DROP; }
    }
}
"""


class Line:
    """A serial line: a pseudo-terminal at a fixed path, which may be pulled out and put in again."""

    def __init__(self) -> None:
        self.path = Path(f"/dev/rosrv-test-{os.getpid()}")
        self.edges: list[tuple[float, int]] = []
        self._ends: list[int] = []
        self.put_in()

    def put_in(self) -> None:
        ours, theirs = os.openpty()
        self._ends = [ours, theirs]
        self.path.symlink_to(os.ttyname(theirs))
        threading.Thread(target=self._read, args=(ours,), daemon=True).start()

    def pull_out(self) -> None:
        self.path.unlink()
        for end in self._ends:
            os.close(end)
        self._ends = []

    def _read(self, ours: int) -> None:
        with contextlib.suppress(OSError):
            while data := os.read(ours, 64):
                self.edges += [(time.monotonic(), byte) for byte in data]


class Beating:
    """An appliance with two relays, a moving robot, and listeners to both heartbeats."""

    def __init__(self, lab: Lab, home: Path) -> None:
        self.line, self.home = Line(), home
        self.host = lab.host("beating", "10.77.0.7/24")
        self.robot = lab.host("beatingrobot", "10.77.0.8/24")
        deadman = text_of(Guard("deadman", PRESETS["deadman"]))
        sensor = text_of(Guard("sensor", PRESETS["sensor"], types={"by": "sensor_msgs/LaserScan"}))
        settings = f"relay: {{heartbeat: {TOPIC}, heartbeat_line: {self.line.path}, budget: {BUDGET}}}\n"
        self.appliance = Appliance(
            self.host,
            options=("--api", "off"),
            settings=settings,
            monitors={"deadman": deadman, "sensor": sensor, "burn": BURN},
            relays=2,
        )
        self.late = Counter[str]()

    def __enter__(self) -> Self:
        self.appliance.__enter__()
        self.ros = RosSession(self.appliance.master_uri, self.home, self.robot)
        self.listener = self.ros.node("rospy", "edge_listener", TOPIC, name="drive")
        self.base = self.ros.node("rospy", "frame_listener", "/cmd_vel", "/driver", name="base")
        self.driver = self.talker("driver", {"/cmd_vel": VELOCITY, "/scan": scans(180)})
        self.burner = self.talker("burner", {"/burn": stream("std_msgs/Int32", 1, {})})
        return self

    def __exit__(self, *exc: object) -> None:
        with contextlib.suppress(FileNotFoundError):
            self.line.pull_out()
        self.ros.__exit__(*exc)
        self.appliance.__exit__(*exc)

    def talker(self, name: str, streams: dict[str, Stream]) -> Process:
        node = self.ros.node("rospy", "frame_talker", name=name)
        node.send(json.dumps([one.on(topic) for topic, one in streams.items()]))
        return node

    def edges(self) -> dict[str, list[tuple[float, int]]]:
        heard = [(one["at"], one["level"]) for one in self.listener.events if one.get("event") == "edge"]
        return {"topic": heard, "line": list(self.line.edges)}

    def since(self, moment: float) -> dict[str, list[float]]:
        return {name: [at for at, _level in found if at >= moment] for name, found in self.edges().items()}

    def why(self) -> str | None:
        status = self.appliance.ask(StatusWanted())
        found: str | None = status.guards.heartbeat  # type: ignore[attr-defined]  # the feature adds it
        return found

    def beats(self) -> None:
        """Wait until both heartbeats have been on for half a second."""

        def on() -> bool:
            moment = time.monotonic() - 0.4
            return all(len(found) >= 6 for found in self.since(moment).values())

        eventually(on, lambda: f"the heartbeat is on: {self.why()}", 60)

    def burn(self, number: int) -> None:
        self.burner.send(json.dumps({"do": "say", "hex": struct.pack("<i", number).hex()}))


Fault = Callable[[Beating], contextlib.AbstractContextManager[float]]
"""Begins a fault, yields when it has begun, and ends it."""


def relays(beating: Beating) -> list[int]:
    def both() -> list[int] | None:
        pids = beating.appliance.pids("relay")
        return pids if len(pids) == 2 else None

    return eventually(both, "both relays run")


@contextlib.contextmanager
def _signalled(beating: Beating, number: int, relay: int) -> Iterator[float]:
    pid = relays(beating)[relay]
    began = time.monotonic()
    os.kill(pid, number)
    yield began
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGCONT)


def first_relay_stopped(beating: Beating) -> contextlib.AbstractContextManager[float]:
    return _signalled(beating, signal.SIGSTOP, 0)


def other_relay_stopped(beating: Beating) -> contextlib.AbstractContextManager[float]:
    return _signalled(beating, signal.SIGSTOP, 1)


def first_relay_killed(beating: Beating) -> contextlib.AbstractContextManager[float]:
    return _signalled(beating, signal.SIGKILL, 0)


def other_relay_killed(beating: Beating) -> contextlib.AbstractContextManager[float]:
    return _signalled(beating, signal.SIGKILL, 1)


@contextlib.contextmanager
def relay_busy(beating: Beating) -> Iterator[float]:
    """A monitor's loop keeps a relay from everything else, within its budget."""
    began = time.monotonic()
    beating.burn(8_000_000)
    yield began


@contextlib.contextmanager
def over_budget(beating: Beating) -> Iterator[float]:
    began = time.monotonic()
    beating.burn(2_000_000_000)
    yield began


@contextlib.contextmanager
def disabled(beating: Beating) -> Iterator[float]:
    beating.appliance.ask(admin.MonitorSwitch(["deadman"], False))
    yield time.monotonic()
    beating.appliance.ask(admin.MonitorSwitch(["deadman"], True))


@contextlib.contextmanager
def unreadable(beating: Beating) -> Iterator[float]:
    """Malformed bytes come on a topic that a guard observes, so it begins again."""
    began = time.monotonic()
    beating.driver.send(json.dumps({"do": "say", "hex": GARBAGE}))
    yield began


@contextlib.contextmanager
def line_lost(beating: Beating) -> Iterator[float]:
    beating.line.pull_out()
    yield time.monotonic()
    beating.line.put_in()


@contextlib.contextmanager
def stopped(beating: Beating) -> Iterator[float]:
    """The appliance is stopped, which it may take its time for: the end of its relays is what counts."""
    found = relays(beating)
    beating.appliance.stop()
    yield time.monotonic()
    assert not any(Path("/proc", str(pid)).exists() for pid in found)
    beating.appliance.start()


@contextlib.contextmanager
def supervisor_killed(beating: Beating) -> Iterator[float]:
    assert beating.appliance.process is not None
    began = time.monotonic()
    beating.appliance.process.stop(with_signal=signal.SIGKILL)
    yield began
    beating.appliance.start()


FAULTS: tuple[Fault, ...] = (
    first_relay_stopped, other_relay_stopped, first_relay_killed, other_relay_killed, relay_busy, over_budget, disabled,
    unreadable, line_lost, stopped, supervisor_killed,
)  # fmt: skip


@pytest.fixture(scope="module")
def beating(common_lab: Lab, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Beating]:
    with Beating(common_lab, tmp_path_factory.mktemp("beating")) as running:
        running.beats()
        yield running


@pytest.mark.parametrize("fault", FAULTS, ids=[fault.__name__ for fault in FAULTS])
def test_the_heartbeat_falls_on_each_fault(beating: Beating, fault: Fault) -> None:
    """No edge comes later than 200 ms after the fault; when the fault is over, the heartbeat returns."""
    found = []
    for _ in range(TIMES):
        beating.beats()
        with fault(beating) as began:
            threading.Event().wait(OBSERVED)
            edges = beating.since(began)
            found.append(
                {name: max((at - began for at in edge), default=0.0) for name, edge in edges.items()}
            )
    beating.beats()
    latest = {name: max(one[name] for one in found) for name in found[0]}
    if FIGURES:
        with Path(FIGURES).open("a", encoding="utf-8") as file:
            file.write(json.dumps({"fault": fault.__name__, "times": len(found), **latest}) + "\n")
    assert all(at <= WITHIN for at in latest.values()), found


def control_killed(beating: Beating) -> None:
    killed = beating.appliance.kill("control")
    eventually(lambda: set(beating.appliance.pids("control")) - {killed}, "control runs again")


def value_set(beating: Beating) -> None:
    beating.appliance.ask(GuardSet("deadman", {"silent": "0.9"}))


def guard_tried(beating: Beating) -> None:
    """Load a guard in shadow mode, and remove it."""
    speed = text_of(Guard("speed", PRESETS["speed"]))
    beating.appliance.ask(admin.MonitorLoad({"speed.rv": speed}, shadow=True))
    beating.appliance.ask(admin.MonitorRemove(["speed.rv"]))


def robot_stopped(beating: Beating) -> None:
    """The driver falls silent, so the guard stops the base: it does its work."""
    beating.driver.send(json.dumps({"do": "pause"}))
    beating.appliance.recorded(event="stop begun")
    beating.driver.send(json.dumps({"do": "resume"}))


@pytest.mark.parametrize("act", [control_killed, value_set, guard_tried, robot_stopped])
def test_the_heartbeat_goes_on_while_guards_can_act(beating: Beating, act: Callable[[Beating], None]) -> None:
    """Nothing but a delay of this machine ends it."""
    beating.beats()
    beating.appliance.ignore_earlier_records()
    began = time.monotonic()
    act(beating)
    threading.Event().wait(OBSERVED)
    gaps = {
        name: max((b - a for a, b in itertools.pairwise([began, *found])), default=math.inf)
        for name, found in beating.since(began).items()
    }
    ended = [one["reason"] for one in beating.appliance.audit(event="heartbeat ended")]
    assert all("ms late" in one for one in ended)
    assert ended or max(gaps.values()) < 2 * WITHIN, gaps
    beating.beats()


def test_delays_are_counted_over_a_restart_of_a_relay(beating: Beating) -> None:
    """A relay that was stopped is late, which is an alarm; a new relay process counts on."""

    def times() -> GuardTimes:
        rows = {guard.name: guard.times for guard in beating.appliance.ask(GuardsWanted()).guards}
        assert rows["deadman"] is not None
        return rows["deadman"]

    beating.beats()
    before = times()
    for number in (signal.SIGSTOP, signal.SIGCONT):  # the guard is in one of the two
        for pid in relays(beating):
            os.kill(pid, number)
        threading.Event().wait(0.2)
    eventually(lambda: times().late > before.late, "the delay is counted")
    assert times().latest >= times().limit
    assert any(row["kind"] == "guard-late:deadman" for row in beating.appliance.rows("alarm", "list"))
    late, timed = times().late, times().timed
    killed = beating.appliance.kill("relay")
    eventually(lambda: killed not in beating.appliance.pids("relay"), "another relay runs")
    beating.beats()
    eventually(lambda: times().timed > timed and times().late >= late, "the counts go on")
