import re
import shlex
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from playwright.sync_api import expect

from tests.support.appliance import Appliance
from tests.support.nodes import RosSession
from tests.system.console.conftest import CONFIG
from tests.system.console.reader import Reader

_ODOMETRY = "{pose: {pose: {position: {x: 1.5}, orientation: {w: 1}}}}"


@pytest.fixture(scope="module")
def appliance() -> Iterator[Appliance]:
    with Appliance(settings=CONFIG, monitors={}) as running:
        yield running


def test_a_fence_is_drawn_changed_and_enforced(
    appliance: Appliance, opened: Callable[..., Reader], token: Callable[..., str], tmp_path: Path
) -> None:
    types = ("--type", "command=geometry_msgs/Twist", "--type", "by=nav_msgs/Odometry")
    made = appliance.rosrv("guard", "new", "fence", "/cmd_vel", "--by", "/odom", "--shadow", *types)
    assert made.returncode == 0, made.stderr
    reader = opened()
    page = reader.go("robot")
    row = page.locator("tr[data-guard=fence]")
    expect(page.get_by_text("The guard has no position yet.")).to_be_visible()
    with RosSession(appliance.master_uri, tmp_path) as ros:
        ros.start(["rostopic", "pub", "-r", "20", "/odom", "nav_msgs/Odometry", _ODOMETRY])
        appliance.recorded("--category", "publish", resource="/odom")  # from now on it can be watched
        expect(page.get_by_role("img", name="Map of fence")).to_be_visible()
        expect(page.get_by_text("The guard has the robot at 1.5, 0, 0.5 m from the edge.")).to_be_visible()
        reader.keep_picture("a_fence")
        page.get_by_role("button", name="Watch").click()
        expect(row).to_contain_text("distance to the edge 0.5 at least 0.2 m")
        assert reader.axe() == []
        row.get_by_role("button", name="Values…").click()
        known = page.get_by_role("dialog")
        expect(known.get_by_role("row", name="atX")).to_contain_text("1.5")
        expect(known.get_by_role("row", name="last foreign")).to_contain_text("none yet")
        reader.keep_picture("what_a_fence_knows")
        assert reader.axe() == []
        known.get_by_role("button", name="Close").click()
        assert [one["detail"]["who"] for one in appliance.recorded("--event", "monitor looked into")] == [
            "first"
        ]
    # The source has ended, so the position grows old.
    expect(page.get_by_text(re.compile(r"The guard has the robot at 1\.5, 0, .* s ago\."))).to_be_visible()
    assert "pose: " in appliance.rosrv("guard", "show", "fence").stdout
    watcher = opened(token("viewer", "onlooker")).go("robot")
    expect(watcher.get_by_text("Operators see the position that the guard has.")).to_be_visible()
    row.get_by_role("button", name="Set…").click()
    polygon = page.get_by_label("polygon")
    polygon.fill("-1,-1 1,-1 1,1 -1,1")
    expect(page.get_by_text("These values would have stopped the robot")).to_be_visible()
    page.get_by_role("button", name="Corner 2").press("Shift+ArrowRight")
    expect(polygon).to_have_value("-1,-1 2,-1 1,1 -1,1")
    assert reader.axe() == []
    page.get_by_role("dialog").get_by_role("button", name="Set", exact=True).click()
    expect(reader.toast("fence is set")).to_be_visible()
    row.get_by_role("button", name="Enforce").click()
    page.get_by_role("dialog").get_by_role("button", name="Enforce").click()
    expect(row).to_contain_text("unless confirmed")
    row.get_by_role("button", name="Confirm").click()
    expect(row).not_to_contain_text("unless confirmed")
    assert "polygon = -1,-1 2,-1 1,1 -1,1;" in appliance.rosrv("monitor", "show").stdout
    viewed = opened(token("viewer")).go("robot").locator("tr[data-guard=fence]")
    expect(viewed.get_by_role("button", name="Remove")).to_have_attribute("aria-disabled", "true")
    row.get_by_role("button", name="Remove").click()
    page.get_by_role("dialog").get_by_role("button", name="Remove").click()
    expect(page.get_by_text("No guard", exact=True)).to_be_visible()
    page.get_by_role("button", name="Undo").click()
    expect(reader.toast("fence is back")).to_be_visible()
    expect(row).to_contain_text("/cmd_vel")
    assert "polygon = -1,-1 2,-1 1,1 -1,1;" in appliance.rosrv("monitor", "show").stdout
    removed = appliance.rosrv("guard", "remove", "fence").stdout
    undo = shlex.split(removed.partition("undo: ")[2].splitlines()[0])
    assert appliance.rosrv(*undo[1:]).returncode == 0
    assert "polygon = -1,-1 2,-1 1,1 -1,1;" in appliance.rosrv("monitor", "show").stdout
    appliance.rosrv("guard", "remove", "fence")


def test_the_check_of_a_driver_asks_measures_and_ends_with_its_window(
    appliance: Appliance, opened: Callable[..., Reader], token: Callable[..., str], tmp_path: Path
) -> None:
    reader = opened()
    with RosSession(appliance.master_uri, tmp_path) as ros:
        base = ros.node("rospy", "driven_base", "0.48")
        driver = ros.node("rospy", "driver", name="driver")
        base.wait_for(event="moves")
        page = reader.go("robot")
        page.get_by_role("button", name="Check the driver").click()
        dialog = page.get_by_role("dialog")
        expect(dialog).to_contain_text("May the base drive on?")
        expect(dialog.get_by_label("Commands")).to_have_value("/cmd_vel")
        expect(dialog.get_by_label("Odometry")).to_have_value("/odom")
        assert reader.axe() == []
        assert not appliance.audit("--event", "driver checked")
        dialog.get_by_role("button", name="The base may drive on").click()
        expect(dialog.get_by_role("status")).to_contain_text("drive slowly now")
        expect(dialog.get_by_role("status")).to_contain_text("the driver stopped the base")
        assert reader.axe() == []
        driver.kill()
        dialog.get_by_role("button", name="Check again").click()
        expect(dialog.get_by_role("status")).to_contain_text("drive slowly now")
        dialog.get_by_role("button", name="End the check").click()
        records = appliance.recorded("--event", "driver checked", count=2)
        assert {record["detail"]["outcome"] for record in records} == {"stopped", "interrupted"}
    viewed = opened(token("viewer", "watcher")).go("robot").get_by_role("button", name="Check the driver")
    expect(viewed).to_have_attribute("aria-disabled", "true")


@pytest.mark.parametrize(
    ("options", "then", "after"),
    [
        ((), (), "free"),
        (("--shadow",), (), "shadow"),
        ((), ("monitor", "disable", "deadman"), "shadow"),
        ((), ("monitor", "disable", "deadman", "--for", "10m"), "shadow"),
        (("--shadow",), ("guard", "enforce", "deadman", "--confirm-within", "600s"), "shadow"),
    ],
    ids=["in force", "shadow mode", "off", "off for a time", "until confirmed"],
)
def test_an_undo_brings_no_guard_into_force_that_was_not(
    appliance: Appliance,
    opened: Callable[..., Reader],
    options: tuple[str, ...],
    then: tuple[str, ...],
    after: str,
) -> None:
    """Neither that of the page nor the command that `rosrv guard remove` prints."""
    page = opened().go("robot")
    for in_page in (True, False):
        types = ("--type", "command=geometry_msgs/Twist")
        made = appliance.rosrv("guard", "new", "deadman", "/cmd_vel", *types, *options)
        assert made.returncode == 0, made.stderr
        if then:
            assert appliance.rosrv(*then).returncode == 0
        if in_page:
            page.locator("tr[data-guard=deadman]").get_by_role("button", name="Remove").click()
            page.get_by_role("dialog").get_by_role("button", name="Remove").click()
            page.get_by_role("button", name="Undo").click()
            expect(page.locator(".toasts").get_by_text("deadman is back")).to_be_visible()
        else:
            removed = appliance.rosrv("guard", "remove", "deadman").stdout
            undo = shlex.split(removed.partition("undo: ")[2].splitlines()[0])
            assert appliance.rosrv(*undo[1:]).returncode == 0
        [row] = appliance.rest().get("/v1/guards").json["guards"]
        assert (row["state"], row["confirm_by"]) == (after, None)
        appliance.rosrv("guard", "remove", "deadman")
