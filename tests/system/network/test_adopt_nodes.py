"""Adopt and release a robot of the nodes that are not plain: bonds, nodelets, dynamic_reconfigure, actions, a
recording, rviz and a node of rosnodejs. ROSRV_ADOPT_CYCLES is the number of cycles; `pytest -s` shows the figures.
"""

import itertools
import json
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from examples.landshark.lab import Host, Lab
from tests.support.adopted_robot import URI, Robot, rosrv, until_taken
from tests.support.appliance import Appliance
from tests.support.nodes import Client, RosSession, nodelet_library, numbers
from tests.support.processes import Process
from tests.support.requirements import need_program, needs
from tests.support.rosmaster import PlainMaster, call_on
from tests.support.waiting import eventually

CYCLES = int(os.environ.get("ROSRV_ADOPT_CYCLES", "5"))
CLIENTS: tuple[Client, Client] = ("rospy", "roscpp")
RATE = 50
GAP = RATE // 2  # messages: half a second
ROSNODEJS = Path(__file__).with_name("rosnodejs")
SCREEN = Path(__file__).with_name("scene.rviz")
MESSAGES = ("std_msgs", "std_srvs", "rosgraph_msgs", "actionlib_msgs")

pytestmark = pytest.mark.nightly


@dataclass
class Zoo(Robot):
    home: Path
    bonds: list[Process] = field(default_factory=list)
    goals: dict[str, Process] = field(default_factory=dict)
    long_goals: dict[str, Process] = field(default_factory=dict)
    changers: list[Process] = field(default_factory=list)
    recorder: Process | None = None
    rviz: str = ""

    @property
    def bag(self) -> Path:
        return self.home / "robot.bag"

    def goes_on(self) -> None:
        """Wait until each node has done once more what it is for."""
        self.hears()
        for client in self.long_goals.values():
            client.wait_for_count(5, since=client.mark(), event="feedback")
        for changer in self.changers:
            changer.wait_for_count(3, since=changer.mark(), event="told")
            late = self.ros.node("rospy", "reconfigure", "client", "/reconfigured", name="late_changer")
            late.wait_for(event="told")
            late.stop()
            self.ros.processes.remove(late)
        if self.rviz:
            before = self.screen()
            eventually(
                lambda: all(self.screen().get(topic, 0) > before.get(topic, 0) for topic in ("/tf", "/odom")),
                lambda: f"rviz is shown nothing: {before} {self.screen()}",
            )
        broken = [process.story() for process in self.bonds if process.seen(event="broken")]
        assert not broken, "\n".join(broken)
        self.lives()

    def screen(self) -> dict[str, int]:
        """Return the bytes that rviz has received of each topic."""
        _publications, subscriptions = call_on(self.host, self.rviz, "getBusStats", "/test")
        return {topic: sum(row[1] for row in rows) for topic, rows in subscriptions}

    def figures(self) -> dict[str, Any]:
        short = {name: counted(client) for name, client in self.goals.items()}
        changes = [counted(changer) for changer in self.changers]
        return {"messages": self.losses(), "goals": short, "changes": changes, "calls": self.calls()}


def counted(process: Process) -> dict[str, Any]:
    since = process.mark()
    process.send("")
    event = process.wait_for(since=since, event="counted")
    return {name: value for name, value in event.items() if name != "event"}


# --- kinds of nodes, each added to a robot ---


def publishes(ros: RosSession, topic: str) -> bool:
    return topic in ros.run("rostopic", "list", "-p").stdout


def add_nodelets(zoo: Zoo) -> None:
    """Add a manager with two nodelets: /rospy -> /echo_1/out, within the process -> /echo_2/out.

    Each nodelet's loader has a bond with the manager, which ends with it.
    """
    ros, program = zoo.ros, "/usr/lib/nodelet/nodelet"
    environment = nodelet_library(zoo.home / "nodelets")
    ros.start([program, "manager", "__name:=manager"], label="nodelet manager", **environment)
    for number, source in ((1, "/rospy"), (2, "/echo_1/out")):
        command = [
            program,
            "load",
            "rosrv_nodelets/Echo",
            "manager",
            f"__name:=echo_{number}",
            f"~in:={source}",
        ]
        ros.start(command, label=f"nodelet {number}", **environment)
        eventually(partial(publishes, ros, f"/echo_{number}/out"), ros.story)
    zoo.listeners["rospy of nodelets"] = ros.listener("rospy", "/echo_2/out", name="rospy_of_nodelets")


def add_bonds(zoo: Zoo) -> None:
    pairs: tuple[tuple[Client, Client], ...] = (("rospy", "roscpp"), ("roscpp", "roscpp"))
    zoo.bonds += [
        zoo.ros.node(client, "bonded", "/bonds", f"{first}-{second}", name=f"bond_{first}_{second}_{number}")
        for first, second in pairs
        for number, client in enumerate((first, second))
    ]
    for end in zoo.bonds:
        end.wait_for(event="formed")


def add_goals(zoo: Zoo) -> None:
    ros = zoo.ros
    for server, client in (CLIENTS, CLIENTS[::-1]):
        for action in ("short", "long"):
            ros.node(server, "goals", "server", f"/{server}_{action}", name=f"{server}_{action}_goals")
        asks = f"{client} of {server}"
        zoo.goals[asks] = ros.node(client, "goals", "client", f"/{server}_short", name=f"{client}_short")
        zoo.long_goals[asks] = ros.node(
            client, "goals", "client", f"/{server}_long", "--long", name=f"{client}_long"
        )


def add_changes(zoo: Zoo) -> None:
    zoo.ros.node("rospy", "reconfigure", "server", name="reconfigured")
    zoo.changers.append(zoo.ros.node("rospy", "reconfigure", "client", "/reconfigured", name="changer"))


def add_javascript(zoo: Zoo) -> None:
    ros, npm = zoo.ros, need_program("npm", "npm")
    folder = shutil.copytree(ROSNODEJS, zoo.home / "rosnodejs")
    command = [npm, "ci", "--ignore-scripts", "--no-audit", "--no-fund", "--silent"]
    subprocess.run(command, cwd=folder, check=True)
    javascript = ros.start(
        ["/usr/bin/node", str(folder / "node.cjs"), "/rospy", "/js", "/rospy_go", "/js_go"], label="rosnodejs",
        CMAKE_PREFIX_PATH="/usr", ROS_PACKAGE_PATH=":".join(f"/usr/share/{name}" for name in MESSAGES),
    )  # fmt: skip
    javascript.wait_for(event="ready")
    zoo.listeners |= {
        "rosnodejs of rospy": javascript,
        "rospy of rosnodejs": ros.listener("rospy", "/js", name="rospy_of_js"),
        "roscpp of rosnodejs": ros.listener("roscpp", "/js", name="roscpp_of_js"),
    }
    zoo.callers["rospy of rosnodejs"] = ros.node("rospy", "service_caller", "/js_go", name="caller_of_js")


def add_recording(zoo: Zoo) -> None:
    record = ["/usr/lib/rosbag/record", "--output-name", str(zoo.bag), "/rospy", "/roscpp"]
    zoo.recorder = zoo.ros.start(record, label="rosbag record")


def add_rviz(zoo: Zoo) -> None:
    """Add rviz on a screen in memory, with what it shows."""
    needs(shutil.which("rviz") and shutil.which("Xvfb"), "rviz and xvfb (`scripts/setup --system`)")
    ros, number = zoo.ros, 60 + os.getpid() % 900
    ros.node("rospy", "scene", name="scene")
    server = ros.start(["Xvfb", f":{number}", "-screen", "0", "320x240x24", "-nolisten", "tcp"], label="Xvfb")
    eventually(Path(f"/tmp/.X11-unix/X{number}").exists, server.story)
    ros.start(
        ["rviz", "-d", str(SCREEN), "__name:=rviz"], label="rviz", DISPLAY=f":{number}", LIBGL_ALWAYS_SOFTWARE="1",
        HOME=str(ros.home), XDG_RUNTIME_DIR=str(ros.home),
    )  # fmt: skip
    eventually(lambda: "/rviz" in str(dict(zoo.graph()[1]).get("/odom")), ros.story)
    zoo.rviz = call_on(zoo.host, URI, "lookupNode", "/test", "/rviz")[2]


GROUPS: dict[str, tuple[Callable[[Zoo], None], ...]] = {
    "bonds": (add_nodelets, add_bonds),
    "actions": (add_goals,),
    "settings": (add_changes, add_javascript),
    "tools": (add_recording, add_rviz),
    "all": (add_nodelets, add_bonds, add_goals, add_changes, add_javascript, add_recording, add_rviz),
}


@pytest.fixture
def zoo(request: pytest.FixtureRequest, host: Host, tmp_path: Path) -> Iterator[Zoo]:
    with PlainMaster(tmp_path, host), RosSession("http://localhost:11311", tmp_path, host) as ros:
        for client in CLIENTS:
            ros.talker(client, f"/{client}", "--rate", str(RATE), name=f"{client}_talker")
        ros.service_server("rospy", "/rospy_go", name="rospy_server")
        listener = ros.listener("roscpp", "/roscpp", name="roscpp_of_roscpp")
        zoo = Zoo(host, ros, {"roscpp of roscpp": listener}, {}, tmp_path)
        for add in GROUPS[request.param]:
            add(zoo)
        yield zoo


def recorded(bag: Path) -> dict[str, tuple[int, int, float]]:
    """Return for each topic of a bag the messages, those lost, and the longest time without one, in seconds."""
    program = (
        "import rosbag, sys, json; found = {}\n"
        "for topic, message, time in rosbag.Bag(sys.argv[1]).read_messages():\n"
        "    found.setdefault(topic, []).append((int(message.data.split()[-1]), time.to_sec()))\n"
        "print(json.dumps(found))"
    )
    done = subprocess.run(
        ["/usr/bin/python3", "-c", program, str(bag)], capture_output=True, check=True, text=True
    )
    found = {}
    for topic, rows in json.loads(done.stdout).items():
        seen, times = [row[0] for row in rows], [row[1] for row in rows]
        lost = max(seen) - min(seen) + 1 - len(set(seen))
        found[topic] = len(rows), lost, max(later - earlier for earlier, later in itertools.pairwise(times))
    return found


@pytest.mark.parametrize("zoo", GROUPS, indirect=True)
def test_other_nodes_go_on_over_cycles_of_adopt_and_release(zoo: Zoo, appliance: Appliance) -> None:
    zoo.goes_on()
    graph, lives = zoo.graph(), zoo.lives()
    assert "stop" not in rosrv(zoo, appliance, "adopt", "--check")
    rosrv(zoo, appliance, "adopt")
    appliance.start()
    until_taken(zoo, appliance)
    for cycle in range(CYCLES):
        zoo.goes_on()
        assert zoo.graph() == graph
        print(cycle, rosrv(zoo, appliance, "release").splitlines()[0])  # noqa: T201  shown by pytest -s
        zoo.goes_on()
        assert zoo.graph() == graph
        if cycle + 1 < CYCLES:
            print(cycle, rosrv(zoo, appliance, "adopt").splitlines()[0])  # noqa: T201  shown by pytest -s
    assert zoo.lives() == lives
    figures = zoo.figures()
    for name, found in figures.items():
        print(name, found)  # noqa: T201  shown by pytest -s
    for client in zoo.long_goals.values():
        client.send("")
        assert client.wait_for(event="result")["result"] > 0
    for name, (lost, longest, _twice) in figures["messages"].items():
        assert lost == 0 if name.startswith("rospy") else longest <= GAP, name
    for name, short in figures["goals"].items():
        assert short["good"] > 10 * short["bad"], name
    for changes in figures["changes"]:
        assert changes["failed"] == 0
    if zoo.recorder is not None:
        zoo.recorder.stop()
        found = recorded(zoo.bag)
        print(found)  # noqa: T201  shown by pytest -s
        assert found.keys() == {"/rospy", "/roscpp"}
        assert all(gap < 1.0 for _messages, _lost, gap in found.values())


# --- simulated time ---


def player(ros: RosSession, home: Path) -> Process:
    """Play a recording of five minutes, which is the clock."""
    program = (
        "import rosbag, rospy, std_msgs.msg, sys\n"
        "with rosbag.Bag(sys.argv[1], 'w') as bag:\n"
        "    for number in range(3000):\n"
        "        said = std_msgs.msg.String(f'hello {number}')\n"
        "        bag.write('/played', said, rospy.Time.from_sec(100 + number / 10))\n"
    )
    bag = home / "played.bag"
    subprocess.run(["/usr/bin/python3", "-c", program, str(bag)], check=True)
    return ros.start(["/usr/lib/rosbag/play", "--clock", "--quiet", str(bag)], label="rosbag play")


def test_simulated_time_goes_on_over_each_change_and_may_stand_during_it(
    host: Host, tmp_path: Path, appliance: Appliance
) -> None:
    with PlainMaster(tmp_path, host), RosSession("http://localhost:11311", tmp_path, host) as ros:
        ros.run("rosparam", "set", "/use_sim_time", "true")
        clock = ros.node("rospy", "sim_clock", name="clock")
        sleepers = {client: ros.node(client, "sleeper", name=f"{client}_sleeper") for client in CLIENTS}
        robot = Robot(host, ros, {}, {})

        def sleep() -> None:
            for sleeper in sleepers.values():
                sleeper.wait_for_count(5, since=sleeper.mark(), event="slept")
            assert not sleepers["rospy"].seen(event="back"), "time never goes back"

        sleep()
        rosrv(robot, appliance, "adopt")
        appliance.start()
        until_taken(robot, appliance)
        sleep()
        rosrv(robot, appliance, "release")
        sleep()
        clock.send("pause")
        stands = clock.wait_for(event="paused")["now"]
        rosrv(robot, appliance, "adopt")
        until_taken(robot, appliance)
        rosrv(robot, appliance, "release")
        rosrv(robot, appliance, "adopt")
        clock.send("go")
        sleep()
        for client, sleeper in sleepers.items():
            times = [event["now"] for event in sleeper.seen(event="slept")]
            steps = [later - earlier for earlier, later in itertools.pairwise(times)]
            print(client, "longest sleep of 0.1 s:", max(steps))  # noqa: T201  shown by pytest -s
            assert min(steps) >= 0, "time never goes back"
            assert max(steps) < 1.0, "time stands while a node has no clock"
            assert not [now for now in times if now > stands + 0.2 and now < stands]


def test_a_recording_that_is_played_stays_the_clock(host: Host, tmp_path: Path, appliance: Appliance) -> None:
    with PlainMaster(tmp_path, host), RosSession("http://localhost:11311", tmp_path, host) as ros:
        ros.run("rosparam", "set", "/use_sim_time", "true")
        player(ros, tmp_path)
        sleepers = [ros.node(client, "sleeper", name=f"{client}_sleeper") for client in CLIENTS]
        heard = ros.listener("roscpp", "/played", name="listener")
        robot = Robot(host, ros, {"played": heard}, {})

        def go_on() -> None:
            for sleeper in sleepers:
                sleeper.wait_for_count(5, since=sleeper.mark(), event="slept")
            robot.hears()

        go_on()
        rosrv(robot, appliance, "adopt")
        appliance.start()
        until_taken(robot, appliance)
        go_on()
        rosrv(robot, appliance, "release")
        go_on()
        print(robot.losses())  # noqa: T201  shown by pytest -s


# --- two computers ---


def test_nodes_of_a_second_computer_are_moved_and_given_back(
    host: Host, lab: Lab, tmp_path: Path, appliance: Appliance
) -> None:
    """Between the two computers all is moved. A rospy subscriber beside its publisher on the second hears twice."""
    other = lab.host("nuc", "10.77.0.11/24")
    with (
        PlainMaster(tmp_path, host),
        RosSession("http://localhost:11311", tmp_path, host) as here,
        RosSession(f"http://{host.address}:11311", tmp_path, other) as there,
    ):
        listeners, callers = {}, {}
        for ros, name in ((here, "robot"), (there, "nuc")):
            for client in CLIENTS:
                ros.talker(client, f"/{client}_{name}", "--rate", "20", name=f"{client}_talker_{name}")
            ros.service_server("roscpp", f"/go_{name}", name=f"server_{name}")
        for ros, name, source in (
            (here, "robot", "nuc"),
            (there, "nuc", "robot"),
            (there, "nuc", "nuc"),
        ):
            for client in CLIENTS:
                for talker in CLIENTS:
                    listeners[f"{client} on {name} of {talker} on {source}"] = ros.listener(
                        client, f"/{talker}_{source}", name=f"{client}_{name}_hears_{talker}_{source}"
                    )
        for ros, name, source in ((here, "robot", "nuc"), (there, "nuc", "robot")):
            callers[f"{name} of {source} persistent"] = ros.node(
                "rospy", "service_caller", f"/go_{source}", "--persistent", name=f"caller_{name}"
            )
        robot = Robot(host, here, listeners, callers)
        lives = [process.pid for ros in (here, there) for process in ros.processes]
        robot.hears()
        checked = rosrv(robot, appliance, "adopt", "--check")
        graph = robot.graph()
        assert f"other computers: {other.address}" in checked
        rosrv(robot, appliance, "adopt")
        appliance.start()
        until_taken(robot, appliance)
        robot.hears()
        assert robot.graph() == graph
        assert call_on(other, f"http://{host.address}:11311", "getSystemState", "/test")[0] == 1
        twice_while_adopted = {name: twice(listener) for name, listener in listeners.items()}
        rosrv(robot, appliance, "release")
        robot.hears()
        assert robot.graph() == graph
        assert robot.calls() is not None
        print("twice:", twice_while_adopted)  # noqa: T201  shown by pytest -s
        print(robot.losses(), robot.calls())  # noqa: T201  shown by pytest -s
        assert [process.pid for ros in (here, there) for process in ros.processes if process.running] == lives
        for name, found in twice_while_adopted.items():
            assert found == (name.startswith("rospy on nuc") and name.endswith("on nuc")), name
        for name, (lost, _longest, _twice) in robot.losses().items():
            assert lost == 0, name
        for name, (good, bad) in robot.calls().items():
            assert good > 10
            assert bad <= 2, name


def twice(listener: Process) -> bool:
    """Return whether a subscriber gets each message twice, now that nothing changes any more."""
    found = numbers(listener.wait_for_count(20, since=listener.mark(), event="received"))
    return len(found) - len(set(found)) > len(found) // 4
