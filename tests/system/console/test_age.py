"""Ages and times that are left: under a browser's clock that differs, without news, and after a computer has slept."""

import contextlib
import math
import os
import re
import signal
import time
from collections.abc import Callable
from typing import Any

import pytest
from playwright.sync_api import Page, Route, expect

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


_STANDBY = {
    "role": "standby", "name": "b", "address": "10.0.0.2", "since": "2026-01-02T03:04:05Z", "epoch": 2,
    "fixed": "10.0.0.9", "obstacle": "", "troubles": [], "not_serving": "", "answers_alone": False,
    "other": {"name": "a", "address": "10.0.0.1", "connected": True},
    "witness": {"address": "10.0.0.3", "answered_seconds": 1.0, "holder": "a", "refusal": "", "trouble": ""},
}  # fmt: skip


def _group(holder: str) -> dict[str, Any]:
    group = {"group": "base", "names": ["/cmd_vel"], "holder": holder, "held_seconds": 1.0, "lease": 5.0}
    return group | {"left_seconds": 5.0, "waiting": [], "ranks": [], "not_carried": []}


def _kept(page: Page, path: str) -> list[Route]:
    routes: list[Route] = []

    def keep(route: Route) -> None:
        routes.append(route)

    page.route(path, keep)
    return routes


def _held(page: Page, routes: list[Route], number: int) -> Route:
    """Wait for a request that the test answers; the waiting is the page's, so that it goes on."""
    until = time.monotonic() + LIMIT / 1000
    while len(routes) < number and time.monotonic() < until:
        page.wait_for_timeout(50)
    return routes[number - 1]


def test_a_slow_answer_is_shown(opened: Callable[..., Reader]) -> None:
    """Each answer takes longer than the pause between two requests."""
    reader = opened()
    routes = _kept(reader.page, "**/v1/drive")
    page = reader.go("now")
    for number in range(1, 4):
        route = _held(page, routes, number)
        page.wait_for_timeout(3000)
        assert len(routes) == number, "no further request while one runs"
        route.fulfill(json={"groups": [_group(f"10.0.0.{number}")]})
        expect(page.get_by_role("link", name=re.compile("^Drives"))).to_contain_text(f"10.0.0.{number}")


def test_a_value_that_no_answer_confirms_has_its_age(opened: Callable[..., Reader]) -> None:
    reader = opened()
    routes = _kept(reader.page, "**/v1/drive")
    page = reader.go("now")
    drives = page.get_by_role("link", name=re.compile("^Drives"))
    _held(page, routes, 1).fulfill(json={"groups": [_group("10.0.0.1")]})
    expect(drives).to_have_text(re.compile(r"^Drives[^,]*10\.0\.0\.1"))
    _held(page, routes, 2)
    expect(drives).to_have_text(re.compile(r"^Drives, \d+ s ago.*10\.0\.0\.1"))


@pytest.mark.parametrize(
    ("view", "path", "answer"),
    [
        ("robot", "drive", {"groups": [_group("10.0.0.1")]}),
        ("robot", "doors", {"doors": []}),
        ("robot", "door", {"door": {"name": "d", "node": "/d", "address": "10.0.0.1", "trouble": "starts"}}),
        ("hosts", "hosts", None),
        ("standby", "standby", _STANDBY),
    ],
)
def test_a_request_that_fails_later_is_seen(
    opened: Callable[..., Reader], view: str, path: str, answer: dict[str, Any] | None
) -> None:
    reader = opened()
    page = reader.page
    answers = 1 if answer else math.inf  # a complete page has asked more than once

    def answer_some(route: Route) -> None:
        nonlocal answers
        answers -= 1
        if answers < 0:
            route.abort()
        elif answer is None:
            route.continue_()
        else:
            route.fulfill(json=answer)

    page.route(f"**/v1/{path}", answer_some)
    if view == "standby":
        passive = {"type": "urn:rosrv:problem:standby", "title": "Standby", "active": "10.0.0.1"}
        page.route("**/v1/live*", lambda route: route.fulfill(status=503, json=passive))
        reader.page.goto(f"{reader.url}/console/now")
    else:
        reader.go(view)
    if answer is None:
        again = page.get_by_role("button", name="Reload hosts.yaml")
        expect(again).to_be_visible()
        answers = 0
        again.click()
    expect(page.get_by_text(re.compile(r"What is shown is of \d+ s ago"))).to_be_visible()


_CALL = {
    "state": "waits", "host": "10.0.0.7", "caller_id": "/agent", "category": "publish", "resource": "/goal",
    "type": "", "sha256": "", "arguments": "", "size": 0, "left_seconds": 90.0, "who": "", "number": 17,
}  # fmt: skip
_FENCE = {
    "preset": "fence", "name": "fence", "topics": {"command": "/cmd_vel", "by": "/odom"}, "shadow": True,
    "types": {"command": "geometry_msgs/Twist", "by": "nav_msgs/Odometry"}, "values": {},
}  # fmt: skip


@pytest.mark.parametrize("hangs", [False, True])
@pytest.mark.parametrize(
    ("view", "path"),
    [
        ("now", "guards"),
        ("robot", "guards"),
        ("robot", "approvals"),
        ("monitors", "monitors"),
        ("robot", "monitors/fence/values"),
    ],
)
def test_a_value_that_follows_the_state_has_its_age_until_it_is_heard_again(
    appliance: Appliance, opened: Callable[..., Reader], view: str, path: str, hangs: bool
) -> None:
    """One request fails, or has no answer, just when something has changed, and nothing changes later."""
    rest = appliance.rest()
    rest.post("/v1/guards", _FENCE, match="*")
    reader = opened()
    page = reader.page
    asked: list[Route] = []
    failing = False

    def answer(route: Route) -> None:
        asked.append(route)
        if failing and not hangs:
            route.abort()
        elif path == "approvals" and not failing:
            route.fulfill(json={"approvals": [_CALL]})
        elif not failing:
            route.continue_()

    page.route(f"**/v1/{path}*", answer)
    reader.go(view)
    _held(page, asked, 1)
    reader.settle()
    failing, before = True, len(asked)
    if path in ("guards", "monitors"):
        row = next(row for row in rest.get("/v1/monitors").json["monitors"] if row["name"] == "safeTrigger")
        appliance.rosrv("monitor", "disable" if row["enabled"] else "enable", "safeTrigger")
    age = page.get_by_text(
        re.compile(r"(What is shown is of|^Stops,|The appliance last answered) \d+ s ago")
    ).locator("visible=true")
    expect(age.first).to_be_visible()
    _held(page, asked, before + 2)
    failing = False
    expect(age).to_have_count(0)
    page.unroute_all(behavior="ignoreErrors")


def test_waiting_calls_that_no_answer_confirms_are_an_error(opened: Callable[..., Reader]) -> None:
    """They are asked for again with the next state."""
    reader = opened()
    routes = _kept(reader.page, "**/v1/approvals")
    page = reader.go("robot")
    _held(page, routes, 1)
    expect(page.get_by_text("No answer in 8 s.")).to_be_visible(timeout=LIMIT + 8000)
    _held(page, routes, 2).fulfill(json={"approvals": []})
    expect(page.get_by_text("no call waits")).to_be_visible()


_BELL = """
window.rings = 0;
localStorage.setItem("rosrv.approval-sound", "on");
const gain = { setValueAtTime() {}, exponentialRampToValueAtTime() {} };
const part = () => ({ frequency: {}, gain, connect: (to) => to, start() {}, stop() {} });
window.AudioContext = class {
  state = "running"; currentTime = 0; createGain = part;
  createOscillator() { window.rings += 1 / 2; return part(); }  // it has two tones
};
"""


def test_a_bell_rings_for_each_call_that_begins_to_wait(opened: Callable[..., Reader]) -> None:
    """Not when another one was answered; also for one with a lower number, which a repeated call keeps."""
    reader = opened()
    page = reader.page
    reader.context.add_init_script(_BELL)
    waiting: list[int] = []
    page.route(
        "**/v1/approvals",
        lambda route: route.fulfill(json={"approvals": [_CALL | {"number": one} for one in waiting]}),
    )
    for now, rings in (([17, 18], 1), ([17], 1), ([17, 18], 2), ([16, 17], 3), ([16], 3)):
        waiting[:] = now
        page = page if "/console/" in page.url else reader.go("now")
        shown = page.locator(".waiting-call:not(.ended)")
        for number in now:
            expect(shown.and_(page.locator(f"[data-approval='{number}']"))).to_have_count(1)
        expect(shown).to_have_count(len(now))
        assert page.evaluate("window.rings") == rings, now
