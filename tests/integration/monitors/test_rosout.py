from collections.abc import Iterator

import pytest

from tests.support.appliance import Appliance
from tests.support.nodes import RosSession, need_ros
from tests.support.rosmaster import await_node

SPECIFICATION = """
gate() {
    event good(std::string text) /chatter std_msgs/String '{data:text}' { ROS_WARN("heard something"); }
    fsm: start [ good -> heard ] heard [ good -> heard ]
    @heard { DROP; }
    @fail { ROS_ERROR("broken"); }
}
"""


@pytest.fixture
def appliance() -> Iterator[Appliance]:
    need_ros()
    settings, monitors = "monitors_on_rosout: true\n", {"gate": SPECIFICATION}
    with Appliance(settings=settings, monitors=monitors, options=("--api", "off"), relays=2) as appliance:
        yield appliance


def test_output_and_verdicts_reach_rosout_agg(appliance: Appliance, ros: RosSession) -> None:
    echo = ros.start(["/usr/bin/rostopic", "echo", "--filter", "m.name == '/rosrv'", "/rosout_agg"])
    await_node(appliance.master_uri, appliance.host, "/rosrv")
    assert "/rosrv" in ros.run("/usr/bin/rostopic", "info", "/rosout").stdout
    ros.talker("roscpp", "/chatter", name="voice")
    for text in (
        'msg: "heard something"',
        "level: 4",
        'name: "/rosrv"',
        'function: "gate"',
        'file: "gate.rv"',
    ):
        echo.wait_for_text(text)
    echo.wait_for_text("property 1 of gate (fsm): heard")
    appliance.kill("relay")
    before = echo.mark()
    echo.wait_for_text('msg: "heard something"', since=before)
