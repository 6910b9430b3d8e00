"""No cell of a table or list ends beyond its card, in any view, at the widths of people's screens."""

from collections.abc import Callable, Iterator

import pytest
from playwright.sync_api import expect

from appliance.base import clock
from tests.support.appliance import Appliance
from tests.support.nodes import RosSession
from tests.support.waiting import eventually
from tests.system.console.conftest import CONFIG
from tests.system.console.reader import Reader
from tests.system.console.test_situations import AGENT, TABLET, advertise

BASE = "/fleet/robot_17/base_controller/cmd_vel_from_the_teleoperation_station"
NODE = "/fleet/robot_17/navigation/move_base_with_recovery_behaviours_of_the_second_floor"
GUARDED = "/fleet/robot_17/manipulation/arm_controller/follow_joint_trajectory/goal"
POLICY = f"""\
[Groups]
teleoperation_station_of_the_second_floor = {TABLET}
agent = {AGENT}
[Nodes]
default = *
[Publishers]
default = *
{GUARDED} = 10.9.9.9
/approved{GUARDED} = 127.0.0.1 ask agent
[Subscribers]
default = *
[Commands]
default = *
[Authority]
base_of_the_robot_seventeen = {BASE}
take base_of_the_robot_seventeen = 127.0.0.1 teleoperation_station_of_the_second_floor
"""
VIEWS = ("now", "graph", "audit", "audit?decision=deny", "policy", "monitors", "hosts", "recordings", "robot")
DAY = 86_400
MANY = 300  # denials of one host, so that most are only counted
WIDTHS = ((1280, 800), (1366, 768), (390, 844))
_BEYOND = """() => {
  const cells = "td, th, .fact-text, [class^=card-], .alarm > *, .event > *, .panel-head > *, .facts > *";
  const right = (element) => element.getBoundingClientRect().right;
  const seen = (element) => element.checkVisibility() && !element.closest(".sr-only, .cm-editor, svg");
  const beyond = [...document.querySelectorAll(cells)].filter((cell) => {
    const card = cell.closest(".situation, .card, .panel, .record");
    if (!card || !seen(cell)) return false;
    const bound = Math.min(right(card), right(cell)) + 0.5;
    return [cell, ...cell.querySelectorAll("*")].some((one) => seen(one) && right(one) > bound);
  });
  return beyond.slice(0, 5).map((cell) => `${cell.className || cell.tagName}: ${cell.textContent.slice(0, 60)}`);
}"""


@pytest.fixture(scope="module")
def appliance(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Appliance]:
    with (
        Appliance(policy=POLICY, settings=CONFIG, monitors={}) as running,
        RosSession(running.master_uri, tmp_path_factory.mktemp("ros")) as ros,
    ):
        name = f"__name:={NODE.rpartition('/')[2]}"
        ros.start(["rostopic", "pub", "-r", "5", BASE, "geometry_msgs/Twist", "{linear: {x: 0.3}}", name])
        eventually(lambda: "not carried" in running.rosrv("drive", "status").stdout, "it publishes in vain")
        running.rosrv("guard", "new", "deadman", BASE, "--type", "command=geometry_msgs/Twist")
        running.rosrv("host", "add", "operators-tablet-of-the-second-floor", check=False)
        running.rosrv("host", "block", "192.0.2.66", "--note", "the tablet that was lost in the second hall")
        for host, topic, kind in (
            (TABLET, GUARDED, "control_msgs/FollowJointTrajectoryActionGoal"),
            (AGENT, f"/approved{GUARDED}", "control_msgs/FollowJointTrajectoryActionGoal"),
        ):
            advertise(running, host, topic, node=NODE, kind=kind)
        for _ in range(MANY):
            advertise(running, TABLET, GUARDED, node=f"{NODE}_of_the_tablet")
        running.recorded("--event", "denials folded", host=TABLET)
        yield running


@pytest.mark.parametrize(("width", "height"), WIDTHS)
def test_no_cell_ends_beyond_its_card(width: int, height: int, opened: Callable[..., Reader]) -> None:
    reader, found = opened(width=width, height=height), dict[str, list[str]]()
    for view in VIEWS:
        reader.page.clock.set_fixed_time(clock.wall() + 2 * DAY)  # records of another day have longer times
        page = reader.go(view)
        expect(page.locator("[data-standing=live]")).to_be_visible()
        reader.settle()
        if view.startswith("audit?"):
            page.get_by_role("table", name="Records").locator("tbody tr").first.click()
            expect(page.locator(".record .facts").first).to_be_visible()
        reader.fits()
        reader.keep_picture(f"cells-{view.replace('?', '-')}")
        found[view] = page.evaluate(_BEYOND)
    assert {view: cells for view, cells in found.items() if cells} == {}
