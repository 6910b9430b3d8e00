"""Adopt and release a running robot of unmodified nodes and its stock master, in a namespace, without a restart."""

import os
import signal
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from appliance.network.listening_sockets import tcp_sockets
from examples.landshark.lab import Host, Lab
from tests.support.adopted_robot import URI, Robot, crash, rosrv, until_taken
from tests.support.appliance import Appliance
from tests.support.command import ROSRV
from tests.support.nodes import RosSession
from tests.support.processes import Process
from tests.support.rosmaster import PlainMaster, call_on
from tests.support.small_disk import filled, small_disk
from tests.support.waiting import eventually

CYCLES = int(os.environ.get("ROSRV_ADOPT_CYCLES", "20"))
_RATE = 50


@pytest.fixture
def robot(host: Host, tmp_path: Path) -> Iterator[Robot]:
    with PlainMaster(tmp_path, host), RosSession("http://localhost:11311", tmp_path, host) as ros:
        for client in ("rospy", "roscpp"):
            ros.talker(client, f"/{client}", "--rate", str(_RATE), name=f"{client}_talker")
            ros.service_server(client, f"/{client}_go", name=f"{client}_server")
        listeners = {
            f"{client} of {topic}": ros.listener(client, f"/{topic}", name=f"{client}_of_{topic}")
            for client in ("rospy", "roscpp")
            for topic in ("rospy", "roscpp")
        }
        callers = {
            f"{service}{' persistent' if kept else ''}": ros.node(
                "rospy", "service_caller", f"/{service}_go", *(["--persistent"] if kept else []),
                name=f"caller_{service}_{len(kept)}",
            )
            for service in ("rospy", "roscpp")
            for kept in ("", "p")
        }  # fmt: skip
        yield Robot(host, ros, listeners, callers)


@pytest.mark.nightly
@pytest.mark.timeout(1200)
def test_cycles_of_adopt_and_release_restart_nothing_and_lose_little(
    robot: Robot, appliance: Appliance
) -> None:
    graph, parameters, lives = robot.graph(), robot.parameters(), robot.lives()
    robot.hears()
    checked = rosrv(robot, appliance, "adopt", "--check")
    assert "stop" not in checked
    assert robot.graph() == graph, "the check registers nothing"
    assert "noted" in rosrv(robot, appliance, "adopt")
    appliance.start()
    until_taken(robot, appliance)
    for cycle in range(CYCLES):
        robot.hears()
        assert robot.graph() == graph
        print(cycle, rosrv(robot, appliance, "release").splitlines()[0])  # noqa: T201  shown by pytest -s
        assert robot.graph() == graph
        assert robot.parameters() == parameters
        robot.hears()
        if cycle + 1 < CYCLES:
            print(cycle, rosrv(robot, appliance, "adopt").splitlines()[0])  # noqa: T201  shown by pytest -s
    assert robot.lives() == lives
    losses, calls = robot.losses(), robot.calls()
    print(losses, calls)  # noqa: T201  shown by pytest -s
    for name, (lost, longest, _twice) in losses.items():
        if name.startswith("rospy"):
            assert lost == 0, name
        assert longest <= _RATE // 2, name
    for name, (good, bad) in calls.items():
        assert good > 100
        assert bad <= (2 * CYCLES if name.endswith("persistent") else 0), name


_ODD = """
import os, xmlrpc.client, xmlrpc.server

class AnyPath(xmlrpc.server.SimpleXMLRPCRequestHandler):
    rpc_paths = ()

server = xmlrpc.server.SimpleXMLRPCServer(("127.0.0.1", 0), AnyPath, logRequests=False)
uri = f"http://127.0.0.1:{server.server_address[1]}/%d%s%n/"
answers = {"getPid": os.getpid(), "getBusInfo": [], "getPublications": [], "getSubscriptions": [], "publisherUpdate": 0}
for name, value in answers.items():
    server.register_function(lambda *_given, value=value: [1, "", value], name)
xmlrpc.client.ServerProxy("http://127.0.0.1:11311").registerSubscriber("/odd", "/rospy", "std_msgs/String", uri)
print('{"event": "ready"}', flush=True)
server.serve_forever()
"""


@pytest.mark.nightly
def test_a_percent_sign_in_the_uri_of_a_node_ends_no_adoption(robot: Robot, appliance: Appliance) -> None:
    odd = robot.ros.start([sys.executable, "-c", _ODD], label="a node with an odd URI")
    odd.wait_for(event="ready")
    for arguments in (("adopt", "--check"), ("adopt",)):
        assert "defect" not in rosrv(robot, appliance, *arguments)
    appliance.start()
    until_taken(robot, appliance)
    robot.hears()
    rosrv(robot, appliance, "release")
    robot.hears()


@pytest.mark.nightly
def test_an_ordered_stop_gives_the_graph_back_and_a_crash_does_not(
    robot: Robot, appliance: Appliance
) -> None:
    graph, lives = robot.graph(), robot.lives()
    rosrv(robot, appliance, "adopt")
    appliance.start()
    until_taken(robot, appliance)
    appliance.stop()
    assert robot.graph() == graph
    robot.hears()
    appliance.start()
    until_taken(robot, appliance)
    crash(appliance)
    with pytest.raises(OSError, match=r"refused|timed out|reset"):
        robot.graph()
    appliance.start()
    until_taken(robot, appliance)
    robot.hears()
    assert robot.graph() == graph
    crash(appliance)
    reader, writer = os.pipe()
    os.close(reader)  # like `| head -0`: an output without a reader must not end a release between two steps
    command = [ROSRV, "release", "--dead", "--state", str(appliance.state)]
    robot.host.popen(command, stdout=writer, stderr=writer).wait(60)
    os.close(writer)
    assert robot.graph() == graph
    robot.hears()
    assert robot.lives() == lives


@pytest.mark.nightly
def test_a_service_that_waits_for_the_robots_master_takes_its_graph_over(
    robot: Robot, appliance: Appliance, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The robot booted first: the service waits, `rosrv adopt` notes the order, and the start takes the graph over."""
    graph, lives = robot.graph(), robot.lives()
    monkeypatch.setenv(
        "NOTIFY_SOCKET", str(tmp_path / "systemd")
    )  # as under systemd, where the service waits
    with ThreadPoolExecutor(1) as threads:
        started = threads.submit(appliance.start)
        eventually(
            lambda: "holds TCP 11311" in rosrv(robot, appliance, "status", check=False), appliance.story
        )
        assert robot.graph() == graph
        assert "adopted: 12 nodes" in rosrv(robot, appliance, "adopt")
        started.result()
    robot.hears()
    assert robot.graph() == graph
    appliance.kill("control")
    until_taken(robot, appliance)
    robot.hears()
    rosrv(robot, appliance, "release")
    robot.hears()
    assert robot.graph() == graph
    assert robot.lives() == lives


@pytest.mark.nightly
def test_a_kill_of_everything_in_the_middle_ends_as_ordered(robot: Robot, appliance: Appliance) -> None:
    graph, lives = robot.graph(), robot.lives()
    rosrv(robot, appliance, "adopt")
    for step in ("register", "forward", "connect", "cut", "taken"):
        appliance.start()
        assert appliance.process is not None
        appliance.process.wait_for_error(f'"step": "{step}"')
        crash(appliance)
    appliance.start()
    until_taken(robot, appliance)
    robot.hears()
    assert robot.graph() == graph
    appliance.stop()
    assert robot.graph() == graph
    robot.hears()
    assert robot.lives() == lives


@pytest.mark.nightly
def test_an_adoption_waits_until_the_robot_stands(robot: Robot, appliance: Appliance, lab: Lab) -> None:
    """All of its command topics: a zero on one says nothing of another, and topics of another host do not count."""

    def publish(topic: str, kind: str, value: str) -> Process:
        command = ["/usr/bin/rostopic", "pub", "--rate", "10", topic, kind, value]
        return robot.ros.start(command, label=f"{topic} {value}")

    ordered = ("adopt", "--when-standing", "--within", "8s")
    assert "no topic commands a base" in rosrv(robot, appliance, *ordered, check=False)
    robot.ros.start(["/usr/bin/rostopic", "echo", "/cmd_vel"], label="base")
    moving = publish("/cmd_vel", "geometry_msgs/Twist", "{linear: {x: 0.5}}")
    eventually(lambda: "/cmd_vel" in str(robot.graph()), robot.ros.story)
    assert "/cmd_vel says that it moves" in rosrv(robot, appliance, *ordered, check=False)
    moving.stop()
    publish("/cmd_vel", "geometry_msgs/Twist", "{linear: {x: 0.0}}")
    publish("/odom", "nav_msgs/Odometry", "{twist: {twist: {linear: {x: 0.0}}}}")
    eventually(lambda: "/odom" in str(robot.graph()), robot.ros.story)
    second = publish("/second/cmd_vel", "geometry_msgs/Twist", "{linear: {x: 0.3}}")
    robot.ros.start(["/usr/bin/rostopic", "echo", "/second/cmd_vel"], label="second base")
    eventually(lambda: "/second/cmd_vel" in str(robot.graph()[1]), robot.ros.story)
    second.stop()
    assert "no zero was commanded on /second/cmd_vel" in rosrv(robot, appliance, *ordered, check=False)
    publish("/second/cmd_vel", "geometry_msgs/Twist", "{linear: {x: 0.0}}")
    guest = lab.host("guest", "10.77.0.66/24")
    for number in range(17):
        topic, uri = f"/guest{number}/cmd_vel", f"http://{guest.address}:4000/"
        for method in ("registerPublisher", "registerSubscriber"):
            call_on(
                guest,
                f"http://{robot.host.address}:11311",
                method,
                "/guest",
                topic,
                "geometry_msgs/Twist",
                uri,
            )
    said = rosrv(robot, appliance, "adopt", "--when-standing", "--within", "30s")
    assert "the robot stands still: zero for 3 s on /cmd_vel, /second/cmd_vel and 1 odometry topic" in said
    assert (
        "what /guest0/cmd_vel, /guest1/cmd_vel, /guest10/cmd_vel and 14 more of other hosts may move" in said
    )
    assert "noted" in said
    appliance.start()
    until_taken(robot, appliance)
    said = rosrv(robot, appliance, "policy", "enforce", "--when-standing", "--within", "30s")
    stands = (
        "the robot stands still: zero for 3 s on /cmd_vel, /second/cmd_vel and 1 odometry topic. Not seen:"
    )
    assert f"{stands} motions that no" in said
    assert "enforces [Publishers]" in said


@pytest.mark.nightly
def test_an_action_server_and_a_recording_go_on_after_each_change(
    robot: Robot, appliance: Appliance, tmp_path: Path
) -> None:
    def go_on() -> None:
        client = robot.ros.node("rospy", "action", "client")
        assert client.wait_for(event="result")["result"] == 3
        client.stop()
        before = bag.stat().st_size
        eventually(lambda: bag.stat().st_size > before + 10_000, robot.ros.story)

    bag = tmp_path / "robot.bag.active"
    robot.ros.node("rospy", "action", "server", name="counter")
    record = ["/usr/lib/rosbag/record", "--output-name", str(tmp_path / "robot"), "--chunksize", "1"]
    robot.ros.start([*record, "/rospy", "/roscpp"], label="rosbag record")
    eventually(bag.exists, robot.ros.story)
    go_on()
    rosrv(robot, appliance, "adopt")
    appliance.start()
    until_taken(robot, appliance)
    go_on()
    rosrv(robot, appliance, "release")
    go_on()


@pytest.mark.nightly
def test_a_master_of_another_user_gets_nothing_at_a_release(robot: Robot, appliance: Appliance) -> None:
    """The robot's own one has died, and any user may open its port."""
    own = call_on(robot.host, URI, "getPid", "/test")[2]
    rosrv(robot, appliance, "adopt")
    appliance.start()
    until_taken(robot, appliance)
    os.kill(own, signal.SIGKILL)
    command, environment = ["/usr/bin/rosmaster", "--core", "-p", "11311"], {"ROS_LOG_DIR": "/nonexistent"}
    other = robot.host.popen(command, user=65534, env=environment)
    try:
        eventually(
            lambda: any(one.port == 11311 and one.listens for one in robot.host.run(tcp_sockets)), "no master"
        )
        said = rosrv(robot, appliance, "release", check=False)
        assert "is not the recorded master" in " ".join(said.split())
        assert call_on(robot.host, URI, "getPid", "/test")[2] == other.pid
        assert robot.graph() == [[], [], []]
        robot.hears()
    finally:
        other.kill()
        other.wait(20)


@pytest.mark.nightly
def test_orders_on_a_full_disk_leave_no_subscriber_deaf(robot: Robot, appliance: Appliance) -> None:
    """A graph is given back, also by a stop; it is adopted once there is room, because nothing is granted before."""
    graph, lives = robot.graph(), robot.lives()
    with small_disk(appliance.state, "160m", "mode=755"):
        rosrv(robot, appliance, "adopt")
        appliance.start()
        until_taken(robot, appliance)
        with filled(appliance.state):
            rosrv(robot, appliance, "release")
            robot.hears()
            assert robot.graph() == graph
            assert "free space and try again" in rosrv(robot, appliance, "adopt", check=False)
            robot.hears()
        rosrv(robot, appliance, "adopt")
        robot.hears()
        with filled(appliance.state):
            appliance.stop()
            robot.hears()
            assert robot.graph() == graph
        assert robot.lives() == lives
