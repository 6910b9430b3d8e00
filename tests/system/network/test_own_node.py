import contextlib
import json
import socket
import subprocess
import sys
from collections.abc import Iterator

import pytest

from appliance.channel.rosout_address import ADDRESS
from appliance.network.firewall.firewall import BackendChoice, Firewall
from appliance.network.firewall.firewall_rules import FirewallSettings, OwnNodeAccess, PortRange
from appliance.supervisor.users import account_of
from examples.landshark.lab import Host, Lab
from tests.support.appliance import Appliance
from tests.support.nodes import need_ros
from tests.support.requirements import need_program, need_root

CONTROL, ROSMASTER, RELAY, ROSOUT, OTHER = 61011, 61012, 61013, 61018, 61055
PORTS = PortRange(17000, 17063)

SERVE = """
import socket, sys
api = socket.create_server(("0.0.0.0", 0))
messages = socket.create_server(("127.0.0.1", int(sys.argv[1])))
print(api.getsockname()[1], flush=True)
sys.stdin.read()
"""
CONNECT = """
import json, socket, sys
found = []
for address, port in json.loads(sys.argv[1]):
    try:
        socket.create_connection((address, port), timeout=5).close()
        found.append("reached")
    except TimeoutError:
        found.append("timed out")
    except ConnectionRefusedError:
        found.append("refused")
print(json.dumps(found))
"""
CALL = """
import json, sys, xmlrpc.client
master = xmlrpc.client.ServerProxy(sys.argv[1])
print(json.dumps([getattr(master, name)(*given) for name, *given in json.loads(sys.argv[2])]))
"""


@pytest.fixture
def host(lab: Lab) -> Host:
    need_program("iptables-legacy", "iptables")
    return lab.host("appliance", "10.77.0.2/24")


def run(host: Host, uid: int, program: str, *arguments: str) -> str:
    process = host.popen(
        [sys.executable, "-I", "-S", "-c", program, *arguments],
        user=uid, group=uid, extra_groups=[], cwd="/", stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    return str(process.communicate(timeout=60)[0])


def connect(host: Host, uid: int, *targets: tuple[str, int]) -> list[str]:
    found: list[str] = json.loads(run(host, uid, CONNECT, json.dumps(targets)))
    return found


@contextlib.contextmanager
def rosout(host: Host, port: int) -> Iterator[int]:
    process = host.popen(
        [sys.executable, "-I", "-S", "-c", SERVE, str(port)],
        user=ROSOUT, group=ROSOUT, extra_groups=[], cwd="/",
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    with process:
        assert process.stdin is not None
        assert process.stdout is not None
        yield int(process.stdout.readline())
        process.stdin.close()


@pytest.mark.parametrize("backend", ["nft", "iptables"])
def test_only_control_calls_it_and_only_the_relay_gets_its_messages(
    host: Host, backend: BackendChoice
) -> None:
    node = OwnNodeAccess(uid=ROSOUT, relay_uid=RELAY, address=ADDRESS, ports=PORTS)
    with rosout(host, PORTS.first) as api:
        everywhere = [(ADDRESS, api), ("127.0.0.1", api), (host.address, api), ("127.0.0.1", PORTS.first)]
        assert connect(host, OTHER, *everywhere) == ["reached"] * 4, "without rules"
        Firewall(host.namespace, backend).install(
            FirewallSettings(control_uid=CONTROL, rosmaster_uid=ROSMASTER, own_node=node)
        )
        assert connect(host, CONTROL, *everywhere) == ["reached", "timed out", "timed out", "refused"]
        assert connect(host, RELAY, *everywhere) == ["refused", "timed out", "timed out", "reached"]
        for uid in (0, ROSMASTER, ROSOUT, OTHER):
            found = connect(host, uid, *everywhere)
            assert "reached" not in found, (uid, found)


def test_a_compromised_rosout_or_rosmaster_reaches_nothing() -> None:
    need_root()
    need_ros()
    with Lab("rosrv-own") as lab:
        host, robot = lab.host("appliance", "10.77.0.2/24"), lab.host("robot", "10.77.0.10/24")
        with Appliance(host, options=("--api", "10.77.0.2:8443")) as appliance, listening(robot) as outside:
            rows = {row["purpose"]: row["rule"] for row in appliance.status()["firewall"]["rules"]}
            own = int(rows["own node's master: rosout may"].split("tcp ")[1].split(",")[0])
            hidden = int(rows["ROS master port: control may"].split("tcp ")[1].split(",")[0])
            for user, reaches_own in (
                ("rosrv-rosout", "reached"),
                ("rosmaster", "refused"),
                ("rosrv-relay", "refused"),
            ):
                uid = account_of(user).uid
                assert connect(host, uid, ("127.0.0.1", own), ("127.0.0.1", hidden)) == [
                    reaches_own,
                    "refused",
                ], user
            for user in ("rosrv-rosout", "rosmaster"):
                targets = ((host.address, 11311), (host.address, 8443), (robot.address, outside))
                found = connect(host, account_of(user).uid, *targets)
                assert found == ["refused", "refused", "timed out"], user
            uri = f"http://127.0.0.1:{own}"
            calls = [
                ["registerPublisher", "/talker", "/cmd_vel", "geometry_msgs/Twist", "http://127.0.0.1:9/"],
                ["registerPublisher", "/rosout", "/cmd_vel", "geometry_msgs/Twist", "http://127.0.0.1:9/"],
                ["registerService", "/rosout", "/stop", "rosrpc://127.0.0.1:9", "http://127.0.0.1:9/"],
                ["setParam", "/rosout", "/use_sim_time", True],
                ["getParam", "/rosout", "/"],
                ["getSystemState", "/rosout"],
                ["shutdown", "/rosout", "the end"],
                ["hasParam", "/rosout", "/use_sim_time"],
            ]
            answers = json.loads(run(host, account_of("rosrv-rosout").uid, CALL, uri, json.dumps(calls)))
            assert [code for code, *_ in answers] == [0] * 7 + [1]
            assert all("the appliance's own node and may not" in text for _code, text, _ in answers[:7])
            for resource in ("/cmd_vel", "/stop", "shutdownMaster"):
                appliance.recorded("--deny", caller_id="/rosout", resource=resource)
            assert appliance.rosrv("status", check=False).returncode == 0


@contextlib.contextmanager
def listening(host: Host) -> Iterator[int]:
    with host.entered():
        server = socket.create_server((host.address, 0))
    with server:
        yield server.getsockname()[1]
