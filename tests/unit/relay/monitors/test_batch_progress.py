import itertools
import struct
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from random import Random
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from appliance.channel.messages import MonitorRow
from appliance.relay.loop import EventLoop
from appliance.relay.monitors.interceptor import Interceptor
from appliance.relay.monitors.observation_points import BatchProgress, ObservationPoint
from appliance.relay.monitors.topic_pipeline import TopicPipeline
from appliance.relay.transport.frames import Batch, FrameReceiver, Scratch
from rosmop.check.sources import compiled_from
from rosmop.form.findings import SpecificationError
from rosmop.logics.interface import ClockedRun, FiniteRun
from rosmop.run.engine import MonitorSet
from rosmop.run.execution import MonitorExecution
from rosmop.run.fast_path import BatchResult
from rosmop.tests.acting import message
from rosmop.tests.both_ways import frames, plain
from rosmop.tests.on_module import on_module
from rosmop.tests.random_specifications import (
    Messages,
    Specifications,
    Traffic,
    definitions,
)
from roswire.definitions import Definitions
from roswire.tcpros import encode_frame
from tests.support.examples import examples
from tests.support.relay_memory import share
from tests.support.stated import stated
from tests.unit.relay.monitors.quiet import QuietMonitors, Reports
from tests.unit.transcripts import transcripts

MONITORS = Path(__file__).parents[4] / "monitors"


def traffic_of(topic: str, bodies: Sequence[bytes]) -> Traffic:
    return Traffic(topic, frames(bodies), len(bodies))


class Monitored:
    def __init__(
        self,
        texts: dict[str, str],
        known: Definitions,
        *,
        together: bool,
        on_fault: Any = "drop",
        shadows: Collection[str] = (),
        restarted: bool = False,
        began: int = 1_000_000_000,
    ) -> None:
        self.heard = Reports()
        self.time = began
        self.published: list[tuple[str, bytes]] = []
        self._loop = EventLoop()
        self.interceptor = Interceptor(
            self._loop,
            self.heard,
            budget=1000.0,
            publish=lambda message: self.published.append((message.topic, message.data)),
            changed=lambda _topics: None,
        )
        self.interceptor.over = lambda: False
        self.interceptor.now = lambda: self.time  # type: ignore[method-assign]  # the test sets the time
        self._lanes: dict[tuple[str, str], TopicPipeline] = {}
        compiled, make = compiled_from(texts, known), on_module if together else MonitorSet.of
        self.set = make(compiled, on_fault, shadows=shadows)
        self.interceptor.loaded(stated(1, [], {}, {}, restarted=restarted), self.set)

    def close(self) -> None:
        self.interceptor.close()
        self._loop.close()

    def through(
        self, traffic: Traffic, first: int = 1, publisher: str = "/talker"
    ) -> tuple[int, bytes, bytes]:
        if " " in traffic.topic:
            return self._asked(traffic, publisher)
        scratch = Scratch()
        scratch.move(self.set.area)
        receiver = FrameReceiver(scratch, 1 << 20, share(1 << 30))
        receiver.buffer()[: len(traffic.frames)] = traffic.frames
        batch = receiver.received(len(traffic.frames))
        assert batch is not None
        assert batch.messages == traffic.messages
        batch.first = first
        point = ObservationPoint("key", traffic.topic, "10.0.0.7", publisher)
        lane = self._lanes.setdefault((traffic.topic, publisher), TopicPipeline(self.interceptor, point))
        left = lane.through(batch)
        if left is None:
            return 0, b"", b""
        return left.messages, bytes(left.view), bytes(left.keep_last().view)

    def _asked(self, traffic: Traffic, client: str) -> tuple[int, bytes, bytes]:
        service, part = traffic.topic.split()
        judged = [
            self.interceptor.judge(ObservationPoint("key", service, "10.0.0.7", client), part, body)
            for body in traffic.bodies()
        ]
        left = [one.body for one in judged]
        return sum(one.ok for one in judged), b"\0".join(left), left[-1]

    def told(self) -> list[str]:
        self.interceptor.tick()
        self.interceptor.observations.flush()
        told = sorted(repr(one) for one in self.sent())
        self.heard.sent.clear()
        return told

    def sent(self) -> Iterable[object]:
        for one in self.heard.sent:
            yield from getattr(one, "events", None) or getattr(one, "rows", None) or [one]

    def rows(self) -> list[MonitorRow]:
        return self.interceptor.observer.rows(self.set, self.interceptor.now())

    def state(self) -> list[object]:
        """Return the state to compare, without `next_due`, which may be too early."""
        state: list[object] = []
        for monitor in self.set.monitors:
            state.append((monitor.name, monitor.seen, monitor.faults, monitor.held))
            names = self.set.interpreter.variables
            state += [(name, repr(names.get(code))) for name, code in monitor.code.variables.items()]
            state += [
                one.run.state for one in monitor.properties if isinstance(one.run, FiniteRun | ClockedRun)
            ]
            state += [timer.due for timer in monitor.timers]
            state += [one.run.deadline for one in monitor.properties]
        return state


def agree(texts: dict[str, str], known: Definitions, all_traffic: Iterable[Traffic], on_fault: str = "drop",
          switched: tuple[int, str] | None = None) -> Monitored:  # fmt: skip
    ways = [Monitored(texts, known, together=together, on_fault=on_fault) for together in (False, True)]
    try:
        for number, traffic in enumerate(all_traffic):
            for way in ways:
                way.time += 700_000
                if switched is not None and number in (switched[0], switched[0] + 3):
                    way.interceptor.switch(switched[1], number != switched[0])
            one, together = (way.through(traffic) for way in ways)
            assert one == together, f"batch {number} of {traffic.topic}"
            assert ways[0].published == ways[1].published
            one_state, state = (way.state() for way in ways)
            assert one_state == state, f"after batch {number} of {traffic.topic}"
            if number % 4 == 3:
                one_told, told = (way.told() for way in ways)
                assert one_told == told
        one_told, told = (way.told() for way in ways)
        assert one_told == told
        assert ways[0].rows() == ways[1].rows()
    finally:
        for way in ways:
            way.close()
    return ways[1]


def random_case(seed: int) -> tuple[dict[str, str], list[Traffic]]:
    texts = Specifications(seed).texts()
    messages = Messages(seed)
    return {f"{number}.rv": text for number, text in enumerate(texts)}, [
        messages.traffic() for _ in range(12)
    ]


@settings(max_examples=examples(60), suppress_health_check=[HealthCheck.too_slow], derandomize=True)
@given(st.integers(0, 1 << 40))
def test_random_monitors_do_the_same_together(seed: int) -> None:
    texts, traffic = random_case(seed)
    try:
        agree(texts, definitions(), traffic, ("drop", "pass")[seed % 2], (2, "s1") if seed % 3 == 0 else None)
    except SpecificationError:
        return


HARD = {
    title: "\n".join(lines)
    for title, lines in transcripts(Path(__file__).with_name("hard_cases.txt")).items()
}


@pytest.mark.parametrize("name", HARD)
@pytest.mark.parametrize("on_fault", ["drop", "pass"])
def test_hard_cases_are_the_same_together(name: str, on_fault: str) -> None:
    for seed in range(examples(12)):
        messages = Messages(seed)
        agree({"x.rv": HARD[name]}, definitions(), [messages.traffic() for _ in range(10)], on_fault)


def _shipped_traffic(seed: int) -> list[Traffic]:
    random = Random(seed)  # noqa: S311  draws examples, not keys
    kinds = {
        "/landshark/battery": lambda: message("sensor_msgs/BatteryState", percentage=random.random(), voltage=12.0),
        "/landshark/gps": lambda: message("sensor_msgs/NavSatFix", latitude=37.4 + random.random() / 9),
        "/landshark/odom": lambda: message("nav_msgs/Odometry", pose__pose__position__x=random.uniform(0, 40),
                                           twist__twist__linear__x=random.uniform(-2, 2)),
        "/landshark_control/base_velocity": lambda: message(
            "geometry_msgs/TwistStamped", twist__linear__x=random.uniform(-1, 1)),
        "/landshark/joint_states": lambda: message(
            "sensor_msgs/JointState", name=["turret_pan", "turret_tilt"][: random.choice((1, 2, 2, 2))],
            position=[0.1, random.uniform(-1, 1)]),
        "/landshark_control/trigger": lambda: message("std_msgs/Header", frame_id="ocu") + b"\x01",
        "/landshark/scan": lambda: message("sensor_msgs/LaserScan", angle_increment=0.1,
                                           ranges=[random.uniform(0, 5) for _ in range(4)]),
    }  # fmt: skip
    found = []
    for _ in range(30):
        topic = random.choice(sorted(kinds))
        bodies = [kinds[topic]() for _ in range(random.choice((1, 3, 9)))]
        found.append(traffic_of(topic, bodies))
    return found


def test_shipped_monitors_do_the_same_together() -> None:
    known = definitions().merge(
        Definitions.from_files({"landshark_msgs/PaintballTrigger.msg": "Header header\nuint8 trigger\n"})
    )
    texts = {path.name: path.read_text() for path in sorted(MONITORS.glob("*.rv"))}
    for seed in range(5):
        agree(texts, known, _shipped_traffic(seed))


def test_the_engine_sees_only_reported_requests_and_replies(monkeypatch: pytest.MonkeyPatch) -> None:
    text = """s() { int n = 0; bool b = false;
        event ask(bool wish) service /mode std_srvs/SetBool request '{data:wish}' {
            n++; ROS_INFO("%d", n); if (n % 10 == 9) { return; } if (wish) { wish = false; } }
        event answer(bool ok) service /mode std_srvs/SetBool response '{success:ok}' {
            b = ok; }
        fsm: a [ ask -> b, answer -> a ] b [ answer -> a, ask -> b ] @b { } }"""
    monitored = Monitored({"x.rv": text}, definitions(), together=True)
    asked: list[bytes] = []
    process = monitored.set.process_service

    def noted(*arguments: Any) -> Any:
        asked.append(bytes(arguments[2]))
        return process(*arguments)

    monkeypatch.setattr(monitored.set, "process_service", noted)
    request, response = (
        ObservationPoint("k", "/mode", "10.0.0.7", "/client"),
        ObservationPoint("k", "/mode", "10.0.0.8", "/server"),
    )
    answer = b"\1" + struct.pack("<I", 2) + b"ok"
    try:
        for second in range(2):
            left = [
                monitored.interceptor.judge(request, "request", bytes([number % 2])) for number in range(40)
            ]
            assert [one.body for one in left if one.ok] == [b"\0"] * 36
            assert [monitored.interceptor.judge(response, "response", answer).body for _ in range(40)] == [
                answer
            ] * 40
            assert len(asked) == 4 + 2
            asked.clear()
            (row,) = monitored.rows()
            counted = row.events, row.verdicts, row.drops, row.changes
            assert counted == tuple(count * (second + 1) for count in (80, 36, 4, 20))
            monitored.told()
    finally:
        monitored.close()


def test_most_messages_are_taken_together(monkeypatch: pytest.MonkeyPatch) -> None:
    text = """s() { event e(int count, double x) /plain own/Plain '{count:count, x:x}' { x = count + 0.5; }
                  fsm: a [ e -> b ] b [ e -> a ] @fail { } }"""
    monitored = Monitored({"x.rv": text}, definitions(), together=True)
    single = 0
    process = monitored.set.process

    def counted(*arguments: Any, tried: Any) -> Any:
        nonlocal single
        single += 1
        return process(*arguments, tried=tried)

    monkeypatch.setattr(monitored.set, "process", counted)
    frame = encode_frame(plain(5))
    for _ in range(5):
        left = monitored.through(Traffic("/plain", frame * 1000, 1000))
        assert left == (1000, left[1], left[1][-len(frame) :])
        assert struct.unpack_from("<d", left[1], 4 + 5) == (5.5,)
    monitored.interceptor.tick()
    assert single == 1
    assert [(row.events, row.changes) for row in monitored.rows()] == [(5000, 5000)]
    monitored.close()


def test_lines_describe_the_received_message() -> None:
    text = """s() { event e(unsigned int n) /h geometry_msgs/PointStamped '{header.seq:n}' { n = 3; } }
        t() { int k = 0; event e() /h geometry_msgs/PointStamped '{}' { k++; ROS_INFO("came %d", k); } }
        u() { event e(std::string f) /j geometry_msgs/PointStamped '{header.frame_id:f}' {
                ROS_INFO("from %s", f.c_str()); }
              event all() /j geometry_msgs/PointStamped '{}' { ROS_WARN("any"); } }"""
    bodies = [
        message("geometry_msgs/PointStamped", header__seq=seq, header__frame_id=name)
        for seq, name in ((7, "a"), (8, "b"), (9, "a"))
    ]
    for one in (bodies, [b"abc", *bodies]):
        agree({"x.rv": text}, definitions(), [traffic_of(topic, one) for topic in ("/h", "/j")] * 5)


@pytest.mark.parametrize("does", ["count = 3;", 'count = 3; } @fail { puts("never");', 'puts("came");'])
def test_a_batch_is_prepared_once_until_an_event_happens(does: str, monkeypatch: pytest.MonkeyPatch) -> None:
    event, _, handler = does.partition("}")
    logic = f"fsm: one [ e -> other ] other [ e -> one ] {handler} }}" if handler else ""
    text = f"s() {{ event e(int count) /plain own/Plain '{{count:count}}' {{ {event} }} {logic} }}"
    monitored = Monitored({"x.rv": text}, definitions(), together=True)
    batch = traffic_of("/plain", [plain(5)] * 50)
    for _ in range(2):  # the engine handles the first message, and the first change
        monitored.through(batch)
    asked = []
    walks = MonitorSet.lane_ready

    def watched(*given: Any) -> bool:
        asked.append(given)
        return walks(*given)

    monkeypatch.setattr(MonitorSet, "lane_ready", watched)
    for _ in range(3):
        monitored.through(batch)
    assert not asked
    monitored.interceptor.tick()
    monitored.through(batch)
    assert asked
    monitored.close()


def test_a_change_by_several_monitors_counts_for_each() -> None:
    body = struct.pack("<BidfBII3qI", 1, 5, 2.0, 1.0, 1, 5, 7, 1, 2, 3, 0)
    quiet, far = plain(17, 2.0, 1), plain(5, 9.0, 2)
    traffic = traffic_of("/plain", [far, body, body, quiet, far, quiet])
    monitored = agree({"x.rv": HARD["who changes it differs"]}, definitions(), [traffic] * 50)
    assert {row.name: row.changes for row in monitored.rows()} == {"one": 100, "two": 200, "three": 0}


def test_a_defect_of_the_walk_is_reported_once_and_the_engine_goes_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monitored = Monitored(
        {"x.rv": "s() { event e(int count) /plain own/Plain '{count:count}' { count = 3; } }"},
        definitions(),
        together=True,
    )
    shadowed = []

    def defect(*arguments: object) -> BatchResult:
        shadowed.append(arguments)
        raise ZeroDivisionError

    lane = monitored.set.lane("/plain")
    assert lane is not None
    monkeypatch.setattr(lane, "process_batch", defect)
    frame, changed = encode_frame(plain(5)), encode_frame(plain(3))
    for _ in range(3):
        left = monitored.through(Traffic("/plain", frame * 6, 6))
        assert left == (6, changed * 6, changed)
    told = [one for one in monitored.told() if "kind='fault'" in one]
    assert len(told) == len(shadowed) == 1
    assert "a defect of rosrv" in told[0]
    monitored.close()


def test_messages_that_were_cut_or_replaced_leave_the_rest_in_order() -> None:
    frames = [encode_frame(body) for body in (b"one", b"two", b"three", b"four")]
    progress = BatchProgress(Batch(memoryview(b"".join(frames)), 4, None), 0)
    ends = [*itertools.accumulate(map(len, frames))]
    progress.replace(0, ends[0], b"another")
    progress.cut(ends[1], ends[2])
    left = progress.result()
    assert left is not None and left.messages == 3
    assert bytes(left.view) == encode_frame(b"another") + frames[1] + frames[3]


def test_a_monitor_knows_the_sender_of_a_message() -> None:
    text = """s() { event e() /t std_msgs/Bool '{}' { if (caller(e) == "/evil") { return; } } }"""
    for together in (False, True):
        monitored = Monitored({"x.rv": text}, definitions(), together=together)
        traffic = Traffic("/t", encode_frame(b"\1"), 1)
        assert [monitored.through(traffic, publisher=name)[0] for name in ("/evil", "/talker")] == [0, 1]
        monitored.close()


def test_a_deadline_that_a_message_begins_wakes_the_loop() -> None:
    monitors, wanted = QuietMonitors(), "globally: e causes done within 10ms"
    monitors.load(f"""s() {{ event e() /t std_msgs/Bool '{{}}' {{ }} event done() /done std_msgs/Bool '{{}}' {{ }}
        pattern: {wanted} @violation {{ }} }}""")
    assert not monitors.loop.due
    frame = memoryview(bytearray(encode_frame(b"\1")))
    TopicPipeline(monitors.interceptor, ObservationPoint("k", "/t")).through(Batch(frame, 1, 0))
    assert [seconds for seconds, _timer in monitors.loop.due] == [pytest.approx(0.01, abs=1e-6)]


def test_a_deadline_of_the_engine_is_over_before_the_next_message() -> None:
    text = """s() { bool late = false;
        event other(int c) /plain own/Plain '{count:c}' when (c != 9) { if (late) { return; } }
        event e(int c) /plain own/Plain '{count:c}' when (c == 9) { c = 1; }
        event done() /done std_msgs/Bool '{}' { }
        pattern: globally: e causes done within 10ms @violation { late = true; } }"""
    monitored, passed = Monitored({"x.rv": text}, definitions(), together=True), []
    for milliseconds, count, messages in ((0, 5, 3), (1, 9, 1), (20, 5, 1)):
        monitored.time += milliseconds * 1_000_000
        passed.append(monitored.through(traffic_of("/plain", [plain(count)] * messages))[0])
    assert passed == [3, 1, 0]
    monitored.close()


def test_only_the_named_monitor_is_resumed() -> None:
    text = "%s() { int n = 0; event e() /%s std_msgs/Bool '{}' { n += 1; } }"
    monitored = Monitored({f"{name}.rv": text % (name, name) for name in "ab"}, definitions(), together=False)
    for monitor in monitored.set.monitors:
        monitored.set.hold(monitor, "its state is lost")
    assert monitored.interceptor.resume("a") == {"/a"}
    assert [monitor.name for monitor in monitored.set.monitors if monitor.held] == ["b"]
    monitored.close()


def test_an_awaited_message_changes_no_other_of_its_batch_and_no_count(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    text = """begin s() { double sum = 0; event e(std::vector<float> r) /scan sensor_msgs/LaserScan '{ranges:r}' {
        for (int i = 0; i < r.size(); i++) { sum += r[i]; } } }"""
    monitored = Monitored({"x.rv": text}, definitions(), together=True)
    lane = monitored.set.lane("/scan")
    assert lane is not None
    monkeypatch.setattr(MonitorExecution, "message", None)  # the interpreter would be much too slow
    frames = [encode_frame(message("sensor_msgs/LaserScan", ranges=[1.0] * rays)) for rays in (500, 1, 40)]
    for _ in range(3):
        monitored.set.resume("s")
        monitored.set.monitor("s").sources["/scan"].begin_again()
        monitored.interceptor.invalidate_prepared()
        assert not lane.ready()
        assert monitored.through(Traffic("/scan", b"".join(frames), 3))[:2] == (3, b"".join(frames))
        assert lane.ready()
    monitored.interceptor.tick()
    assert monitored.set.value("s", "sum") == 3 * 541
    assert [row.events for row in monitored.rows()] == [9]
    monitored.close()
