"""The cost of slices: `python -m benchmarks.slices`.

Times are the minimum of the rounds in microseconds of processor time. The 10,000 live slices are visited in turn.
"""

import struct
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from rosmop.check.sources import compiled_from
from rosmop.run.engine import MonitorSet
from roswire.standard import standard_definitions

LIVE = 10_000
MANY = 100_000
TOGETHER = 1_000
ROUNDS = 7

PROPERTIES = {
    "fsm": 'fsm: idle [ goal -> active ] active [ goal -> active, result -> idle ] @fail { ROS_WARN("twice"); }',
    "ere": 'ere: goal+ result @match { ROS_INFO("answered"); }',
    "ptltl": 'ptltl: result => <*> goal @violation { ROS_WARN("answered what was not asked"); }',
}
SPECIFICATION = """goals(%s) {
    event goal(std::string id) /goal std_msgs/String '{data:id}' { }
    event result(std::string id) /result std_msgs/String '{data:id}' { }
    %s
}
"""
MORE = {
    "a condition": "when (id.size() > 3 && told < 9) { }",
    "an action": "{ told = told + 1; if (told < 0) { return; } }",
}
STOP = "event stop() /stop std_msgs/Empty '{}' { } "
ALL = SPECIFICATION % ("std::string id", STOP + "ere: goal stop stop @match { }")
WITHIN = SPECIFICATION % (
    "std::string id",
    "pattern: globally: goal causes result within 30s @violation { __RESET; }",
)


def ids(count: int) -> list[bytes]:
    made = (b"/planner-%d-%d.%09d" % (number, 1_700_000_000 + number, number) for number in range(count))
    return [struct.pack("<I", len(one)) + one for one in made]


def monitors(text: str) -> MonitorSet:
    loaded = MonitorSet.of(compiled_from({"slices.rv": text}, standard_definitions()), slices=MANY)
    loaded.start(0)
    return loaded


def microseconds(action: Callable[[], object], times: int, rounds: int = ROUNDS) -> float:
    found = []
    for _ in range(rounds):
        started = time.process_time()
        action()
        found.append((time.process_time() - started) / times)
    return min(found) * 1e6


def visited(text: str, messages: Sequence[bytes]) -> float:
    loaded = monitors(text)

    def visit() -> None:
        for message in messages:
            loaded.process("/goal", message, 1)

    visit()
    return microseconds(visit, len(messages))


def resident() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6


def main() -> None:
    few, many = ids(LIVE), ids(MANY + LIVE)
    for name, formula in PROPERTIES.items():
        plain = visited(SPECIFICATION % ("", formula), few)
        sliced = visited(SPECIFICATION % ("std::string id", formula), few)
        print(
            f"{name}: {plain:.2f} µs without parameters, {sliced:.2f} µs with {LIVE} slices: {sliced / plain:.2f} x"
        )
    for name, does in MORE.items():
        text = SPECIFICATION.replace("'{data:id}' { }", f"'{{data:id}}' {does}", 1)
        text = text.replace("{\n", "{ static long told = 0;\n", 1) % ("std::string id", PROPERTIES["fsm"])
        print(f"fsm with {name}: {visited(text, few):.2f} µs")
    loaded, before = monitors(SPECIFICATION % ("std::string id", PROPERTIES["fsm"])), resident()
    begun = microseconds(lambda: [loaded.process("/goal", one, 1) for one in many[:MANY]], MANY, 1)
    print(f"{MANY} slices: {resident() - before:.0f} MB, {begun:.2f} µs for each that begins")
    beyond = microseconds(lambda: [loaded.process("/goal", one, 1) for one in many[MANY:]], LIVE, 1)
    print(f"beyond the bound: {beyond:.2f} µs for each")
    loaded = monitors(ALL)
    for one in many[:TOGETHER]:
        loaded.process("/goal", one, 1)
    silent = microseconds(lambda: loaded.process("/stop", b"", 2), TOGETHER, 1)
    print(f"an event of {TOGETHER}: {silent:.2f} µs for each")
    told = microseconds(lambda: loaded.process("/stop", b"", 3), TOGETHER, 1)
    print(f"a verdict of {TOGETHER}: {told:.2f} µs for each")
    loaded = monitors(WITHIN)
    timed = microseconds(lambda: [loaded.process("/goal", one, 1) for one in many[:LIVE]], LIVE, 1)
    print(f"with a time: {timed:.2f} µs for each that begins")
    passed = microseconds(lambda: loaded.advance(60 * 10**9), LIVE, 1)
    print(f"a deadline: {passed:.2f} µs for each that passes")


if __name__ == "__main__":
    main()
