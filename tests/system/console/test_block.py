import re
from collections.abc import Callable
from typing import Any

from playwright.sync_api import expect

from tests.support.appliance import Appliance
from tests.system.console.reader import Reader

HOST = "192.0.2.66"


def test_a_denied_host_can_be_blocked_from_its_record(
    appliance: Appliance,
    opened: Callable[..., Reader],
    attempt: Callable[..., Any],
    token: Callable[..., str],
) -> None:
    assert attempt("registerPublisher", "/wheel", "/free", "std_msgs/String", "http://127.0.0.1:1/")[0] == 1
    attempt("registerPublisher", "/wheel", "/guarded", "std_msgs/String", "http://127.0.0.1:1/")
    [record, *_] = appliance.recorded("--deny", caller_id="/wheel", resource="/guarded")
    page = opened(token("viewer")).go(f"audit/{record['id']}")
    expect(page.get_by_role("button", name="Block this host")).to_have_attribute("aria-disabled", "true")
    reader = opened(token("operator"))
    page = reader.go(f"audit/{record['id']}")
    page.get_by_role("button", name="Block this host").press("Enter")
    dialog = page.get_by_role("dialog", name="Block this host?")
    expect(dialog.get_by_label("Address")).to_have_value("127.0.0.1")
    expect(dialog.get_by_label("For", exact=True)).to_have_value("3600")
    expect(dialog).to_contain_text("Would end: 1 publication of 1 node")
    assert reader.axe() == []
    dialog.get_by_role("button", name="Block the host").press("Enter")
    expect(dialog.get_by_role("alert")).to_contain_text("127.0.0.1")
    assert appliance.rest().get("/v1/blocks").json == {"blocks": []}


def test_a_blocked_host_is_listed_until_it_is_unblocked(
    appliance: Appliance, opened: Callable[..., Reader]
) -> None:
    reader = opened()
    page = reader.go("hosts")
    page.get_by_role("button", name="Block a host").press("Enter")
    dialog = page.get_by_role("dialog", name="Block this host?")
    dialog.get_by_label("Address").fill(HOST)
    dialog.get_by_label("Note").fill("tablet lost")
    expect(dialog).to_contain_text("No node of this host is registered now")
    dialog.get_by_role("button", name="Block the host").press("Enter")
    expect(reader.toast(f"{HOST} is blocked")).to_be_visible()
    blocked = page.get_by_role("region", name="Blocked hosts")
    expect(blocked.get_by_role("row", name=HOST)).to_contain_text("tablet lost")
    [block] = appliance.rest().get("/v1/blocks").json["blocks"]
    page.get_by_role("button", name="Block a host").press("Enter")
    dialog.get_by_label("Address").fill(HOST)
    dialog.get_by_label("For", exact=True).select_option("900")
    dialog.get_by_role("button", name="Block the host").press("Enter")
    expect(dialog).to_have_count(0)
    reader.toast(f"{HOST} is blocked").last.locator(
        "xpath=ancestor::*[contains(@class, 'notice-body')]"
    ).get_by_role("button", name="Undo").click()
    expect(reader.toast("has its earlier block")).to_be_visible()
    [restored] = appliance.rest().get("/v1/blocks").json["blocks"]
    assert (restored["note"], round(restored["until"] - block["until"])) == ("tablet lost", 0)
    block = restored | {"until": block["until"], "since": block["since"]}
    assert (block["address"], round(block["until"] - block["since"])) == (HOST, 3600)
    assert reader.axe() == []
    page.keyboard.press("1")
    card = page.get_by_role("region", name="Health").get_by_role("link").first
    expect(card).not_to_contain_text("warnings")
    page.get_by_role("region", name="Open alarms").get_by_role("link", name="1 host is blocked").press(
        "Enter"
    )
    expect(page).to_have_url(re.compile("/console/hosts"))
    blocked.get_by_role("button", name="Unblock").press("Enter")
    expect(reader.toast(f"{HOST} is no longer blocked")).to_be_visible()
    expect(blocked).to_have_count(0)
    assert appliance.rest().get("/v1/blocks").json == {"blocks": []}


def test_undo_leaves_the_block_of_another_operator(
    appliance: Appliance, opened: Callable[..., Reader]
) -> None:
    reader = opened()
    page = reader.go("hosts")
    page.get_by_role("button", name="Block a host").press("Enter")
    dialog = page.get_by_role("dialog", name="Block this host?")
    dialog.get_by_label("Address").fill(HOST)
    dialog.get_by_role("button", name="Block the host").press("Enter")
    undo = page.locator(".toasts").get_by_role("button", name="Undo")
    expect(undo).to_be_visible()
    rest = appliance.rest()
    longer = rest.post("/v1/blocks", {"address": HOST, "for_seconds": 86_400, "note": "mine"}, match="*")
    assert longer.status == 200, longer.body
    undo.click()
    expect(page.locator(".toasts")).to_contain_text("that block stays")
    [block] = rest.get("/v1/blocks").json["blocks"]
    assert block["note"] == "mine"
    assert rest.request("DELETE", f"/v1/blocks/{HOST}", None, {"If-Match": "*"}).status == 200
