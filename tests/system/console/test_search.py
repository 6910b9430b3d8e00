"""The search finds names, rules, records, guards and doors, and leads to their pages."""

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Locator, Page, expect

from tests.support.appliance import Appliance
from tests.support.nodes import RosSession
from tests.system.console.conftest import CONFIG, POLICY
from tests.system.console.reader import Reader


@pytest.fixture(scope="module")
def appliance() -> Iterator[Appliance]:
    with Appliance(policy=POLICY, settings=CONFIG, monitors={}) as running:
        yield running


def search(page: Page, text: str) -> Locator:
    page.keyboard.press("/")
    box = page.get_by_role("dialog", name="Search")
    page.keyboard.type(text)  # without a wait: no key is lost, and none is taken as a shortcut
    expect(box.get_by_role("textbox")).to_have_value(text)
    return box


def test_each_kind_leads_to_its_page(
    appliance: Appliance,
    opened: Callable[..., Reader],
    token: Callable[..., str],
    attempt: Any,
    tmp_path: Path,
) -> None:
    appliance.rosrv(
        "guard", "new", "deadman", "/wheels", "--name", "wheelstop", "--type", "command=geometry_msgs/Twist"
    )
    assert "not among the hosts" in str(
        attempt("registerPublisher", "/intruder", "/guarded", "std_msgs/String", "http://127.0.0.1:9/")
    )
    with RosSession(appliance.master_uri, tmp_path) as ros:
        ros.talker("rospy", "/battery")
        for width, height, view, role in ((1440, 900, "policy", "admin"), (390, 844, "now", "viewer")):
            reader = opened(token(role), width=width, height=height)
            page = reader.go(view)
            box = search(page, "batt")
            result = box.get_by_role("region", name="Topics").get_by_role("link")
            expect(result).to_contain_text("/battery")
            assert reader.axe() == []
            reader.fits()
            page.keyboard.press("Enter")
            expect(page).to_have_url(re.compile(r"/console/graph\?item=t%2Fbattery"))
            expect(page.get_by_role("heading", name="/battery")).to_be_visible()
            box = search(page, "guarded")
            expect(box.get_by_role("region", name="Records").get_by_role("link").first).to_contain_text(
                "publish /guarded"
            )
            box.get_by_role("region", name="Rules").get_by_role("link").click()
            expect(page).to_have_url(re.compile(r"/console/policy\?line=\d+"))
            box = search(page, "intruder")
            box.get_by_role("region", name="Records").get_by_role("link").first.click()
            expect(page.get_by_role("heading", name=re.compile(r"^Record \d+"))).to_be_visible()
            search(page, "wheelst").get_by_role("region", name="Guards").get_by_role("link").click()
            expect(page.locator("[data-guard=wheelstop]")).to_be_focused()
            box = search(page, "no such thing")
            expect(box).to_contain_text("Nothing found that your role may read")
            page.keyboard.press("Escape")
            expect(box).to_have_count(0)
