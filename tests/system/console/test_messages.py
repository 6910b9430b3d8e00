from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from playwright.sync_api import expect

from tests.support.appliance import Appliance
from tests.support.nodes import RosSession, need_ros
from tests.system.console.reader import LIMIT, Reader


@pytest.fixture
def ros(appliance: Appliance, tmp_path: Path) -> Iterator[RosSession]:
    need_ros()
    with RosSession(appliance.master_uri, tmp_path) as session:
        yield session


def test_the_last_message_is_shown_and_the_look_recorded(
    appliance: Appliance, opened: Callable[..., Reader], token: Callable[..., str], ros: RosSession
) -> None:
    ros.talker("rospy", "/chatter", "--text", "<b>said</b>", name="voice").wait_for(event="ready")
    reader = opened(token("operator", "olga"))
    page = reader.go("graph")
    page.get_by_label("Search the graph").fill("/chatter")
    expect(page.locator('[data-key="t/chatter"]')).to_be_visible(timeout=LIMIT)
    page.get_by_label("Search the graph").press("Enter")
    look = page.get_by_role("button", name="Look", exact=True)
    look.focus()
    page.keyboard.press("Enter")
    shown = page.get_by_label("The last message")
    expect(shown).to_contain_text("<b>said</b>", timeout=LIMIT)
    page.get_by_role("button", name="Stop", exact=True).click()
    expect(look).to_be_visible()
    records = appliance.recorded("--event", "topic looked into")
    assert {record["detail"]["who"] for record in records} == {"olga"}
    page = opened(token("viewer")).go("graph")
    page.get_by_label("Search the graph").fill("/chatter")
    expect(page.locator('[data-key="t/chatter"]')).to_be_visible(timeout=LIMIT)
    page.get_by_label("Search the graph").press("Enter")
    expect(page.get_by_role("button", name="Look (For the role operator")).to_be_disabled()
