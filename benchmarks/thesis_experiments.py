"""The thesis's experiments (chapter 5, RQ2), with real nodes: `python -m benchmarks.thesis_experiments`.

Two rospy nodes exchange ten messages a second: behind a plain `rosmaster`, behind the appliance without a monitor,
and with one on each topic. Experiments 1 and 2 have one topic, for 10 s and 10 minutes. In experiment 3 both nodes
publish and subscribe, for the same times. In experiment 4 the monitor publishes a message for each that it sees, for
1 minute. `--scale` multiplies the times (by default 0.02, at least 5 s). `lost` messages are missing after the first
received one, because earlier ones are published before the nodes have found each other.
"""

import argparse
import contextlib
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from benchmarks.relay_throughput import HERE
from tests.support.appliance import Appliance
from tests.support.nodes import PYTHON, RosSession
from tests.support.processes import Process
from tests.support.rosmaster import PlainMaster

NODE = HERE / "nodes" / "counting_node.py"
SHORTEST = 5.0
MONITOR = """
NAME() {
    int seen = 0;
    std_msgs::String copy;
    event said(std::string text) TOPIC std_msgs/String '{data:text}' { seen = seen + 1; EXTRA }
    fsm: even [ said -> odd ] odd [ said -> even ]
    @fail { ROS_ERROR("impossible"); }
}
"""
EXTRA = "copy = MESSAGE; PUBLISH(/extra, std_msgs/String, copy);"


@dataclass(frozen=True)
class Experiment:
    """An experiment. `nodes` are the roles of both nodes; `extra` is an additional action of the monitor."""

    name: str
    seconds: float
    nodes: tuple[tuple[str, ...], tuple[str, ...]]
    extra: str = ""


ONE = (("publish:=/topic1",), ("subscribe:=/topic1",))
BOTH = (("publish:=/topic1", "subscribe:=/topic2"), ("publish:=/topic2", "subscribe:=/topic1"))
EXPERIMENTS = (
    Experiment("1: one topic", 10, ONE),
    Experiment("2: one topic, long", 600, ONE),
    Experiment("3: two topics", 10, BOTH),
    Experiment("3: two topics, long", 600, BOTH),
    Experiment("4: PUBLISH", 60, ONE, EXTRA),
)


@contextlib.contextmanager
def plain(home: Path, _experiment: Experiment) -> Iterator[str]:
    with PlainMaster(home) as master:
        yield master.master_uri


@contextlib.contextmanager
def appliance(enable: str, experiment: Experiment) -> Iterator[str]:
    with tempfile.TemporaryDirectory(prefix="rosrv-monitors-") as name:
        folder = Path(name)
        folder.chmod(0o755)
        for number in (1, 2):
            text = MONITOR.replace("NAME", f"topic{number}").replace("TOPIC", f"/topic{number}")
            (folder / f"topic{number}.rv").write_text(text.replace("EXTRA", experiment.extra))
        options = ("--monitors", name, "--enable", enable, "--api", "off")
        with Appliance(options=options) as running:
            yield running.master_uri


def measure(master_uri: str, home: Path, experiment: Experiment, seconds: float) -> str:
    with RosSession(master_uri, home) as session:
        nodes = [
            session.start(
                [PYTHON, str(NODE), str(seconds), *roles, f"__name:=node{number}"], label=f"node{number}"
            )
            for number, roles in enumerate(experiment.nodes, 1)
        ]
        counts = [counted(node, seconds) for node in nodes]
    ways = [(counts[0]["sent"], counts[1])]
    if counts[1]["sent"]:
        ways.append((counts[1]["sent"], counts[0]))
    return "; ".join(f"{sent:5} sent {to['received']:5} received {to['lost']} lost" for sent, to in ways)


def counted(node: Process, seconds: float) -> dict[str, int]:
    event = node.wait_for(event="counted", timeout=seconds + 60)
    return {name: int(event[name]) for name in ("sent", "received", "lost")}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--scale", type=float, default=0.02, help="of the thesis's durations")
    parser.add_argument("--only", help="experiments whose number is this: 1, 2, 3 or 4")
    options = parser.parse_args()
    for experiment in EXPERIMENTS:
        if options.only and not experiment.name.startswith(options.only):
            continue
        seconds = max(SHORTEST, experiment.seconds * options.scale)
        print(f"\n{experiment.name}, {seconds:.0f} s")
        with tempfile.TemporaryDirectory(prefix="rosrv-experiment-") as name:
            home = Path(name)
            with plain(home, experiment) as uri:
                print(f"  roscore                  {measure(uri, home, experiment, seconds)}", flush=True)
            for enable, words in (("none", "appliance, no monitor   "), ("all", "appliance, with monitors")):
                with appliance(enable, experiment) as uri:
                    print(f"  {words} {measure(uri, home, experiment, seconds)}", flush=True)


if __name__ == "__main__":
    main()
