"""Two hosts with a rank move: the panel and the situation name who drives, while a person looks."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Locator, Page, expect

from examples.landshark.doorway import Doorway
from examples.landshark.lab import Host, Lab
from tests.support.appliance import Appliance
from tests.support.nodes import RosSession
from tests.system.console.reader import Reader

CONSOLE = "127.0.0.1", 8443
PAD, AUTONOMY = "10.77.0.66", "10.77.0.67"
POLICY = f"""
[Groups]
ocu = {PAD}
autonomy = {AUTONOMY}
[Nodes]
default = *
[Publishers]
default = *
[Subscribers]
default = *
[Commands]
default = *
[Authority]
base = /cmd_vel
rank base = ocu/gamepad > autonomy/planner
free base = 300ms
"""


@pytest.fixture(scope="module")
def appliance(common_lab: Lab) -> Iterator[Appliance]:
    host = common_lab.host("appliance", "10.77.0.2/24")
    options = ("--api", f"{CONSOLE[0]}:{CONSOLE[1]}")
    with Appliance(host, policy=POLICY, options=options) as running:
        yield running


@pytest.fixture
def windows(appliance: Appliance, browser: Browser) -> Iterator[list[Reader]]:
    assert isinstance(appliance.host, Host)
    token = str(appliance.ready["token"])
    with Doorway(appliance.host, CONSOLE) as door:
        url = f"https://127.0.0.1:{door.port}"
        with (
            Reader(browser, url, token) as wide,
            Reader(browser, url, token, width=390, height=844) as narrow,
        ):
            yield [wide, narrow]


def test_the_driver_and_a_hand_over_are_seen_as_they_happen(
    appliance: Appliance, common_lab: Lab, common_robot: Host, windows: list[Reader], tmp_path: Path
) -> None:
    with RosSession(appliance.master_uri, tmp_path, common_robot) as ros:
        ros.node("rospy", "commanded_base")
        gamepad = ros.on(common_lab.host("ocu", f"{PAD}/24")).node("rospy", "stick", name="gamepad")
        planner = ros.on(common_lab.host("autonomy", f"{AUTONOMY}/24")).node("rospy", "stick", name="planner")
        for reader in windows:
            reader.go("robot")
        planner.send("0.3")
        shown(windows, "after_a_start", re.compile("unknown"))
        windows[0].page.get_by_role("button", name="Free…").click()
        windows[0].page.get_by_role("dialog").get_by_role("button", name="Free").click()
        shown(windows, "the_planner_drives", re.compile(r"moving.*planner"))
        gamepad.send("0.5")
        shown(windows, "the_gamepad_drives", re.compile(r"moving.*gamepad"))
        gamepad.send("0")
        shown(windows, "handed_back", re.compile(r"moving.*planner"))
        gamepad.send("0.5")
        shown(windows, "the_gamepad_again", re.compile(r"moving.*gamepad"))
        gamepad.send("silent")
        shown(windows, "a_lost_gamepad", re.compile(r"lost.*gamepad"))
        for reader in windows:
            page = reader.go("now")
            drives = page.get_by_role("region", name="Situation").get_by_role(
                "link", name=re.compile("^Drives")
            )
            reader.sees(drives, re.compile("base.*lost.*gamepad"))
            reader.keep_picture("a_lost_gamepad_on_now")


def shown(windows: list[Reader], name: str, text: re.Pattern[str]) -> None:
    """Wait until the first panel of *Robot* says so, without scrolling; keep a picture of it."""
    for reader in windows:
        reader.sees(panel(reader.page), text)
        reader.fits()
        reader.keep_picture(f"rank_{name}")
    assert windows[0].axe() == []


def panel(page: Page) -> Locator:
    row = page.get_by_role("region", name="Who drives").locator("tr[data-group=base]")
    expect(row).to_be_visible()
    return row
