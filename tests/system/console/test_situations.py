"""Situations that need a person are seen on Now without scrolling, wide and on a telephone. Each one is real."""

import contextlib
import http.client
import os
import re
import urllib.parse
import xmlrpc.client
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Locator, Page, expect

from tests.support.appliance import Appliance
from tests.support.nodes import RosSession
from tests.support.small_disk import filled, small_disk
from tests.support.waiting import eventually
from tests.system.console.conftest import CONFIG
from tests.system.console.reader import Reader

AGENT, TABLET = "127.0.0.15", "127.0.0.14"
POLICY = f"""\
[Groups]
tablet = {TABLET}
agent = {AGENT}
[Nodes]
default = *
[Publishers]
default = *
/goal = 127.0.0.1 ask agent
/arm = 127.0.0.1 ask agent
/wheel = 127.0.0.1 ask agent
/third = 127.0.0.1 ask agent
/guarded = 10.9.9.9
[Subscribers]
default = *
[Commands]
default = *
[Authority]
base = /cmd_vel
take base = 127.0.0.1 tablet
lease base = 600s
"""
QUIET = {
    "Drives": "no host drives base",
    "Stops": "nothing: 1 guard on watch",
    "Waits": "no call waits",
    "Denied": "nothing in the last day",
}
SIZES = ((1440, 900), (390, 844))
VIEWS = ("graph", "audit", "policy", "monitors", "hosts", "recordings", "robot", "now")
_PLACES = """() => [...document.querySelectorAll(".waiting-call")].map((call) =>
  [call.dataset.approval, Math.round(call.getBoundingClientRect().top)])"""


@pytest.fixture(scope="module")
def appliance() -> Iterator[Appliance]:
    # Beside other tests, the guard's ticks come late: true, but not what these tests look at.
    running = Appliance(policy=POLICY, settings=f"{CONFIG}relay: {{late: 100}}\n", monitors={})
    try:
        with small_disk(running.state, "200m", "mode=755"):
            running.start()
            types = ("--type", "command=geometry_msgs/Twist")
            running.rosrv("guard", "new", "deadman", "/cmd_vel", *types)
            yield running
            running.stop()
    finally:
        running.close()


@pytest.fixture
def windows(opened: Callable[..., Reader]) -> list[Reader]:
    return [opened(width=width, height=height) for width, height in SIZES]


def advertise(
    appliance: Appliance, address: str, topic: str, *, node: str = "/agent", kind: str = "std_msgs/String"
) -> str:
    """Register a publisher from an address of the loopback; return the answer."""
    call = (node, topic, kind, f"http://{address}:40404/")
    place = str(urllib.parse.urlsplit(appliance.master_uri).netloc)
    with contextlib.closing(http.client.HTTPConnection(place, source_address=(address, 0))) as connection:
        connection.request(
            "POST", "/", xmlrpc.client.dumps(call, "registerPublisher"), {"Content-Type": "text/xml"}
        )
        return connection.getresponse().read().decode()


def approvals(appliance: Appliance, state: str) -> list[dict[str, Any]]:
    rows = appliance.rest().get("/v1/approvals").json["approvals"]
    return [row for row in rows if row["state"] == state]


def fact(page: Page, name: str) -> Locator:
    return page.get_by_role("region", name="Situation").get_by_role("link", name=re.compile(f"^{name}"))


def alarms(page: Page) -> Locator:
    return page.get_by_role("region", name="Open alarms").get_by_role("listitem")


def bar(page: Page) -> Locator:
    return page.get_by_role("region", name="Calls that wait for you")


def see(windows: list[Reader], place: Callable[[Page], Locator], text: str | re.Pattern[str]) -> None:
    for reader in windows:
        page = reader.page if "/console/now" in reader.page.url else reader.go("now")
        reader.sees(place(page), text)
        reader.keep_picture(os.environ["PYTEST_CURRENT_TEST"].rpartition("::test_")[2].partition(" ")[0])


def test_a_quiet_robot_says_so(windows: list[Reader]) -> None:
    for name, text in QUIET.items():
        see(windows, lambda page, name=name: fact(page, name), text)  # type: ignore[misc]  # a lambda in a loop
    see(windows, lambda page: page.get_by_role("region", name="Open alarms"), "No open alarms")
    for reader in windows:
        expect(bar(reader.page)).to_have_count(0)
        expect(reader.page.get_by_role("row", name="supervisor")).to_be_hidden()


def test_a_denied_call(appliance: Appliance, windows: list[Reader]) -> None:
    assert "not among the hosts" in advertise(appliance, TABLET, "/guarded")
    see(windows, lambda page: fact(page, "Denied"), re.compile(r"tablet.*publish /guarded, .* ago"))


def test_the_holder_and_a_hand_over(appliance: Appliance, windows: list[Reader]) -> None:
    appliance.rosrv("drive", "assign", "base", "--host", TABLET)
    see(windows, lambda page: fact(page, "Drives"), re.compile(r"tablet.*drives base for .* s"))
    appliance.rosrv("drive", "ask", "base", "--host", "127.0.0.1")
    see(windows, lambda page: fact(page, "Drives"), re.compile(r"tablet.*waits.*127\.0\.0\.1"))
    appliance.rosrv("drive", "free", "base", "--to", "127.0.0.1")
    see(windows, lambda page: fact(page, "Drives"), re.compile(r"127\.0\.0\.1.*drives base"))


def test_a_guards_stop(appliance: Appliance, windows: list[Reader], tmp_path: Path) -> None:
    appliance.rosrv("drive", "assign", "base", "--host", "127.0.0.1")
    with RosSession(appliance.master_uri, tmp_path) as ros:
        base = ros.start(["rostopic", "echo", "-p", "/cmd_vel"])
        driver = ros.start(
            ["rostopic", "pub", "-r", "20", "/cmd_vel", "geometry_msgs/Twist", "{linear: {x: 0.3}}"]
        )
        eventually(lambda: any(",0.3," in str(event.get("text")) for event in base.events), "it drives")
        driver.kill()
        see(windows, lambda page: fact(page, "Stops"), re.compile(r"deadman stop(s|ped) /cmd_vel.* \d+ s"))
        see(windows, lambda page: fact(page, "Stops"), re.compile(r"held by deadman since \d+:\d+.*127"))
        for reader in windows:
            expect(fact(reader.page, "Stops")).not_to_have_class(re.compile("deny"))
            page = reader.go("robot")
            expect(page.locator("[data-guard=deadman]")).to_contain_text("held by deadman since")
            expect(page.locator(".badge.deny, .fact.deny")).to_have_count(0)


def test_a_waiting_call_is_decided_by_one_click_on_any_page(
    appliance: Appliance, windows: list[Reader], opened: Callable[..., Reader], token: Callable[..., str]
) -> None:
    views = iter(VIEWS)
    for reader in windows * 4:
        page = reader.go(next(views))
        expect(page.locator("[data-standing=live]")).to_be_visible()
        assert "held for approval" in advertise(appliance, AGENT, "/goal")
        button = bar(page).get_by_role("button", name="For 30 s")
        reader.sees(bar(page).locator(".waiting-call"), re.compile("agent.*publish /goal.*left"))
        reader.sees(button, "For 30 s")
        reader.fits()
        reader.keep_picture(f"a_waiting_call_on_{page.url.rpartition('/')[2]}")
        assert page.title().startswith("1 call waits")
        assert "icon-calls" in str(page.locator("link[rel=icon]").get_attribute("href"))
        button.click()
        expect(bar(page)).to_contain_text("approved by first")
        [row] = approvals(appliance, "lease")
        assert (row["host"], row["resource"]) == (AGENT, "/goal")
        appliance.rosrv("approval", "refuse", str(row["number"]))
        appliance.recorded("--event", "approval ended", resource="/goal")
        page.mouse.move(5, 5)
        expect(bar(page)).to_have_count(0)
        assert "call waits" not in page.title()
    advertise(appliance, TABLET, "/guarded")
    viewed = opened(token("viewer"), width=390).go("now")
    advertise(appliance, AGENT, "/arm")
    expect(bar(viewed).get_by_role("button", name="Refuse")).to_have_attribute(
        "title", re.compile("For the role operator")
    )
    assert windows[1].axe() == []
    see(windows, lambda page: fact(page, "Waits"), "1 call waits for you")
    see(windows, lambda page: fact(page, "Denied"), re.compile("tablet.*publish /guarded"))
    [row] = approvals(appliance, "waits")
    appliance.rosrv("approval", "refuse", str(row["number"]))


def test_the_bar_does_not_move_under_the_pointer(appliance: Appliance, windows: list[Reader]) -> None:
    page = windows[0].go("robot")
    expect(page.locator("[data-standing=live]")).to_be_visible()
    scrolled = page.evaluate("[document.querySelector('h1').getBoundingClientRect().top]")
    advertise(appliance, AGENT, "/wheel")
    first = bar(page).locator(".waiting-call").first
    first.hover()
    [[number, top]] = page.evaluate(_PLACES)
    assert page.evaluate("[document.querySelector('h1').getBoundingClientRect().top]") == scrolled
    advertise(appliance, AGENT, "/third")
    expect(bar(page).locator(".waiting-call")).to_have_count(2)
    assert [number, top] in page.evaluate(_PLACES), "a newer call comes above it"
    appliance.rosrv("approval", "refuse", number)
    expect(bar(page)).to_contain_text("refused by")
    page.wait_for_timeout(4000)
    assert [number, top] in page.evaluate(_PLACES), "an ended call stays while the pointer is there"
    page.mouse.move(600, 100)
    expect(bar(page).locator(".waiting-call")).to_have_count(1)
    [row] = approvals(appliance, "waits")
    appliance.rosrv("approval", "refuse", str(row["number"]))


SLOTS = """async () => {
  const { placed, pruned } = await import("/console/static/features/approvals/slots.js");
  const call = (number, state = "waits") => ({ number, state, left_seconds: 100, who: "ann" });
  const awake = (slots, now) => slots.map((slot) => [slot.number, slot.awake <= now]);
  const found = [];
  let slots = placed([], [call(1), call(2)], 0, 0);
  found.push(awake(slots, 499), awake(slots, 500));
  slots = placed(slots, [call(1, "refused"), call(2), call(3)], 600, 600);
  found.push(slots.map((slot) => [slot.number, slot.ended]));
  const later = pruned(slots, 5000, false);
  found.push(awake(pruned(slots, 5000, true), 1200), awake(later, 5000), awake(later, 5500));
  found.push(awake(placed(slots, [call(1)], 700, 700), 1199)[0]);
  const ending = (number, left_seconds) => ({ ...call(number), left_seconds });
  const order = (slots) => slots.map((slot) => slot.number);
  let many = placed([], [ending(1, 90), ending(2, 30), ending(3, 60)], 0, 0);
  found.push(order(many));
  many = placed(many, [ending(1, 89), ending(2, 120), ending(3, 59)], 1000, 1000); // 2 was repeated
  found.push(order(pruned(many, 2000, true)));
  many = pruned(many, 2000, false);
  found.push(order(many), awake(many, 2499), awake(many, 2500));
  return found;
}"""


def test_buttons_wake_half_a_second_after_they_appear_or_move(windows: list[Reader]) -> None:
    page = windows[0].go("now")
    assert page.evaluate(SLOTS) == [
        [[1, False], [2, False]],
        [[1, True], [2, True]],
        [[1, "refused by ann"], [2, ""], [3, ""]],
        [[1, True], [2, True], [3, True]],  # in use: nothing moves
        [[2, False], [3, False]],
        [[2, True], [3, True]],
        [1, False],  # it waits again, with its number
        [2, 3, 1],  # the first to end is the first
        [2, 3, 1],  # in use: nothing moves
        [3, 1, 2],  # a repeated call does not hide those that end earlier
        [[3, False], [1, False], [2, False]],
        [[3, True], [1, True], [2, True]],
    ]


MOVED_UNDER_A_CLICK = """() => {
  document.querySelector("h1").style.marginBottom = "90px";
  document.querySelector("tr[data-approval] button").click();
}"""


def test_the_buttons_of_the_table_sleep_after_it_moves(appliance: Appliance, windows: list[Reader]) -> None:
    """A click at the moment at which something above the table grows decides nothing."""
    page = windows[0].go("robot")
    advertise(appliance, AGENT, "/goal")
    button = page.locator("tr[data-approval] button").first
    expect(button).to_have_text("For 30 s")
    expect(button).not_to_have_attribute("aria-disabled", "true")
    page.evaluate(MOVED_UNDER_A_CLICK)
    expect(button).to_have_attribute("aria-disabled", "true")
    assert approvals(appliance, "lease") == []
    expect(button).not_to_have_attribute("aria-disabled", "true")
    button.click()
    expect(windows[0].toast("approved")).to_be_visible()
    [row] = approvals(appliance, "lease")
    appliance.rosrv("approval", "refuse", str(row["number"]))


def test_the_sound_is_off_until_it_is_switched_on_in_this_browser(windows: list[Reader]) -> None:
    page = windows[0].go("robot")
    switch = page.get_by_role("region", name="Approvals").get_by_label("Sound for a new call")
    expect(switch).not_to_be_checked()
    switch.check()
    page.reload()
    expect(switch).to_be_checked()
    switch.uncheck()


def test_a_blocked_host(appliance: Appliance, windows: list[Reader]) -> None:
    appliance.rosrv("host", "block", "192.0.2.66")
    see(windows, alarms, "1 host is blocked")
    appliance.rosrv("host", "unblock", "192.0.2.66")
    expect(alarms(windows[0].page).filter(has_text="is blocked")).to_have_count(0)


def test_a_bad_policy(appliance: Appliance, windows: list[Reader]) -> None:
    appliance.policy_file.write_text("[Nodes]\ndefault = *\n[Nonsense]\n")
    assert appliance.rosrv("policy", "reload", check=False).returncode != 0
    see(windows, alarms, re.compile("stays in force, .* is rejected"))
    appliance.reload(POLICY)
    expect(alarms(windows[0].page).filter(has_text="is refused")).to_have_count(0)


def test_a_full_disk(appliance: Appliance, windows: list[Reader]) -> None:
    with ExitStack() as stack:
        stack.enter_context(filled(appliance.state))
        see(windows, alarms, re.compile("disk|space|audit log"))
