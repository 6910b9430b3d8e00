"""Ages and times that are left: under a browser's clock that differs, without news, and after a computer has slept."""

import contextlib
import os
import re
import signal
from collections.abc import Callable

import pytest
from playwright.sync_api import expect

from tests.support.appliance import Appliance
from tests.system.console.reader import LIMIT, Reader

# The wall clock of the page differs by `shifted` milliseconds; as in a computer that sleeps, no timer notices.
_SHIFTED = """
const Real = Date;
window.shifted = SHIFT;
window.Date = class extends Real {
  constructor(...given) { given.length ? super(...given) : super(Real.now() + window.shifted); }
  static now() { return Real.now() + window.shifted; }
};
"""
HOUR = 3_600_000
SECONDS = re.compile(r"running for \d+ (s|min)\b(?! \d+ h)")


def shifted(reader: Reader, milliseconds: int) -> None:
    reader.context.add_init_script(_SHIFTED.replace("SHIFT", str(milliseconds)))


@pytest.mark.parametrize("hours", [-1, 1])
def test_the_clock_of_a_browser_does_not_count(
    appliance: Appliance, opened: Callable[..., Reader], token: Callable[..., str], hours: int
) -> None:
    """A token of half an hour opens the page, and ages and remaining times are those of the appliance."""
    reader = opened(token("operator", f"skewed{hours}", "30m"))
    shifted(reader, hours * HOUR)
    page = reader.go("now")
    expect(page.locator("[data-standing=live]")).to_be_visible()
    expect(page.locator(".head-sub")).to_have_text(SECONDS)
    rest = appliance.rest()
    current = rest.get("/v1/policy")
    loaded = rest.post(
        "/v1/policy?confirm_within=600", f"{current.json['text']}\n# {hours}\n", match=current.etag
    )
    assert loaded.status == 200, loaded.body
    reader.go("policy")
    expect(page.get_by_text(re.compile("rolls back in (9 min|10 min)"))).to_be_visible()
    assert rest.post("/v1/policy/rollback", {}, match=loaded.etag).status == 200


def test_a_page_without_news_says_so(appliance: Appliance, opened: Callable[..., Reader]) -> None:
    reader = opened()
    page = reader.go("now")
    expect(page.locator("[data-standing=live]")).to_be_visible()
    drives = page.get_by_role("link", name=re.compile("^Drives"))
    expect(drives).to_have_text(re.compile("^Drives[^,]"))
    [process] = [one for one in appliance.status()["processes"] if one["role"] == "api"]
    os.kill(process["pid"], signal.SIGSTOP)
    try:
        banner = page.locator(".banner")
        expect(banner).to_contain_text(re.compile("No news|Not live"))
        reader.sees(drives, re.compile(r"^Drives, \d+ s ago"))
        expect(page.locator("[data-standing=live]")).to_have_count(0)
    finally:
        with contextlib.suppress(ProcessLookupError):  # the supervisor has replaced it
            os.kill(process["pid"], signal.SIGCONT)
    expect(page.locator("[data-standing=live]")).to_be_visible(timeout=2 * LIMIT)
    expect(page.locator(".banner")).to_have_count(0)
    expect(drives).to_have_text(re.compile("^Drives[^,]"))


def test_a_page_whose_computer_slept_is_not_taken_for_live(opened: Callable[..., Reader]) -> None:
    """After ten minutes it follows again, and after an hour it is locked, without any input."""
    reader = opened()
    shifted(reader, 0)
    page = reader.go("now")
    expect(page.locator("[data-standing=live]")).to_be_visible()
    with page.expect_request("**/v1/live*"):
        page.evaluate(f"window.shifted = {HOUR // 6}")
    expect(page.locator("[data-standing=live]")).to_be_visible()
    page.evaluate(f"window.shifted = {HOUR}")
    expect(page.get_by_role("dialog", name="Locked")).to_be_visible(timeout=2 * LIMIT)
