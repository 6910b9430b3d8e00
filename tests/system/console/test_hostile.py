from collections.abc import Callable
from typing import Any

import pytest
from playwright.sync_api import expect

from tests.support.appliance import Appliance
from tests.system.console.reader import Reader

MARKUP = '/<img src=x onerror="window.ran=1"><script>window.ran=1</script>'
REORDERING = "/safe\u202egnp.rm\u2066"
INVISIBLE = "/op\u200berator"
CONTROL = "/bell\tand\x7ftab\u0085"
LONG = "/" + "n" * 10_000


@pytest.fixture(autouse=True)
def sent(appliance: Appliance, attempt: Callable[..., Any]) -> None:
    for name in (MARKUP, REORDERING, INVISIBLE, CONTROL, LONG):
        attempt("registerPublisher", name, "/guarded", "std_msgs/String", "http://127.0.0.1:1/")
        attempt("registerPublisher", "/somebody", name, "std_msgs/String", "http://127.0.0.1:1/")
        attempt("getParam", name, name)
    attempt("registerPublisher", "/afterwards", "/guarded", "std_msgs/String", "http://127.0.0.1:1/")
    appliance.recorded("--deny", caller_id="/afterwards")


@pytest.mark.parametrize("view", ["now", "graph", "audit", "audit?text=img", "audit?severity=warning"])
def test_names_are_text(view: str, opened: Callable[..., Reader]) -> None:
    reader = opened(width=1280)
    page = reader.go(view)
    expect(page.locator("[data-standing=live]")).to_be_visible()
    if view.startswith("audit"):
        expect(page.locator("tbody tr").first).to_be_visible()
    assert page.locator("main img").count() == 0
    assert page.locator("main script").count() == 0
    assert page.evaluate("window.ran") is None
    reader.fits()


def test_invisible_characters_are_shown(opened: Callable[..., Reader]) -> None:
    reader = opened()
    page = reader.go("audit?text=safe")
    expect(page.locator("tbody").get_by_text("RLO").first).to_be_visible()
    expect(page.locator("tbody").get_by_text("U+2066").first).to_be_visible()
    reader.go("audit?text=erator")
    expect(page.locator("tbody").get_by_text("ZWSP").first).to_be_visible()
    reader.go("audit?text=bell")
    expect(page.locator("tbody").get_by_text("TAB").first).to_be_visible()
    reader.go("audit?text=nnnnnnnn")
    page.locator("tbody tr").first.click()
    expect(page.locator(".record").get_by_text("characters").first).to_be_visible()
    assert "\u202e" not in page.locator("body").inner_text()


def test_the_record_itself_is_harmless(opened: Callable[..., Reader]) -> None:
    reader = opened()
    page = reader.go("audit?text=onerror")
    page.locator("tbody tr").first.click()
    page.get_by_role("button", name="Show JSON").click()
    expect(page.locator(".record pre").last).to_contain_text("onerror")
    assert page.locator("main img").count() == 0
    assert page.evaluate("window.ran") is None
