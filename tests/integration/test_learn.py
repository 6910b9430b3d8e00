import xmlrpc.client
from pathlib import Path

from tests.support.appliance import Appliance
from tests.support.nodes import RosSession, need_ros

TRIAL = "[Nodes]\n[Publishers]\n[Subscribers]\n[Commands]\n[Services]\n[Clients]\n[Parameters]\n"
TRIAL += "[Options]\naudit-only = all\n"


def run_nodes(appliance: Appliance, home: Path) -> None:
    home.mkdir()
    with RosSession(appliance.master_uri, home) as ros:
        ros.talker("rospy", "/chatter", name="talker")
        ros.listener("rospy", "/chatter", name="listener").wait_for(event="received")
        ros.service_server("rospy", "/switch", name="server")
        client = ros.service_client("rospy", "/switch", name="client")
        client.send("true")
        client.wait_for(event="answered")
        ros.run("rosparam", "set", "/arm/speed", "3")
        assert "3" in ros.run("rosparam", "get", "/arm/speed").stdout
        assert "/chatter" in ros.run("rostopic", "list").stdout


def test_the_same_robot_works_under_the_learned_policy(tmp_path: Path) -> None:
    need_ros()
    with Appliance(policy=TRIAL) as appliance:
        run_nodes(appliance, tmp_path / "first")
        learned = tmp_path / "learned.ini"
        appliance.rosrv("policy", "learn", "--robot", "127.0.0.1", "--output", str(learned))
        assert "/chatter" in learned.read_text()
        assert appliance.rosrv("policy", "learn", "--since", "2999-01-01", check=False).returncode == 1
        appliance.reload(learned.read_text())
        before = appliance.audit()[0]["sequence"]
        run_nodes(appliance, tmp_path / "second")
        denied = [one for one in appliance.audit("--deny") if one["sequence"] > before]
        assert not denied, [(one["caller_id"], one["resource"], one["reason"]) for one in denied]
        with xmlrpc.client.ServerProxy(appliance.master_uri) as master:
            there = "http://127.0.0.1:1/"
            for answer in (
                master.registerPublisher("/talker", "/other", "std_msgs/String", there),
                master.registerPublisher("/intruder", "/chatter", "std_msgs/String", there),
                master.registerService("/server", "/other", "rosrpc://127.0.0.1:1", there),
                master.setParam("/rosparam", "/other", 1),
                master.deleteParam("/rosparam", "/arm/speed"),
            ):
                assert isinstance(answer, list)
                assert answer[0] == 0, answer
