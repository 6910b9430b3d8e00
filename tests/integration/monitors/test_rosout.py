"""What monitors say is on /rosout for everybody who looks there, when it is configured."""

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.appliance import Appliance
from tests.support.nodes import RosSession, has_ros
from tests.support.requirements import needs

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
    """An appliance that is to put on /rosout what the monitor `gate` says; two relays."""
    needs(has_ros(), "ROS 1 and g++ (run `make setup`)")
    with tempfile.TemporaryDirectory(prefix="rosrv-rosout-") as name:
        folder = Path(name)
        folder.chmod(0o755)
        (folder / "gate.rv").write_text(SPECIFICATION)
        config = folder / "appliance.yaml"
        config.write_text("monitors_on_rosout: true\n")
        options = ("--config", str(config), "--monitors", str(folder), "--api", "off")
        with Appliance(options=options, relays=2) as appliance:
            yield appliance


def test_output_and_verdicts_reach_rosout_agg(appliance: Appliance, tmp_path: Path) -> None:
    """As `rosgraph_msgs/Log` of the node /rosrv: the aggregator passes them on to rqt_console and `rostopic echo`."""
    with RosSession(appliance.master_uri, tmp_path) as ros:
        echo = ros.start(["/usr/bin/rostopic", "echo", "--filter", "m.name == '/rosrv'", "/rosout_agg"])
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
