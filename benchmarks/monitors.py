"""The cost of a monitor: `python -m benchmarks.monitors` (two or three minutes; the long run: `--all`).

One publisher, one subscriber and one topic use the loopback; `relay_load.cpp` is the load. The middle is, in turns: a
direct connection; `copying_relay.c`; this relay without a monitor, with one on the topic (two fields read, one
written, one FSM step), and with 10 and 50 more on other topics; `topic_tools relay`; a typed rospy relay that does
the monitor's work. Cells are medians of the rounds; ratios are to the C relay in the same round.

- *window*: 64 messages are on their way.
- *flat*: messages are sent as fast as possible; the loss is shown.
- *paced*: 1,000 messages are sent a second; the delay is shown.
- *topics*: 1, 8 and more topics have 1,000 messages a second and a monitor each.
- *memory*: the relay's memory during a flat run of `--minutes`.

`--relays` leaves out the slowest peers; `--kinds` measures monitors of one kind each instead (`KINDS`). Needs g++,
rosmaster, topic_tools and rospy.
"""

import argparse
import json
import os
import statistics
import subprocess
import threading
from pathlib import Path

from benchmarks.relay_throughput import (
    HERE,
    PROGRAM,
    TYPE,
    Direct,
    Relay,
    Result,
    RosRelay,
    System,
    compiled,
    cpu_seconds,
    run,
)
from roswire.definitions import Definitions

COPYING = PROGRAM.with_name("copying_relay")
DEFINITION = HERE / "nodes" / "msg" / f"{TYPE}.msg"
SPECIFICATION = """
NAME() {
    event sample(uint64_t n, double value) TOPIC relay_load/Sample '{number:n, value:value}' {
        if (value > 0.5) { value = (n % 2) / 2.0; }
    }
    fsm: here [ sample -> there ] there [ sample -> here ]
    @fail { ROS_ERROR("impossible"); }
}
"""
KINDS = {
    "read": "(double value) TOPIC relay_load/Sample '{value:value}' when (value > 2) { }",
    "write": "(double value) TOPIC relay_load/Sample '{value:value}' { value = 0.5; }",
    "fsm": "() TOPIC relay_load/Sample '{}' { } fsm: here [ sample -> there ] there [ sample -> here ] @fail { }",
    "ptltl": "() TOPIC relay_load/Sample '{}' { } ptltl: sample => <*> sample @violation { ROS_ERROR(\"no\"); }",
    "string": "(std::string data) TOPIC relay_load/Sample '{data:data}' when (data == \"none\") { }",
    "100 numbers": """(std::vector<uint8_t> data) TOPIC relay_load/Sample '{data:data}' {
        int sum = 0;
        for (int i = 0; i < data.size() && i < 100; i++) { sum += data[i]; }
    }""",
}
TEXT = "uint64 number\nint64 sent\nfloat64 value\nstring data\n"
TEXT_MD5SUM = Definitions.from_files({f"{TYPE}.msg": TEXT}).md5sum(TYPE)
"""The md5sum of the message type with a string in place of its bytes."""
TOPICS = (1, 8)
MORE_TOPICS = (1, 8, 20, 50, 100)
SIZES = (32, 200, 4096, 65536, 1048576, 4194304)
QUICK = {"window": (32, 4096, 65536, 1048576, 4194304), "flat": (32,), "paced": (200,)}
WHOLE = {"window": SIZES, "flat": SIZES[:-1], "paced": SIZES[:4]}
Results = dict[tuple[str, int, str], list[Result]]


class MinimalRelay:
    def __init__(self, name: str, *command: str) -> None:
        """Run `command` with the publisher's port as argument. It prints the port for the subscriber."""
        self.name = name
        self._command = command
        self.pid: int | None = None
        self._process: subprocess.Popen[str] | None = None

    def target(self, publisher: int) -> tuple[int, str]:
        self.close()
        self._process = subprocess.Popen(
            [*self._command, str(publisher)], stdout=subprocess.PIPE, text=True, start_new_session=True
        )
        assert self._process.stdout is not None
        self.pid = self._process.pid
        return int(self._process.stdout.readline()), "-"

    def close(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()


class CopyingRelay(MinimalRelay):
    """`copying_relay.c`. With `epoll`, it waits for data like a relay with many connections."""

    def __init__(self, *, epoll: bool = False) -> None:
        source = HERE / "copying_relay.c"
        if not COPYING.exists() or COPYING.stat().st_mtime < source.stat().st_mtime:
            COPYING.parent.mkdir(parents=True, exist_ok=True)
            subprocess.run(["gcc", "-O2", "-o", str(COPYING), str(source)], check=True)
        super().__init__("C with epoll" if epoll else "C relay", str(COPYING), *(["epoll"] if epoll else []))


def specification(name: str, topic: str) -> str:
    return SPECIFICATION.replace("NAME", name).replace("TOPIC", topic)


def monitored(others: int) -> Relay:
    name = f"+ {others} elsewhere" if others else "one monitor"
    relay = Relay(name)
    files = [("load.rv", specification("load", "/load"))]
    files += [
        (f"other{number}.rv", specification(f"other{number}", f"/other{number}")) for number in range(others)
    ]
    try:
        relay.monitor(files, {f"{TYPE}.msg": DEFINITION.read_text()})
    except BaseException:
        relay.close()
        raise
    return relay


def of_kind(name: str) -> Relay:
    relay = Relay(name)
    definition = TEXT if name == "string" else DEFINITION.read_text()
    try:
        files = [("load.rv", f"load() {{ event sample{KINDS[name].replace('TOPIC', '/load')} }}")]
        relay.monitor(files, {f"{TYPE}.msg": definition})
    except BaseException:
        relay.close()
        raise
    return relay


def topics_at_once(number: int, seconds: float) -> tuple[float, float, float]:
    """Send 1,000 messages of 200 bytes a second on each topic, which has a monitor.

    Return the median and the largest of the topics' p50 (microseconds), and the relay's share of a core.
    """
    relay = Relay("topics")
    names = [f"/load{one}" for one in range(number)]
    files = [(f"{one}.rv", specification(f"load{one}", name)) for one, name in enumerate(names)]
    loads: list[subprocess.Popen[str]] = []
    try:
        relay.monitor(files, {f"{TYPE}.msg": DEFINITION.read_text()})
        for _ in names:
            command = [str(compiled()), "200", str(seconds), "paced"]
            loads.append(subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True))
        for name, load in zip(names, loads, strict=True):
            assert load.stdin is not None
            assert load.stdout is not None
            port, topic = relay.place(int(load.stdout.readline()), name)
            load.stdin.write(f"{port} {topic}\n")
            load.stdin.flush()
        before = cpu_seconds(relay.pid)
        answers = [json.loads(load.communicate()[0]) for load in loads]
        busy = (cpu_seconds(relay.pid) - before) / seconds
    finally:
        for load in loads:
            load.kill()
            load.wait()
        relay.close()
    delays = [answer["p50_us"] for answer in answers]
    return statistics.median(delays), max(delays), busy


def show_topics(numbers: tuple[int, ...], rounds: int, seconds: float) -> None:
    print("\n1,000 messages of 200 bytes a second on each topic, a monitor on each: p50 in microseconds")
    first = 0.0
    for number in numbers:
        found = [topics_at_once(number, seconds) for _ in range(rounds)]
        middle, worst, busy = (statistics.median(column) for column in zip(*found, strict=True))
        first = first or middle
        print(
            f"{number:>4} topics: {middle:8.0f}  x{middle / first:.2f}, slowest topic {worst:.0f}"
            f" (the relay takes {busy:.0%} of a core)",
            flush=True,
        )


def resident(pid: int | None) -> float:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def show_memory(minutes: float) -> None:
    relay = monitored(0)
    print(f"\nas fast as it goes for {minutes:g} minutes, one monitor: MiB that the relay holds", flush=True)
    try:
        run("flat", 200, 0.4, relay)
        load = threading.Thread(target=lambda: run("flat", 200, minutes * 60, relay))
        load.start()
        while load.is_alive():
            load.join(minutes * 5)
            print(f"{resident(relay.pid):.1f}", end=" ", flush=True)
        print()
    finally:
        relay.close()


def show(results: Results, mode: str, sizes: tuple[int, ...], names: list[str]) -> None:
    what = {
        "window": "64 messages on their way: messages a second",
        "flat": "as fast as it goes: messages a second",
        "paced": "1,000 messages a second: p50 of the delay in microseconds",
    }[mode]
    print(f"\n{what}, xRATIO to the C relay (CPU microseconds a message of what is in the middle)")
    print(f"{'bytes':<16}" + "".join(f"{size:>30,}" for size in sizes))
    for name in names:
        cells = [f"{cell(results, mode, size, name):>30}" for size in sizes]
        print(f"{name:<16}" + "".join(cells), flush=True)


def cell(results: Results, mode: str, size: int, name: str) -> str:
    runs, base = results[mode, size, name], results[mode, size, "C relay"]

    def value(result: Result) -> float:
        return result.p50 if mode == "paced" else result.rate

    ratio = statistics.median(
        value(one) / value(other) if value(other) else float("nan")
        for one, other in zip(runs, base, strict=True)
    )
    loss = statistics.median(one.loss for one in runs)
    cpu = statistics.median(one.cpu for one in runs)
    text = f"{statistics.median(map(value, runs)):,.0f} x{ratio:.2f}"
    text += f" lost {loss:.1%}" if loss else ""
    return text + (f" ({cpu:.2f})" if cpu else "")


def begin(systems: list[System], *, peers: bool, kinds: bool) -> None:
    systems += [Direct(), CopyingRelay(), CopyingRelay(epoll=True), Relay("relay alone")]
    if kinds:
        systems += map(of_kind, KINDS)
        return
    systems += [monitored(others) for others in (0, 10, 50)]
    if peers:
        systems.append(RosRelay())
        systems.append(RosRelay("rospy", ("/usr/bin/python3", str(HERE / "nodes" / "rospy_relay.py"))))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--rounds", type=int, help="of each cell (3; with --all 5)")
    parser.add_argument("--seconds", type=float, help="of each run (0.4; with --all 1.5)")
    parser.add_argument("--all", action="store_true", help="every size in every mode")
    parser.add_argument(
        "--modes",
        type=lambda text: text.split(","),
        help="of window,flat,paced,topics,memory (the first three; with --all all)",
    )
    parser.add_argument("--minutes", type=float, help="of the memory run (1; with --all 10)")
    parser.add_argument("--relays", action="store_true", help="without topic_tools and rospy")
    parser.add_argument("--kinds", action="store_true", help="monitors of one kind each, without peers")
    parser.add_argument("--sizes", type=lambda text: tuple(int(one) for one in text.split(",")))
    options = parser.parse_args()
    rounds = options.rounds or (5 if options.all else 3)
    seconds = options.seconds or (1.5 if options.all else 0.4)
    modes = options.modes or ["window", "flat", "paced", *(["topics", "memory"] if options.all else [])]
    plan = {
        mode: options.sizes or sizes
        for mode, sizes in (WHOLE if options.all else QUICK).items()
        if mode in modes
    }
    results: Results = {}
    systems: list[System] = []
    try:
        if plan:
            begin(systems, peers=not options.relays, kinds=options.kinds)
        for _round in range(rounds):
            for mode, sizes in plan.items():
                for size in sizes:
                    for system in systems:
                        said = [TEXT_MD5SUM] if system.name == "string" else []
                        result = run(mode, size, seconds, system, *said)
                        results.setdefault((mode, size, system.name), []).append(result)
    finally:
        for system in systems:
            system.close()
    for mode, sizes in plan.items():
        show(results, mode, sizes, [system.name for system in systems])
    if "topics" in modes:
        show_topics(MORE_TOPICS if options.all else TOPICS, rounds, max(2.0, seconds))
    if "memory" in modes:
        show_memory(options.minutes or (10 if options.all else 1))


if __name__ == "__main__":
    main()
