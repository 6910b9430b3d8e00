"""Stock tools that query everything, compared with a plain master: `python -m benchmarks.tools [--rounds 3]`.

`rosbag record -a` records a robot with a hundred topics. The time until the last topic's first message is in the bag
is measured twice: from the first topic's first message, and from the start of the tool. Then `rosgraph`'s library
queries the whole graph.
"""

import argparse
import json
import statistics
import subprocess
import tempfile
import time
from pathlib import Path

from rich.console import Console
from rich.table import Table

from tests.support.appliance import OPEN_POLICY, Appliance
from tests.support.nodes import BUILD, PYTHON, ROOT, RosSession
from tests.support.rosmaster import PlainMaster

_NODES, _TOPICS = 10, 10
_SOURCE = Path(__file__).parent / "nodes" / "many_topics.cpp"
_PROGRAM = BUILD / "many_topics"
_RECORDED_SECONDS = 8
_FIRST = """
import json, rosbag, sys
first = {}
for topic, _, when in rosbag.Bag(sys.argv[1]).read_messages(raw=True):
    first.setdefault(topic, when.to_sec())
print(json.dumps(first))
"""
_GRAPH = """
import rosgraph.impl.graph, time
began = time.monotonic()
graph = rosgraph.impl.graph.Graph()
graph.update()
print(time.monotonic() - began)
"""


class Robot:
    def __init__(self, session: RosSession) -> None:
        self.session = session
        subprocess.run([str(ROOT / "scripts" / "build-roscpp"), str(_SOURCE), str(_PROGRAM)], check=True)
        self.nodes = [
            session.start([str(_PROGRAM), str(_TOPICS), f"__name:=node_{number}"], label=f"node {number}")
            for number in range(_NODES)
        ]
        for node in self.nodes:
            node.wait_for(event="ready")

    def record(self, bag: Path) -> tuple[float, float, float]:
        """Return both times in seconds, and the number of missing topics."""
        began = time.time()
        self.session.run(
            "rosbag", "record", "-a", "-O", str(bag), f"--duration={_RECORDED_SECONDS}", timeout=60
        )
        first = json.loads(self.session.run(PYTHON, "-c", _FIRST, str(bag)).stdout)
        at = [when for topic, when in first.items() if topic.startswith("/node_")]
        return max(at) - min(at), max(at) - began, _NODES * _TOPICS - len(at)

    def graph(self) -> float:
        return float(self.session.run(PYTHON, "-c", _GRAPH, timeout=90).stdout)


def main() -> None:
    parser = argparse.ArgumentParser(description="Stock tools that ask for everything, beside a plain master")
    parser.add_argument("--rounds", type=int, default=3)
    given = parser.parse_args()
    table = Table("what", "plain s", "appliance s", "ratio")
    with (
        tempfile.TemporaryDirectory() as name,
        PlainMaster(Path(name)) as plain,
        Appliance(policy=OPEN_POLICY) as ours,
        RosSession(plain.master_uri, Path(name)) as one,
        RosSession(ours.master_uri, Path(name)) as other,
    ):
        robots = Robot(one), Robot(other)
        figures: dict[str, tuple[list[float], list[float]]] = {}
        for number in range(given.rounds):
            for which, robot in enumerate(robots):
                spread, whole, missing = robot.record(Path(name) / f"{number}-{which}.bag")
                for what, seconds in (
                    ("rosbag record -a, first to last", spread),
                    ("rosbag record -a, start to last", whole),
                    ("rosbag record -a, topics missing", missing),
                    ("the graph", robot.graph()),
                ):
                    figures.setdefault(what, ([], []))[which].append(seconds)
        for what, (plain_seconds, our_seconds) in figures.items():
            middle, ours_middle = statistics.median(plain_seconds), statistics.median(our_seconds)
            table.add_row(
                what, f"{middle:.2f}", f"{ours_middle:.2f}", f"{ours_middle / middle:.1f}" if middle else ""
            )
    Console().print(table)
    Console().print(json.dumps(figures))


if __name__ == "__main__":
    main()
