from pathlib import Path

from examples.landshark.lab import Host, Lab
from tests.support.appliance import Appliance
from tests.support.nodes import RosSession, need_ros


def test_a_topic_is_withheld_from_one_host(common_lab: Lab, common_robot: Host, tmp_path: Path) -> None:
    need_ros()
    tablet = common_lab.host("tablet", "10.77.0.11/24")
    for name in ("robot", "tablet"):
        (tmp_path / name).mkdir()
    with (
        Appliance(common_lab.host("private", "10.77.0.5/24"), options=("--api", "off")) as appliance,
        RosSession(appliance.master_uri, tmp_path / "robot", common_robot) as ros,
        RosSession(appliance.master_uri, tmp_path / "tablet", tablet) as far,
    ):

        def switch(*, on: bool) -> None:
            data = f"data: {str(on).lower()}"
            ros.run("rostopic", "pub", "-1", "/privacy", "std_msgs/Bool", data, "__name:=privacy_switch")

        topics = "--by", "/privacy", "--type", "command=std_msgs/String", "--type", "by=std_msgs/Bool"
        appliance.rosrv("guard", "new", "withhold", "/chatter", *topics, "hosts=10.77.0.11", "silent=0")
        near, away = ros.listener("roscpp", "/chatter"), far.listener("rospy", "/chatter", name="tablet")
        ros.talker("roscpp", "/chatter")
        near.wait_for_count(20, event="received", timeout=60)
        assert not away.seen(event="received")
        switch(on=False)
        away.wait_for_count(5, event="received", timeout=60)
        switch(on=True)
        hidden = len(away.seen(event="received"))
        near.wait_for_count(5, event="received", since=near.mark())
        appliance.kill("relay")
        near.wait_for_count(20, event="received", since=near.mark(), timeout=90)
        assert len(away.seen(event="received")) == hidden
        assert "withholding" in appliance.rosrv("guard", "list").stdout
        switch(on=False)
        away.wait_for_count(hidden + 5, event="received", timeout=60)
