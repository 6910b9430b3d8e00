import re
from collections.abc import Callable
from typing import Any

import pytest
from playwright.sync_api import Browser, expect

from tests.support.appliance import Appliance
from tests.system.console.reader import Reader

VIEWS = [
    "now",
    "graph",
    "audit?decision=deny",
    "policy",
    "monitors",
    "monitors/safeTrigger",
    "hosts",
    "recordings",
    "robot",
]


@pytest.fixture(autouse=True)
def refused(appliance: Appliance, attempt: Callable[..., Any]) -> None:
    attempt("registerPublisher", "/intruder", "/guarded", "std_msgs/String", "http://127.0.0.1:1/")
    appliance.recorded("--deny", caller_id="/intruder")


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("width", [1440, 390])
def test_axe_finds_nothing(theme: str, width: int, opened: Callable[..., Reader]) -> None:
    """Each view is dark and light, wide and narrow, with a record, an error and a dialog. None exceeds its window."""
    reader = opened(theme=theme, width=width)
    found: dict[str, list[str]] = {}
    for view in VIEWS:
        heading = "safeTrigger" if view.endswith("safeTrigger") else None
        page = reader.go(view, heading=heading)
        expect(page.locator("[data-standing=live]")).to_be_visible()
        expect(page.locator(".skeleton")).to_have_count(0)
        if view.startswith("audit"):
            page.get_by_role("table", name="Records").locator("tbody tr").first.click()
            expect(page.locator(".record .facts").first).to_be_visible()
        if view == "policy":
            reader.write("bogus")
            expect(page.locator(".finding").first).to_be_visible()
        found[view] = reader.axe()
        reader.fits()
    reader.go("hosts").get_by_role("button", name="Enrol a host").click()
    found["a dialog"] = reader.axe()
    assert {view: rows for view, rows in found.items() if rows} == {}


def test_words_of_the_navigation_have_room(opened: Callable[..., Reader]) -> None:
    reader = opened(width=390)
    page = reader.go("now")
    reader.settle()
    words = """() => [...document.querySelectorAll(".nav a > span:not(.key, .count)")].map((word) => {
      const range = document.createRange();
      range.selectNodeContents(word);
      const { left, right } = range.getBoundingClientRect();
      return [left, right];
    })"""
    edges = [edge for word in page.evaluate(words) for edge in word]
    between = zip([0, *edges[1::2]], [*edges[::2], 390], strict=True)
    assert min(right - left for left, right in between) > 6, edges


def test_the_door_is_accessible(browser: Browser, appliance: Appliance) -> None:
    for theme in ("light", "dark"):
        with Reader(browser, str(appliance.ready["api"]), theme=theme) as reader:
            reader.page.goto(reader.url)
            expect(reader.page.get_by_label("Access token")).to_be_focused()
            assert reader.axe() == []


def test_it_goes_by_keys(opened: Callable[..., Reader]) -> None:
    """The first Tab skips the navigation, digits change views, ? lists the keys, t changes the theme."""
    reader = opened()
    page = reader.go("now")
    page.keyboard.press("Tab")
    skip = page.get_by_role("link", name="Skip to the view")
    expect(skip).to_be_focused()
    page.keyboard.press("Enter")
    expect(page.get_by_role("main")).to_be_focused()
    for key, view in (
        ("2", "Graph"),
        ("3", "Audit"),
        ("4", "Policy"),
        ("5", "Monitors"),
        ("6", "Hosts"),
        ("7", "Recordings"),
        ("1", "Now"),
    ):
        page.keyboard.press(key)
        expect(page.get_by_role("heading", level=1, name=view)).to_be_visible()
        assert page.url.endswith(f"/console/{view.lower()}")
    before = page.evaluate("document.documentElement.dataset.theme")
    page.keyboard.press("t")
    assert page.evaluate("document.documentElement.dataset.theme") != before
    page.keyboard.press("?")
    expect(page.get_by_role("dialog", name="Keys")).to_be_visible()
    page.keyboard.press("Escape")
    expect(page.get_by_role("dialog")).to_have_count(0)
    page.get_by_role("link", name=re.compile("^Audit")).first.focus()
    assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") == "solid"
    page.keyboard.press("Enter")
    row = page.locator("tbody tr a").first
    row.focus()
    page.keyboard.press("Enter")
    expect(page.get_by_role("region", name=re.compile(r"^Record \d"))).to_be_focused()
    page.keyboard.press("Escape")
    expect(row).to_be_focused()


def test_single_keys_can_be_turned_off(opened: Callable[..., Reader]) -> None:
    page = opened().go("audit?decision=deny")
    page.keyboard.press("?")
    switch = page.get_by_role("dialog", name="Keys").get_by_label("Keys without Ctrl or Alt")
    switch.press("Space")
    page.keyboard.press("Escape")
    expect(page.get_by_role("dialog")).to_have_count(0)
    page.reload()
    expect(page.locator("tbody tr").first).to_be_visible()
    for key in ("j", "4", "t", "?"):
        page.keyboard.press(key)
    expect(page.get_by_role("dialog")).to_have_count(0)
    assert page.url.endswith("/console/audit?decision=deny")
    page.get_by_role("table", name="Records").locator("tbody tr a").first.press("Enter")
    record = page.get_by_role("region", name=re.compile(r"^Record \d"))
    expect(record).to_be_focused()
    page.keyboard.press("Escape")
    expect(record).to_have_count(0)
    page.get_by_role("button", name="Keys").press("Enter")
    switch.press("Space")
    page.keyboard.press("Escape")
    page.keyboard.press("4")
    expect(page.get_by_role("heading", level=1, name="Policy")).to_be_visible()
    text = page.get_by_label("Access policy")
    expect(text).to_be_visible()
    page.keyboard.press("i")
    expect(text).to_be_focused()
    page.keyboard.press("5")
    expect(text).to_contain_text("5[Nodes]")


def test_the_theme_is_the_systems_until_the_reader_chooses(opened: Callable[..., Reader]) -> None:
    reader = opened(theme="dark")
    page = reader.go("now")
    assert page.evaluate("document.documentElement.dataset.theme") == "dark"
    page.get_by_role("button", name="Use the light theme").click()
    page.reload()
    assert page.evaluate("document.documentElement.dataset.theme") == "light"
