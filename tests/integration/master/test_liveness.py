import os
import signal
import xmlrpc.client
from pathlib import Path
from typing import Any
from xmlrpc.server import SimpleXMLRPCRequestHandler, SimpleXMLRPCServer

import pytest

from examples.landshark.lab import Host, Lab
from tests.support.appliance import Appliance
from tests.support.command import ROSRV
from tests.support.nodes import Client, RosSession, need_ros
from tests.support.processes import LIMIT, Process, ThisMachine

MONITORS = Path(__file__).parents[3] / "monitors"
CLIENTS: list[Client] = ["rospy", "roscpp"]
NOBODY = "http://10.77.0.10:1/"


def test_the_monitors_publisher_behind_the_firewall_is_not_lost(
    lab: Lab, robot: Host, tmp_path: Path
) -> None:
    middle, settings = lab.host("appliance", "10.77.0.2/24"), "liveness: {interval: 0.1}\n"
    options = ("--monitors", str(MONITORS), "--api", "off")
    with Appliance(middle, settings=settings, options=options) as appliance:

        def register() -> None:
            with xmlrpc.client.ServerProxy(appliance.master_uri) as master:
                answer = master.registerSubscriber("/brief", "/chatter", "std_msgs/String", NOBODY)
            assert isinstance(answer, list)
            assert answer[0] == 1, answer

        command = [ROSRV, "audit", "tail", "--json", "--state", str(appliance.state)]
        tail = Process(ThisMachine(), command, env=os.environ, label="rosrv audit tail")
        try:
            tail.wait_for(lambda event: "sequence" in event)
            robot.run(register)
            tail.wait_for(event="node lost", caller_id="/brief")
        finally:
            tail.stop()
        assert [record["caller_id"] for record in appliance.recorded("--event", "node lost")] == ["/brief"]


def test_a_node_with_a_percent_sign_in_its_uri_is_found_dead(
    lab: Lab, robot: Host, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A node chooses the path of its own URI, and dies like any other."""
    monkeypatch.setattr(SimpleXMLRPCRequestHandler, "rpc_paths", ())  # any path
    middle, settings = lab.host("appliance", "10.77.0.2/24"), "liveness: {interval: 0.1}\n"
    paths = {"/one": "%d/", "/two": "%s%s/", "/three": "%/"}
    with Appliance(middle, settings=settings, options=("--api", "off")) as appliance:

        def live_and_die() -> None:
            asked: list[str] = []

            def get_pid(caller_id: Any) -> Any:
                asked.append(caller_id)
                return [1, "", 7]

            with SimpleXMLRPCServer(("10.77.0.10", 0), logRequests=False) as server:
                server.register_function(get_pid, "getPid")
                server.timeout = LIMIT
                with xmlrpc.client.ServerProxy(appliance.master_uri) as master:
                    for name, path in paths.items():
                        uri = f"http://10.77.0.10:{server.server_address[1]}/{path}"
                        master.registerSubscriber(name, "/chatter", "std_msgs/String", uri)
                for _node in paths:
                    server.handle_request()
            assert asked

        robot.run(live_and_die)
        for name in paths:
            appliance.recorded("--event", "node lost", caller_id=name)


def test_a_paused_subscriber_gets_a_new_publisher_when_it_goes_on(
    lab: Lab, robot: Host, tmp_path: Path
) -> None:
    need_ros()
    middle = lab.host("appliance", "10.77.0.2/24")
    settings = "limits: {node_call_seconds: 0.5}\nliveness: {interval: 1, silent: 120}\n"
    with (
        Appliance(middle, settings=settings, options=("--api", "off")) as appliance,
        RosSession(appliance.master_uri, tmp_path, robot) as ros,
    ):
        listeners = {client: ros.listener(client, "/chatter", name=f"ear_{client}") for client in CLIENTS}
        ros.talker("rospy", "/chatter", name="first")
        for listener in listeners.values():
            listener.wait_for(event="received", publisher="/first")
            listener.popen.send_signal(signal.SIGSTOP)
        try:
            ros.talker("rospy", "/chatter", name="second")
            assert appliance.process is not None
            for client in CLIENTS:
                appliance.process.wait_for_error(f'"node": "/ear_{client}", "call": "publisherUpdate"')
        finally:
            for listener in listeners.values():
                listener.popen.send_signal(signal.SIGCONT)
        for listener in listeners.values():
            listener.wait_for(event="received", publisher="/second")
        assert appliance.audit("--event", "node lost") == []
