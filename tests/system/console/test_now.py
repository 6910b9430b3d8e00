import json
import re
from collections.abc import Callable
from typing import Any

import pytest
from playwright.sync_api import expect

from appliance.base.actors import DISK, UNCONFIRMED, actor
from tests.support.appliance import Appliance
from tests.system.console.reader import LIMIT, Reader


def test_a_refusal_is_seen_live(opened: Callable[..., Reader], attempt: Callable[..., Any]) -> None:
    reader = opened()
    page = reader.go("now")
    refused = page.get_by_role("region", name="Recently denied")
    expect(refused).to_contain_text("Nothing was denied")
    assert (
        attempt("registerPublisher", "/intruder", "/guarded", "std_msgs/String", "http://127.0.0.1:1/")[0]
        != 1
    )
    expect(refused.get_by_role("listitem").first).to_contain_text("/intruder")
    expect(refused.get_by_role("listitem").first).to_contain_text("/guarded")
    refused.get_by_role("link", name=re.compile("not among the hosts")).first.click()
    expect(page.get_by_role("region", name=re.compile(r"^Record \d"))).to_contain_text(
        "[Publishers] /guarded"
    )


def test_health_says_what_the_appliance_says(appliance: Appliance, opened: Callable[..., Reader]) -> None:
    page = opened().go("now")
    expect(page.get_by_role("region", name="Health")).to_contain_text("In service")
    expect(page.get_by_role("region", name="Health")).to_contain_text("Revision 1")
    status = appliance.status()
    page.get_by_role("heading", name="Processes").click()
    for process in status["processes"]:
        if process["role"] == "compiler":
            continue  # ends when it is idle
        row = page.get_by_role("region", name="Processes").get_by_role("row", name=process["role"])
        expect(row).to_contain_text(str(process["pid"]))


def test_several_relays_are_numbered(opened: Callable[..., Reader]) -> None:
    page = opened().go("now")
    named = """async (processes) => {
      const { numbered } = await import("/console/static/js/now/view.js");
      return numbered(processes).map((one) => one.name);
    }"""
    rows = [{"role": role} for role in ("control", "relay", "api", "relay")]
    assert page.evaluate(named, rows) == ["control", "relay 0", "api", "relay 1"]


def test_rates_are_of_more_than_a_moment(opened: Callable[..., Reader]) -> None:
    page = opened().go("now")
    growth = """async (samples) => {
      const { growth } = await import("/console/static/js/numbers.js");
      return growth(samples, (one) => one.count).map((one) => one.value);
    }"""
    samples = [{"time": 100 + tick / 5, "count": 50 * (tick // 5)} for tick in range(101)]
    rates = page.evaluate(growth, samples)
    assert len(rates) > 40
    assert all(45 < rate < 55 for rate in rates), rates
    assert page.evaluate(growth, [*samples, {"time": 122, "count": 0}])[-1] is None


def test_times_in_alarms_are_the_readers(opened: Callable[..., Reader]) -> None:
    page = opened().go("now")
    shown = """async (text) => {
      const { inOwnZone } = await import("/console/static/js/moments.js");
      return [inOwnZone(text), new Date("2020-02-03T04:05:06Z").getHours()];
    }"""
    found, hour = page.evaluate(shown, "12 hosts, until 2020-02-03T04:05:06+00:00: rosrv host blocks")
    assert re.fullmatch(rf"12 hosts, until Feb 3, {hour:02}:05:06: rosrv host blocks", found), found


def test_many_denials_turn_the_state_to_a_warning(
    appliance: Appliance, opened: Callable[..., Reader], attempt: Callable[..., Any]
) -> None:
    page = opened().go("now")
    for number in range(12):
        attempt(
            "registerPublisher", f"/intruder{number}", "/guarded", "std_msgs/String", "http://127.0.0.1:1/"
        )
    card = page.get_by_role("region", name="Health").get_by_role("link").first
    expect(card).to_contain_text("In service, with warnings")
    expect(card).to_contain_text(re.compile(r"\d+ denials in the last minute"))
    [attention] = appliance.status()["attention"]
    assert re.fullmatch(
        r"\d+ denials in the last minute \(.+ was denied .+ times\); rosrv audit summary --since 1m",
        attention,
    )
    card.click()
    expect(page).to_have_url(re.compile("/console/audit.*decision=deny"))


def test_the_page_says_that_it_is_not_live_and_comes_back(
    appliance: Appliance, opened: Callable[..., Reader]
) -> None:
    reader = opened()
    page = reader.go("now")
    expect(page.locator("[data-standing=live]")).to_be_visible()
    page.route("**/v1/live*", lambda route: route.abort())  # the banner stays until it was seen
    appliance.kill("api")
    expect(page.locator(".banner").get_by_text("Not live")).to_be_visible()
    page.unroute("**/v1/live*")
    expect(page.locator("[data-standing=live]")).to_be_visible(timeout=2 * LIMIT)
    expect(page.locator(".banner").get_by_text("Not live")).to_have_count(0)


def test_an_alarm_is_open_until_its_cause_is_gone(
    appliance: Appliance, opened: Callable[..., Reader]
) -> None:
    page = opened().go("now")
    alarms = page.get_by_role("region", name="Open alarms")
    expect(alarms).not_to_contain_text("unless confirmed")
    rest = appliance.rest()
    current = rest.get("/v1/policy")
    loaded = rest.post(
        "/v1/policy?confirm_within=600", current.json["text"] + "\n# later\n", match=current.etag
    )
    assert loaded.status == 200, loaded.body
    expect(alarms).to_contain_text(" unless confirmed")
    assert rest.post("/v1/policy/confirm", match=loaded.etag).status == 200
    expect(alarms).not_to_contain_text("unless confirmed")


def test_changes_of_the_appliance_are_not_shown_as_those_of_a_person(opened: Callable[..., Reader]) -> None:
    page = opened().go("now")
    shown = """async (authors) => {
      const { actor } = await import("/console/static/js/parts/given.js");
      return authors.map(actor);
    }"""
    authors = ["alice", DISK, UNCONFIRMED, "disk2"]
    assert page.evaluate(shown, authors) == [actor(who) for who in authors]
    assert page.evaluate(shown, [DISK, None]) == ["the appliance (disk)", None]


def test_the_denials_of_the_last_hour_are_counted_again_without_a_new_one(
    opened: Callable[..., Reader], attempt: Callable[..., Any]
) -> None:
    attempt("registerPublisher", "/intruder", "/guarded", "std_msgs/String", "http://127.0.0.1:1/")
    reader = opened()
    reader.context.add_init_script(
        "const real = setTimeout;"
        "setTimeout = (run, wait, ...more) => real(run, wait === 300000 ? 1000 : wait, ...more);"
    )
    page = reader.go("now")
    table = page.get_by_role("table", name="Denials by host")
    expect(table).to_be_visible()
    page.route("**/v1/audit/summary*", lambda route: route.fulfill(json={"hosts": []}))
    expect(table).to_have_count(0)


def test_each_refusal_has_its_own_heading(opened: Callable[..., Reader]) -> None:
    headings = """async (kinds) => {
      const { headline, Problem } = await import("/console/static/js/problem.js");
      return kinds.map((kind) => headline(new Problem(403, { type: `urn:rosrv:problem:${kind}`, title: kind })));
    }"""
    kinds = ["not-for-this-role", "host-blocked", "foreign-origin"]
    assert opened().go("now").evaluate(headings, kinds) == ["Not for this role", *kinds[1:]]


_PAIR = {
    "role": "active", "name": "a", "address": "10.0.0.1", "since": "2026-01-02T03:04:05Z", "epoch": 2,
    "fixed": "10.0.0.9", "obstacle": "", "troubles": [], "not_serving": "", "answers_alone": False,
    "other": {
        "name": "b", "address": "10.0.0.2", "connected": True, "in_sync": True, "trouble_seconds": None,
        "reason": "", "behind_changes": 0, "behind_bytes": 0,
    },
    "witness": {"address": "10.0.0.3", "answered_seconds": 1.0, "holder": "a", "refusal": "", "trouble": ""},
}  # fmt: skip
_NO_KEYS = """
const real = crypto.subtle.importKey.bind(crypto.subtle);
crypto.subtle.importKey = (form, key, kind, ...more) =>
  kind === "Ed25519" ? Promise.reject(new DOMException("no", "NotSupportedError")) : real(form, key, kind, ...more);
"""


@pytest.mark.parametrize(
    ("path", "status"),
    [("challenge", 0), ("challenge", 503), ("challenge", 429), ("keys", 0)]
    + [("standby/switch", status) for status in (0, 403, 409, 429, 503)],
)
def test_an_order_without_an_answer_is_not_reported_as_given(
    appliance: Appliance, opened: Callable[..., Reader], path: str, status: int
) -> None:
    reader = opened()
    page = reader.page
    now = json.loads(
        next(event["data"] for event in appliance.rest().events("/v1/live") if event.get("event") == "now")
    )
    now["status"]["standby"] = _PAIR
    state = f"event: now\ndata: {json.dumps(now)}\n\n"
    page.route(
        "**/v1/live*", lambda route: route.fulfill(body=state, headers={"content-type": "text/event-stream"})
    )
    if path == "keys":
        reader.context.add_init_script(_NO_KEYS)
    reader.go("now")
    page.route(
        f"**/v1/{path}",
        lambda route: (
            route.fulfill(status=status, headers={"retry-after": "1"}, json={"detail": "refused"})
            if status
            else route.abort()
        ),
    )
    page.get_by_role("button", name="Switch over…").click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_role("button", name="Switch over", exact=True).click()
    expect(dialog.get_by_role("alert")).to_be_visible()
    unknown = dialog.get_by_text("The order may have taken effect")
    expect(unknown).to_have_count(int((path, status) == ("standby/switch", 0)))
    expect(page.locator(".toasts .notice")).to_have_count(0)


@pytest.mark.parametrize(
    "path",
    ["stream?", "?.*decision=", "?.*category=", "?.*severity=alarm"],
    ids=lambda one: one.strip("?.*="),
)
def test_records_that_do_not_come_are_not_taken_for_none(
    appliance: Appliance, opened: Callable[..., Reader], path: str
) -> None:
    """The stream and each list may be refused alone, by its own limit."""
    appliance.rosrv("host", "block", "10.0.0.77", "--for", "1h")
    reader = opened()
    refused = re.compile(r"/v1/audit" + ("/" if path == "stream?" else "") + path.replace("?", r"\?", 1))
    reader.page.route(
        refused,
        lambda route: route.fulfill(status=503, headers={"retry-after": "5"}, json={"detail": "full"}),
    )
    page = reader.go("now")
    expect(page.locator(".banner")).to_contain_text("New denials, alarms and actions do not come. full")
    expect(page.locator("[data-standing=live]")).to_be_visible()
    expect(page.get_by_role("region", name="Open alarms")).to_contain_text("1 host is blocked")
    denied = page.get_by_role("link", name=re.compile("^Denied"))
    expect(denied).to_have_text(re.compile(r"^Denied, \d+ s ago|^Denied\s*not known"))
    for words in ("No open alarms", "at once", "No monitor acted"):
        expect(page.get_by_text(words)).to_have_count(0)
    expect(page.locator(".skeleton")).to_have_count(0)
    reader.page.unroute(refused)
    expect(page.locator(".banner")).to_have_count(0)
    appliance.rosrv("host", "unblock", "10.0.0.77")


def test_the_end_of_a_right_is_not_a_denied_call(
    appliance: Appliance, opened: Callable[..., Reader], attempt: Callable[..., Any]
) -> None:
    called = "/parted", "/parting", "std_msgs/String", "http://127.0.0.1:1/"
    assert attempt("registerPublisher", *called)[0] == 1
    page = opened().go("now")
    refused = page.get_by_role("region", name="Recently denied")
    rest = appliance.rest()
    current = rest.get("/v1/policy")
    closed = current.json["text"].replace("/guarded =", "/parting = 10.9.9.9\n/guarded =")
    loaded = rest.post("/v1/policy", closed, match=current.etag)
    assert (loaded.status, loaded.json["revoked"]) == (200, 1), loaded.body
    attempt("registerPublisher", "/parted", "/guarded", *called[2:])
    for _ in ("live", "from the log"):
        expect(refused.get_by_role("listitem").first).to_contain_text("/guarded")
        expect(refused).not_to_contain_text("/parting")
        page.reload()
    assert rest.post("/v1/policy", current.json["text"], match=loaded.etag).status == 200
