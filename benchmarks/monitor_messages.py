"""The cost of monitors for one message: `python benchmarks/monitor_messages.py`.

The reference specification reads two fields, writes one, and steps one state machine. Each time is the median of the
rounds, in microseconds of processor time for one message.
"""

import statistics
import struct
import time
from collections.abc import Callable
from functools import partial

from rosmop.check.sources import compiled_from
from rosmop.fast.build import fast_path_of
from rosmop.run.engine import MonitorSet
from roswire.standard import standard_definitions

MESSAGES = 20_000
ROUNDS = 7

REFERENCE = """reference() {
    double limit = 1.0;
    event go(double x, double z) /cmd geometry_msgs/TwistStamped '{twist:{linear:{x:x}, angular:{z:z}}}' {
        if (x > limit && z < 1) { x = limit; }
    }
    event stop() /stop std_msgs/Empty '{}' { }
    fsm: s0 [ go -> s0, stop -> s1 ] s1 [ go -> bad, stop -> s1 ] bad [ default bad ]
    @bad { ROS_WARN("moved after stop"); }
}
"""
GROWING = "growing() { event e(std::string f) /cmd geometry_msgs/TwistStamped '{header.frame_id:f}' { f += \"_x\"; } }"
SCAN = """scan() { double nearest = 0;
    event e(float[] ranges) /scan sensor_msgs/LaserScan '{ranges:ranges}' {
        double found = 1e9;
        for (int i = 0; i < ranges.size(); i++) {
            if (!std::isnan(ranges[i]) && ranges[i] < found) { found = ranges[i]; }
        }
        nearest = found;
    }
}"""
WATCHED = """watched() { event e(double x) /cmd geometry_msgs/TwistStamped '{twist:{linear:{x:x}}}' { }
    tfsm: quiet [ e -> moving ] moving [ e -> moving, timeout 500 ms -> quiet ] @timeout { ROS_WARN("silence"); } }"""
HANDLED = """handled() { int n = 0; event e(double x) /cmd geometry_msgs/TwistStamped '{twist:{linear:{x:x}}}' { }
    ptltl: e @violation { n = 1; } @validation { n = 2; } }"""
SAID = """said() { event e(double x) /cmd geometry_msgs/TwistStamped '{twist:{linear:{x:x}}}' {
    ROS_INFO("%f", x); } }"""
KEPT = """kept() { std::string last; int n = 0;
    event e(std::string f) /cmd geometry_msgs/TwistStamped '{header.frame_id:f}' {
        if (f != last) { n++; } last = f; } }"""
WINDOW = """window() { std::vector<double> window; double mean = 0;
    event e(double x) /cmd geometry_msgs/TwistStamped '{twist:{linear:{x:x}}}' {
        window.push_back(x); if (window.size() > 10) { window.erase(window.begin()); }
        mean = std::accumulate(window.begin(), window.end(), 0.0) / window.size(); } }"""
PUBLISHED = """published() { std_msgs::Float64 m; event e(double x) /cmd geometry_msgs/TwistStamped
    '{twist:{linear:{x:x}}}' { m.data = x; PUBLISH(/out, std_msgs/Float64, m); } }"""
STOPPED = """stopped() { safe geometry_msgs/TwistStamped { header.frame_id: "base_link" } on /cmd every 1s;
    event e(double x) /cmd geometry_msgs/TwistStamped '{twist:{linear:{x:x}}}' { if (!(x <= 1)) { STOP; } } }"""
WHOLE = "whole() { geometry_msgs::TwistStamped v; event e() /cmd geometry_msgs/TwistStamped '{}' { v = MESSAGE; } }"
OTHERS = "".join(
    f"other{number}() {{ event e(int x) /other{number} std_msgs/Int32 '{{data:x}}' {{ x++; }} }}\n"
    for number in range(10)
)


def command(frame: bytes = b"base_link") -> bytes:
    return struct.pack(f"<IIII{len(frame)}s6d", 1, 2, 3, len(frame), frame, 2.0, 0, 0, 0, 0, 0.5)


COMMAND = command()
LASER = struct.pack(
    "<IIII4s7fI100fI", 1, 2, 3, 4, b"scan", *[0.5] * 7, 100, *(2.0 - n / 100 for n in range(100)), 0
)


def microseconds(action: Callable[[], object], times: int) -> float:
    rounds = []
    for _ in range(ROUNDS):
        started = time.process_time()
        for _ in range(times):
            action()
        rounds.append((time.process_time() - started) / times)
    return statistics.median(rounds) * 1e6


def monitors(text: str) -> MonitorSet:
    loaded = MonitorSet.of(compiled_from({"benchmark.rv": text}, DEFINITIONS))
    loaded.start(0)
    return loaded


def with_module(text: str) -> MonitorSet:
    compiled = compiled_from({"benchmark.rv": text}, DEFINITIONS)
    loaded = MonitorSet.of(compiled, fast=fast_path_of(compiled))
    loaded.start(0)
    return loaded


def batched(messages: int, body: bytes, text: str = REFERENCE, topic: str = "/cmd") -> float:
    """Return the microseconds of a message in batches. The first message, for the buffers, is not measured."""
    loaded = with_module(text)
    loaded.process(topic, bytearray(body), 1)
    lane, area = loaded.lane(topic), loaded.area
    assert lane is not None
    assert area is not None
    frame = struct.pack("<I", len(body)) + body
    view = area[: len(frame) * messages]
    view[:] = frame * messages
    prepared = lane.prepare(loud=False, told=(), counted=[True] * len(lane.verdicts))
    times = MESSAGES // messages

    def process() -> None:
        view[:] = frame * messages  # a monitor may have changed it
        lane.process_batch(view, 0, 0, [], 1, prepared)

    return microseconds(process, times) / messages


DEFINITIONS = standard_definitions()


def main() -> None:
    reference = monitors(REFERENCE)
    rows = [
        ("a topic of no monitor", lambda: reference.process("/elsewhere", COMMAND, 1)),
        ("reference", lambda: reference.process("/cmd", bytearray(COMMAND), 1)),
    ]
    many = monitors(REFERENCE + OTHERS)
    rows.append(("reference, ten other monitors", lambda: many.process("/cmd", bytearray(COMMAND), 1)))
    for name, text in (
        ("a string grows", GROWING),
        ("a string is kept, engine", KEPT),
        ("a window of ten, engine", WINDOW),
        ("a message is published", PUBLISHED),
        ("a copy of all", WHOLE),
        ("a stop, engine", STOPPED),
    ):
        loaded = monitors(text)
        rows.append((name, partial(loaded.process, "/cmd", COMMAND, 1)))
    for name, action in rows:
        print(f"{name:32} {microseconds(action, MESSAGES):8.2f} µs")
    for name, messages, body in (
        ("reference, 1000 together", 1000, COMMAND),
        ("reference, 64 together", 64, COMMAND),
        ("reference, 64 of 4 KiB together", 64, command(b"x" * 4096)),
        ("reference, comes alone", 1, COMMAND),
    ):
        print(f"{name:32} {batched(messages, body):8.3f} µs")
    watched = monitors(WATCHED)
    row = microseconds(lambda: watched.process("/cmd", bytearray(COMMAND), 1), MESSAGES)
    print(f"{'a tfsm, engine':32} {row:8.2f} µs")
    print(f"{'a tfsm, 64 together':32} {batched(64, COMMAND, WATCHED):8.3f} µs")
    print(f"{'a string is kept, 64 together':32} {batched(64, COMMAND, KEPT):8.3f} µs")
    print(f"{'a stop each, 64 together':32} {batched(64, COMMAND, STOPPED):8.3f} µs")
    print(f"{'a stop that comes alone':32} {batched(1, COMMAND, STOPPED):8.3f} µs")
    print(f"{'a handler each, 64 together':32} {batched(64, COMMAND, HANDLED):8.3f} µs")
    print(f"{'a line each, 64 together':32} {batched(64, COMMAND, SAID):8.3f} µs")
    scans = monitors(SCAN)
    loop = microseconds(lambda: scans.process("/scan", LASER, 1), MESSAGES // 20)
    print(f"{'a loop over 100 numbers, engine':32} {loop:8.2f} µs")
    print(f"{'a loop over 100, 64 together':32} {batched(64, LASER, SCAN, '/scan'):8.2f} µs")
    files = {"benchmark.rv": REFERENCE}
    loading = microseconds(lambda: MonitorSet.of(compiled_from(files, DEFINITIONS)), 20) / 1000
    print(f"{'loading the reference':32} {loading:8.2f} ms")
    module = microseconds(lambda: with_module(REFERENCE), 20) / 1000
    print(f"{'the same with its module':32} {module:8.2f} ms")


if __name__ == "__main__":
    main()
