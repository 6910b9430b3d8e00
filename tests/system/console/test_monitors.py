import threading
from collections.abc import Callable
from typing import Any

import pytest
from playwright.sync_api import Route, expect

from tests.support.appliance import Appliance
from tests.system.console.reader import LIMIT, Reader
from tests.system.console.test_age import HOUR, shifted

SPECIFICATION = """\
counting() {
    int seen = 0;
    event message(string text) /chatter std_msgs/String '{data:text}' {
        seen++;
    }
}
"""


def state(appliance: Appliance, name: str) -> Any:
    rows = appliance.rest().get("/v1/monitors").json["monitors"]
    return next((row for row in rows if row["name"] == name), None)


def test_a_monitor_is_switched(appliance: Appliance, opened: Callable[..., Reader]) -> None:
    reader = opened()
    page = reader.go("monitors")
    switch = page.get_by_role("switch", name="safeZone enabled")
    before = state(appliance, "safeZone")["enabled"]
    expect(switch).to_have_attribute("aria-checked", str(before).lower())
    switch.click()
    expect(switch).to_have_attribute("aria-checked", str(not before).lower())
    assert state(appliance, "safeZone")["enabled"] is not before
    switch.click()
    expect(switch).to_have_attribute("aria-checked", str(before).lower())
    assert state(appliance, "safeZone")["enabled"] is before
    events = [one for one in appliance.recorded("--event", "monitor *abled") if one["resource"] == "safeZone"]
    assert {event["detail"]["who"] for event in events} == {"first"}


@pytest.mark.parametrize("width", [390, 1280, 1920])
def test_a_name_is_broken_between_its_words_only(opened: Callable[..., Reader], width: int) -> None:
    reader = opened(width=width, height=800)
    for view, heading in (("monitors", None), ("monitors/obstacleAvoidance", "obstacleAvoidance")):
        page = reader.go(view, heading=heading)
        expect(page.locator("td .given").first).to_be_visible()
        reader.settle()
        broken = page.eval_on_selector_all(
            "td .given",
            """names => names.filter(name => new Set([...name.getClientRects()].map(one => one.bottom)).size
                                              > (name.innerText.match(/[/_]/g) ?? []).length + 1)
                             .map(name => name.innerText)""",
        )
        assert broken == []
        expect(page.get_by_text("by disk")).to_have_count(0)


def test_two_clicks_at_once_are_both_made(appliance: Appliance, opened: Callable[..., Reader]) -> None:
    page = opened().go("monitors")
    names = ("safeZone", "safeTrigger")
    switches = [page.get_by_role("switch", name=f"{name} enabled") for name in names]
    before = [state(appliance, name)["enabled"] for name in names]
    for switch, on in zip(switches, before, strict=True):
        expect(switch).to_have_attribute("aria-checked", str(on).lower())
    for _ in range(2):
        wanted = [not one for one in before]
        page.evaluate(
            "names => names.forEach(name => document.querySelector(`[aria-label='${name} enabled']`).click())",
            list(names),
        )
        for switch, on in zip(switches, wanted, strict=True):
            expect(switch).to_have_attribute("aria-checked", str(on).lower())
        assert [state(appliance, name)["enabled"] for name in names] == wanted
        before = wanted
    expect(page.get_by_text("Changed by someone else")).to_have_count(0)


def test_a_switch_changed_by_another_user_is_not_overwritten(
    appliance: Appliance, opened: Callable[..., Reader]
) -> None:
    reader = opened()
    deaf = threading.Event()  # the page gets no changes by others, and no answers to its earlier requests

    def tell(route: Route) -> None:
        answer = route.fetch()
        if deaf.is_set():
            route.abort()
        else:
            route.fulfill(response=answer)

    reader.page.route("**/v1/monitors", tell)
    page = reader.go("monitors")
    switch = page.get_by_role("switch", name="safeZone enabled")
    before = state(appliance, "safeZone")["enabled"]
    expect(switch).to_have_attribute("aria-checked", str(before).lower())
    deaf.set()
    appliance.rosrv("monitor", "disable" if before else "enable", "safeZone")
    other = state(appliance, "safeTrigger")["enabled"]
    page.get_by_role("switch", name="safeTrigger enabled").click()
    expect(reader.toast("Changed by someone else")).to_be_visible()
    assert state(appliance, "safeTrigger")["enabled"] is other
    deaf.clear()
    page.reload()
    expect(switch).to_have_attribute("aria-checked", str(not before).lower())
    appliance.rosrv("monitor", "enable" if before else "disable", "safeZone")
    page.unroute_all(behavior="wait")


def test_a_specification_is_loaded_replaced_and_removed(
    appliance: Appliance, opened: Callable[..., Reader]
) -> None:
    reader = opened()
    page = reader.go("monitors")
    page.get_by_role("button", name="Load a specification").click()
    dialog = page.get_by_role("dialog", name="Load a specification")
    dialog.get_by_label("File name").fill("counting.rv")
    reader.write(SPECIFICATION.replace("seen++", "sen++"))
    dialog.get_by_role("button", name="Load", exact=True).click()
    expect(dialog.locator(".finding").first).to_contain_text("4:")
    expect(page.locator(".cm-lint-marker-error")).to_have_count(1)
    assert state(appliance, "counting") is None
    reader.write(SPECIFICATION)
    dialog.get_by_role("button", name="Dry run").click()
    expect(dialog).to_contain_text("It can be loaded")
    dialog.get_by_role("button", name="Load", exact=True).click()
    page.get_by_role("link", name="counting", exact=True).click()
    expect(page.get_by_role("heading", level=1, name="counting")).to_be_visible()
    assert state(appliance, "counting")["topics"] == ["/chatter"]

    reader.write(SPECIFICATION.replace("/chatter", "/gossip"))
    page.get_by_role("button", name="Replace", exact=True).click()
    page.get_by_role("dialog").get_by_role("button", name="Replace").click()
    expect(page.get_by_role("tabpanel")).to_contain_text("/gossip")
    assert state(appliance, "counting")["topics"] == ["/gossip"]

    page.get_by_role("button", name="Remove").click()
    page.get_by_role("dialog").get_by_role("button", name="Remove").click()
    expect(page.get_by_role("heading", level=1, name="Monitors")).to_be_visible()
    expect(page.get_by_role("link", name="counting", exact=True)).to_have_count(0)
    assert state(appliance, "counting") is None


@pytest.mark.parametrize("view", ["policy", "monitors/counting", "monitors"])
def test_a_text_that_is_not_loaded_stays(
    appliance: Appliance, opened: Callable[..., Reader], view: str
) -> None:
    """Over loads of others, another view, and a lock."""
    rest = appliance.rest()

    def load(**files: str) -> None:
        given = {f"{name}.rv": text for name, text in files.items()}
        assert rest.post("/v1/monitors", {"files": given}, match="*").status == 200

    load(counting=SPECIFICATION)
    reader = opened()
    shifted(reader, 0)
    page = reader.go(view, heading="counting" if "/" in view else None)
    new = page.get_by_role("button", name="Load a specification")
    if view == "monitors":
        new.click()
    reader.write("// half an hour of work\n")
    load(other=SPECIFICATION.replace("counting", "other"))
    load(counting=SPECIFICATION.replace("/chatter", "/gossip"))
    policy = rest.get("/v1/policy").json["text"]
    assert rest.post("/v1/policy", f"{policy}\n# {view}\n", match="*").status == 200
    if view == "monitors":
        page.wait_for_timeout(3000)
        expect(reader.editor()).to_contain_text("half an hour of work")
        page.get_by_role("button", name="Not yet").click()
    else:
        expect(page.get_by_text("came into force while you wrote")).to_be_visible()
        expect(reader.editor()).to_contain_text("half an hour of work")
    page.get_by_role("link", name="Now", exact=True).click()
    page.go_back()
    if view == "monitors":
        new.click()
    expect(reader.editor()).to_contain_text("half an hour of work")
    page.evaluate(f"window.shifted = {HOUR}")
    expect(page.get_by_role("dialog", name="Locked")).to_be_visible(timeout=2 * LIMIT)
    page.get_by_label("Access token").fill(str(appliance.ready["token"]))
    page.get_by_role("button", name="Sign in").click()
    expect(page.get_by_role("dialog", name="Locked")).to_have_count(0)
    expect(reader.editor()).to_contain_text("half an hour of work")
    for name in ("counting", "other"):
        appliance.rosrv("monitor", "remove", name)
