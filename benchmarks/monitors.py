"""What a monitor costs: `python -m benchmarks.monitors` (two or three minutes; the long run: `--all`).

One publisher, one subscriber, one topic, loopback; the load is `relay_load.cpp`. In the middle, in turns: nothing;
`copying_relay.c`; this relay without a monitor, with one on the topic (it reads two fields, writes one and steps one
FSM at every message), with 10 and with 50 more on other topics; `topic_tools relay`; a typed rospy relay that does
the monitor's work. Cells are medians of the rounds; ratios are to the C relay, of one round each.

*window*: 64 messages on their way; *flat*: as fast as it goes, with the loss; *paced*: 1,000 a second, the delay.
Needs g++, rosmaster, topic_tools and rospy.
"""

import argparse
import statistics
import subprocess

from benchmarks.relay_throughput import HERE, PROGRAM, TYPE, Direct, Relay, Result, RosRelay, System, run

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
SIZES = (32, 200, 4096, 65536, 1048576, 4194304)
QUICK = {"window": (32, 4096, 65536, 1048576, 4194304), "flat": (32,), "paced": (200,)}
WHOLE = {"window": SIZES, "flat": SIZES[:-1], "paced": SIZES[:4]}
Results = dict[tuple[str, int, str], list[Result]]


class CopyingRelay:
    """The relay in C, a fresh one each run."""

    name = "C relay"

    def __init__(self) -> None:
        source = HERE / "copying_relay.c"
        if not COPYING.exists() or COPYING.stat().st_mtime < source.stat().st_mtime:
            COPYING.parent.mkdir(parents=True, exist_ok=True)
            subprocess.run(["gcc", "-O2", "-o", str(COPYING), str(source)], check=True)
        self.pid: int | None = None
        self._process: subprocess.Popen[str] | None = None

    def target(self, publisher: int) -> tuple[int, str]:
        """Start one in front of this publisher."""
        self.close()
        self._process = subprocess.Popen([str(COPYING), str(publisher)], stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        self.pid = self._process.pid
        return int(self._process.stdout.readline()), "-"

    def close(self) -> None:
        """End it."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()


def specification(name: str, topic: str) -> str:
    """The monitor, on this topic."""
    return SPECIFICATION.replace("NAME", name).replace("TOPIC", topic)


def monitored(others: int) -> Relay:
    """The relay with the monitor on the load's topic and as many others elsewhere."""
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


def show(results: Results, mode: str, sizes: tuple[int, ...], names: list[str]) -> None:
    """Print one mode: medians, ratios to the C relay, losses, CPU time."""
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
    """One cell of the table."""
    runs, base = results[mode, size, name], results[mode, size, "C relay"]

    def value(one: Result) -> float:
        return one.p50 if mode == "paced" else one.rate

    ratio = statistics.median(
        value(one) / value(other) if value(other) else float("nan")
        for one, other in zip(runs, base, strict=True)
    )
    loss = statistics.median(one.loss for one in runs)
    cpu = statistics.median(one.cpu for one in runs)
    text = f"{statistics.median(map(value, runs)):,.0f} x{ratio:.2f}"
    text += f" lost {loss:.1%}" if loss else ""
    return text + (f" ({cpu:.2f})" if cpu else "")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--rounds", type=int, help="of each cell (3; with --all 5)")
    parser.add_argument("--seconds", type=float, help="of each run (0.4; with --all 1.5)")
    parser.add_argument("--all", action="store_true", help="every size in every mode")
    parser.add_argument("--modes", type=lambda text: text.split(","), default=["window", "flat", "paced"])
    parser.add_argument("--sizes", type=lambda text: tuple(int(one) for one in text.split(",")))
    options = parser.parse_args()
    rounds = options.rounds or (5 if options.all else 3)
    seconds = options.seconds or (1.5 if options.all else 0.4)
    plan = {
        mode: options.sizes or sizes
        for mode, sizes in (WHOLE if options.all else QUICK).items()
        if mode in options.modes
    }
    results: Results = {}
    systems: list[System] = [Direct(), CopyingRelay()]
    try:
        systems += [Relay("relay alone")]
        systems += [monitored(others) for others in (0, 10, 50)]
        systems += [
            RosRelay(),
            RosRelay("rospy", ("/usr/bin/python3", str(HERE / "nodes" / "rospy_relay.py"))),
        ]
        for _round in range(rounds):
            for mode, sizes in plan.items():
                for size in sizes:
                    for system in systems:
                        result = run(mode, size, seconds, system)
                        results.setdefault((mode, size, system.name), []).append(result)
    finally:
        for system in systems:
            system.close()
    for mode, sizes in plan.items():
        show(results, mode, sizes, [system.name for system in systems])


if __name__ == "__main__":
    main()
