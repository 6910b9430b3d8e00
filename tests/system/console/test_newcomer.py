"""Questions that a robot operator has on a first visit: each is answered within three clicks from Now."""

import re
from collections.abc import Callable
from typing import Any

import pytest
from playwright.sync_api import Locator, Page, expect

from tests.support.appliance import Appliance
from tests.system.console.reader import Reader

MAX_CLICKS = 3
QUESTIONS: dict[str, tuple[list[Callable[[Page], Locator]], str]] = {
    "who drives?": ([], r"Drives.*every host that may"),
    "who waits for me?": ([], r"Waits.*no call waits"),
    "why was it denied?": (
        [lambda page: page.get_by_role("link", name=re.compile("^Denied"))],
        r"not among the hosts.*\[Publishers\] /guarded",
    ),
    "may a host subscribe to a topic?": (
        [
            lambda page: page.get_by_role("link", name="Policy", exact=True),
            lambda page: page.get_by_role("tab", name="Explain"),
        ],
        r"Wants to.*publish a topic",
    ),
    "what stopped the robot at 14:03, and where is the log of yesterday?": (
        [
            lambda page: page.get_by_role("link", name="Audit", exact=True),
            lambda page: page.get_by_role("button", name="Filters"),
            lambda page: page.get_by_label("From", exact=True),
        ],
        r"From.*Until",
    ),
    "what does a guard see now?": (
        [lambda page: page.get_by_role("link", name="Robot", exact=True)],
        "A guard stops the robot",
    ),
    "how do I undo the last block?": (
        [
            lambda page: page.get_by_role("region", name="Open alarms").get_by_role(
                "link", name=re.compile("is blocked")
            ),
        ],
        r"Blocked hosts.*192\.0\.2\.66.*Unblock",
    ),
    "what may this token do?": (
        [lambda page: page.get_by_role("button", name=re.compile("admin"))],
        "has the role admin until.*loads the policy",
    ),
}


@pytest.fixture
def site(appliance: Appliance, attempt: Callable[..., Any]) -> None:
    attempt("registerPublisher", "/intruder", "/guarded", "std_msgs/String", "http://127.0.0.1:1/")
    appliance.rosrv("host", "block", "192.0.2.66")


@pytest.mark.usefixtures("site")
def test_a_newcomer_finds_the_answer_within_three_clicks(opened: Callable[..., Reader]) -> None:
    reader = opened()
    for question, (clicks, answer) in QUESTIONS.items():
        page = reader.go("now")
        expect(page.locator("[data-standing=live]")).to_be_visible()
        for place in clicks:
            place(page).first.click()
        expect(page.locator("#app, body").first, question).to_have_text(re.compile(answer, re.DOTALL))
        assert len(clicks) <= MAX_CLICKS, question
        reader.fits()
    assert reader.axe() == []
    reader.keep_picture("what_this_token_may_do")
