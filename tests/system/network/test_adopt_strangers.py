"""An unknown host filled the robot's own master with names before an adoption, at a start and by an order."""

import json
import re
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from examples.landshark.lab import Host, Lab
from tests.support.adopted_robot import Robot, adoption, rosrv, until_taken
from tests.support.appliance import Appliance
from tests.support.command import ROSRV
from tests.support.nodes import RosSession
from tests.support.rosmaster import PlainMaster

pytestmark = [pytest.mark.nightly, pytest.mark.timeout(900)]

_SILENT, _UNKNOWN = 300, 520
_SECONDS = 20.0
"""The most time of an adoption, in seconds."""
_STRANGER = """
import socket, sys, xmlrpc.client
master, own, robot = xmlrpc.client.ServerProxy(sys.argv[1]), sys.argv[2], sys.argv[3]
silent = []
for number in range(int(sys.argv[4])):
    one = socket.create_server((own, 20000 + number), backlog=64)
    silent.append(one)
uris = [f"http://{own}:{20000 + number}/" for number in range(len(silent))]
uris += [f"http://a{number}.stranger.invalid:4000/" for number in range(int(sys.argv[5]))]
uris += [f"http://{own}:1/%s", f"http://{own}:20000/%d%", f"http://{robot}:22/", f"http://{robot}:11311/", "odd",
         f"http://localhost:{20000}/", "http://[::1]:1/", "http://203.0.113.9:80/"]
for number, uri in enumerate(uris):
    master.registerPublisher(f"/a%{number}", f"/a%s/{number}", "std_msgs/String", uri)
    master.registerSubscriber(f"/a%{number}", "/cmd_vel", "geometry_msgs/Twist", uri)
print("registered", flush=True)
sys.stdin.read()
"""

_SERVICES = """
import sys, xmlrpc.client
master = xmlrpc.client.ServerProxy(sys.argv[1])
uri = master.lookupNode("/evil", "/nuc_talker")[2]
for number in range(50):
    for port in (2112, 2113):
        master.registerService("/nuc_talker", f"/a{number}_{port}", f"rosrpc://{sys.argv[2]}:{port}", uri)
"""
_DEVICE = """
import socket, sys, threading
server = socket.create_server((sys.argv[1], int(sys.argv[2])))
print("ready", flush=True)
def serve(client):
    while True:
        client.sendall(b"a scan\\n" if sys.argv[3] == "talks" else client.recv(99))
        threading.Event().wait(0.02)
while True:
    threading.Thread(target=serve, args=(server.accept()[0],), daemon=True).start()
"""


@pytest.fixture
def robot(host: Host, lab: Lab, tmp_path: Path) -> Iterator[Robot]:
    """A robot whose only honest companion is a second computer."""
    nuc = lab.host("nuc", "10.77.0.11/24")
    with (
        PlainMaster(tmp_path, host),
        RosSession("http://localhost:11311", tmp_path, host) as ros,
        RosSession(f"http://{host.address}:11311", tmp_path, nuc) as there,
    ):
        for client in ("rospy", "roscpp"):
            ros.talker(client, f"/{client}", "--rate", "50", name=f"{client}_talker")
            ros.service_server(client, f"/{client}_go", name=f"{client}_server")
        there.talker("roscpp", "/nuc", "--rate", "50", name="nuc_talker")
        listeners = {
            f"{client} of {topic}": ros.listener(client, f"/{topic}", name=f"{client}_of_{topic}")
            for client in ("rospy", "roscpp")
            for topic in ("rospy", "roscpp", "nuc")
        }
        callers = {
            service: ros.node("rospy", "service_caller", f"/{service}_go", name=f"caller_{service}")
            for service in ("rospy", "roscpp")
        }
        yield Robot(host, ros, listeners, callers)


@contextmanager
def _filled(stranger: Host, robot: Robot) -> Iterator[None]:
    """Register the names; their ports accept connections, and never answer."""
    command = [
        "/usr/bin/python3", "-c", _STRANGER, f"http://{robot.host.address}:11311", stranger.address,
        robot.host.address, str(_SILENT), str(_UNKNOWN),
    ]  # fmt: skip
    with stranger.popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "registered\n"
            yield
        finally:
            process.kill()


def _require_served(robot: Robot, appliance: Appliance) -> None:
    """All honest nodes are taken in time, their topics and services work, and the other names are named."""
    found = adoption(robot, appliance)
    took = float(
        re.findall(r'"seconds": ([0-9.]+), "event": "the robot\'s graph is adopted"', appliance.story())[-1]
    )
    print(f"adopted in {took} s: {found['nodes']} nodes; {len(found['missing'])} left")  # noqa: T201  shown by pytest -s
    missing = [name for name in found["missing"] if name.startswith("/a%")]
    said = f"the robot's nodes use the appliance, but not all: {len(missing)} below; adopted since"
    assert said in rosrv(robot, appliance, "adopt", "--status")
    assert len(missing) == len(found["missing"]) > _SILENT + _UNKNOWN
    names = {name for part in robot.graph() for _resource, nodes in part for name in nodes}
    assert {"/rospy_talker", "/roscpp_talker", "/nuc_talker", "/rospy_server", "/rospy_of_nuc"} <= names
    robot.hears()
    before = robot.calls()
    robot.hears()
    for name, (good, bad) in robot.calls().items():
        assert good > before[name][0], name
        assert bad == before[name][1], name
    assert took < _SECONDS


def test_names_of_an_unknown_host_keep_no_node_of_the_robot_out(
    robot: Robot, appliance: Appliance, lab: Lab
) -> None:
    """At a start that takes the graph over, and at an order while the appliance runs."""
    stranger = lab.host("stranger", "10.77.0.66/24")
    robot.hears()
    with _filled(stranger, robot):
        began = time.monotonic()
        checked = rosrv(robot, appliance, "adopt", "--check")
        print(f"check: {time.monotonic() - began:.1f} s")  # noqa: T201  shown by pytest -s
        assert "stop" not in checked
        surveyed = json.loads(robot.ros.run(ROSRV, "survey", "--within", "10s", "--json").stdout)
        assert {node["name"] for node in surveyed["nodes"] if not node["problem"]} >= {
            "/rospy_talker",
            "/nuc_talker",
        }
        assert surveyed["seconds"] < 12
        assert stranger.address not in {port["host"] for port in surveyed["listeners"]}
        rosrv(robot, appliance, "adopt")
        appliance.start()
        until_taken(robot, appliance)
        _require_served(robot, appliance)
        rosrv(robot, appliance, "release")
    with _filled(stranger, robot):
        rosrv(robot, appliance, "adopt")
        _require_served(robot, appliance)


def test_a_port_that_an_unknown_host_registered_as_a_service_keeps_its_connections(
    robot: Robot, appliance: Appliance, lab: Lab
) -> None:
    """Devices at the second computer: one sends without being asked, one sends back what it gets."""
    nuc, stranger = lab.hosts["nuc"], lab.host("stranger", "10.77.0.66/24")
    with ExitStack() as running:
        devices = []
        for port, kind in ((2112, "talks"), (2113, "echoes")):
            command = ["/usr/bin/python3", "-c", _DEVICE, nuc.address, str(port), kind]
            program = nuc.popen(command, stdout=subprocess.PIPE, text=True)
            running.enter_context(program)
            running.callback(program.kill)
            assert program.stdout is not None
            assert program.stdout.readline() == "ready\n"
            with robot.host.entered():
                devices.append(
                    running.enter_context(socket.create_connection((nuc.address, port), timeout=10))
                )
        command = ["/usr/bin/python3", "-c", _SERVICES, f"http://{robot.host.address}:11311", nuc.address]
        assert stranger.popen(command).wait(timeout=60) == 0
        rosrv(robot, appliance, "adopt")
        appliance.start()
        until_taken(robot, appliance)
        for device in devices:
            device.setblocking(False)
            while True:
                try:
                    assert device.recv(65536), "the connection was cut"
                except BlockingIOError:
                    break
            device.settimeout(10)
            device.sendall(b"?")
            assert device.recv(99)
            with robot.host.entered():
                socket.create_connection(device.getpeername(), timeout=5).close()
        robot.hears()
