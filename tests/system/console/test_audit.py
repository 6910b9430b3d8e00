import json
import random
import re
import urllib.parse
import zipfile
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any
from zoneinfo import ZoneInfo

import pytest
from playwright.sync_api import Route, expect

from appliance.audit.log.record import AuditRecord, RuleReference, Severity
from appliance.audit.log.record_format import LogEntry, as_object
from appliance.audit.search.equality import equality_of, group_equal
from tests.support.appliance import Appliance
from tests.system.console.reader import Reader


@pytest.fixture
def refuse(appliance: Appliance, attempt: Callable[..., Any]) -> Callable[[str], None]:
    def denied(node: str) -> None:
        assert (
            attempt("registerPublisher", node, "/guarded", "std_msgs/String", "http://127.0.0.1:1/")[0] != 1
        )
        appliance.recorded("--deny", caller_id=node)

    return denied


def test_a_record_leads_to_the_line_that_decided(
    opened: Callable[..., Reader], refuse: Callable[[str], None]
) -> None:
    refuse("/follow_me")
    reader = opened()
    page = reader.go("audit?decision=deny")
    page.get_by_role("table", name="Records").get_by_role("row", name="/follow_me").first.click()
    record = page.get_by_role("region", name=re.compile(r"^Record \d"))
    expect(record).to_contain_text("[Publishers] /guarded")
    expect(record.locator(".excerpt-line.here")).to_contain_text("/guarded = 10.9.9.9")
    record.get_by_role("link", name="line 7").click()
    expect(page.get_by_role("heading", level=1, name="Policy")).to_be_visible()
    expect(page.locator(".cm-lineNumbers .cm-activeLineGutter")).to_have_text("7")


def test_records_come_while_it_is_followed(
    opened: Callable[..., Reader], refuse: Callable[[str], None], appliance: Appliance
) -> None:
    reader = opened()
    page = reader.go("audit?decision=deny&caller_id=/live_*")
    expect(page.get_by_text("No record matches")).to_be_visible()

    def made_before(route: Route) -> None:
        refuse("/other")
        refuse("/live_1")
        route.continue_()

    page.route(re.compile(r"/v1/audit/stream\?.*live_"), made_before, times=1)
    page.get_by_role("button", name="Follow live").click()
    expect(page.get_by_role("row", name="/live_1")).to_be_visible()
    refuse("/live_2")
    expect(page.locator("tbody tr").first).to_contain_text("/live_2")
    expect(page.locator("tbody tr")).to_have_count(2)


def test_pages_go_back_to_the_beginning(
    opened: Callable[..., Reader], attempt: Callable[..., Any], appliance: Appliance
) -> None:
    callers = [f"/reader_{number}" for number in range(120)]
    for caller in callers:
        attempt("getParam", caller, "/nothing")
    appliance.recorded(caller_id=callers[-1])
    page = opened().go("audit?caller_id=/reader_*&event=decision")
    rows = page.locator("tbody tr")
    expect(rows).to_have_count(100)
    page.get_by_role("button", name="Older records").click()
    expect(rows.nth(119)).to_be_visible()
    assert rows.locator("td[data-label=Who]").all_inner_texts() == callers[::-1]
    numbers = page.eval_on_selector_all("tbody tr", "rows => rows.map(row => Number(row.dataset.sequence))")
    assert numbers == sorted(set(numbers), reverse=True)


def test_records_dropped_from_the_list_can_be_fetched(opened: Callable[..., Reader]) -> None:
    page = opened().go("audit")
    added = """async (state) => {
      const { added } = await import("/console/static/js/audit/records.js");
      return added(state, { sequence: 9 });
    }"""
    rows = [{"sequence": number} for number in (8, 7, 6)]
    kept = page.evaluate(added, {"records": rows, "cursor": None, "most": 3})
    assert [record["sequence"] for record in kept["records"]] == [9, 8, 7]
    assert kept["cursor"] == "7"
    whole = page.evaluate(added, {"records": rows, "cursor": None, "most": 4})
    assert [record["sequence"] for record in whole["records"]] == [9, 8, 7, 6]
    assert whole["cursor"] is None


def test_numbers_of_records_are_shown_in_full(opened: Callable[..., Reader]) -> None:
    page = opened().go("audit")
    answer = {
        "ok": True, "log": "ab" * 16, "records": 1_234_567, "first": 400_001, "last": 1_634_567, "removed": 400_000,
        "checkpoints": 9, "signed_checkpoints": 9, "signed_through": 1_634_001, "unsealed": 566, "key": "cd" * 32,
        "findings": [], "elsewhere": None,
    }  # fmt: skip
    page.route("**/v1/audit/verify", lambda route: route.fulfill(json=answer))
    page.get_by_role("button", name="Verify").click()
    dialog = page.get_by_role("dialog")
    expect(dialog).to_contain_text("400,001 to 1,634,567")
    expect(dialog).to_contain_text("through record 1,634,001")


def test_the_log_is_proven_and_exported(opened: Callable[..., Reader], refuse: Callable[[str], None]) -> None:
    refuse("/exported")
    reader = opened()
    page = reader.go("audit?decision=deny&caller_id=/exported")
    expect(page.get_by_role("row", name="/exported").first).to_be_visible()
    with page.expect_download() as download:
        page.get_by_role("button", name="Export").click()
    lines = [json.loads(line) for line in download.value.path().read_text().splitlines()]
    assert lines
    assert {line["caller_id"] for line in lines} == {"/exported"}
    assert download.value.suggested_filename.endswith(".ndjson")
    page.get_by_role("button", name="Verify").click()
    expect(page.get_by_role("dialog")).to_contain_text(
        re.compile("The log is consistent(, but nothing is signed yet)?")
    )


def test_evidence_of_a_time_is_exported(opened: Callable[..., Reader], refuse: Callable[[str], None]) -> None:
    refuse("/evident")
    reader = opened()
    page = reader.go("audit")
    expect(page.get_by_role("button", name="Evidence")).to_have_attribute(
        "title", "Choose a start time first"
    )
    page = reader.go("audit?since=1h")
    with page.expect_download() as download:
        page.get_by_role("button", name="Evidence").click()
    with zipfile.ZipFile(download.value.path()) as bundle:
        assert b"/evident" in bundle.read("records.ndjson")


def test_a_narrow_list_shows_rule_and_reason(
    opened: Callable[..., Reader], refuse: Callable[[str], None], appliance: Appliance
) -> None:
    refuse("/narrow")
    reason = appliance.recorded("--deny", caller_id="/narrow")[0]["reason"]
    reader = opened(width=390, height=844)
    page = reader.go("audit?decision=deny&caller_id=/narrow")
    card = page.locator("tbody tr").first
    expect(card.locator("td[data-label=Rule]")).to_have_text("[Publishers] /guarded")
    expect(card.locator("td[data-label=Rule]")).to_be_visible()
    expect(card.locator("td[data-label=Reason]")).to_contain_text(str(reason)[:60])
    expect(card.locator("td[data-label=Reason]")).to_be_visible()
    reader.fits()
    page = reader.go("audit?event=appliance started")
    card = page.locator("tbody tr").first
    expect(card).to_be_visible()
    expect(card.locator("td[data-label=Rule]")).to_be_hidden()


def test_an_unknown_record_shows_an_error(opened: Callable[..., Reader]) -> None:
    page = opened().go("audit/ffffffffffffffffffff")
    expect(page.get_by_role("alert")).to_contain_text("there is no record")
    expect(page.locator("tbody tr").first).to_be_visible()


def test_times_are_the_readers_and_utc_on_hover(appliance: Appliance, opened: Callable[..., Reader]) -> None:
    page = opened().go("audit")
    moment = page.locator("tbody time").first
    expect(moment).to_have_attribute("title", re.compile(r"^\d{4}-\d\d-\d\d \d\d:\d\d:\d\d\.\d{9} UTC$"))


def test_the_list_goes_by_keys(opened: Callable[..., Reader], refuse: Callable[[str], None]) -> None:
    refuse("/keys_1")
    refuse("/keys_2")
    page = opened().go("audit?caller_id=/keys_*&event=decision")
    expect(page.locator("tbody tr")).to_have_count(2)
    page.keyboard.press("j")
    expect(page.locator("tbody tr.chosen")).to_contain_text("/keys_2")
    page.keyboard.press("j")
    expect(page.locator("tbody tr.chosen")).to_contain_text("/keys_1")
    page.keyboard.press("k")
    expect(page.locator("tbody tr.chosen")).to_contain_text("/keys_2")
    page.keyboard.press("Escape")
    expect(page.locator("tbody tr.chosen")).to_have_count(0)
    page.keyboard.press("f")
    expect(page.get_by_label("Text")).to_be_focused()


def test_the_readers_own_looks_are_not_what_is_shown_first(
    opened: Callable[..., Reader], refuse: Callable[[str], None]
) -> None:
    reader = opened()
    refuse("/before_the_looks")
    for view in ("monitors", "hosts", "policy"):
        expect(reader.go(view).get_by_role("heading", level=1)).to_be_visible()
    page = reader.go("audit")
    expect(page.locator("tbody tr").first).to_be_visible()
    looked = re.compile("v1.(monitors|hosts|policy)")
    expect(page.locator("tbody tr").filter(has_text=looked)).to_have_count(0)
    expect(page.get_by_role("row", name="/before_the_looks").first).to_be_visible()
    page = reader.go("audit?looks=1")
    expect(page.locator("tbody tr").filter(has_text=looked).first).to_be_visible()


def test_short_names_are_not_broken(opened: Callable[..., Reader], refuse: Callable[[str], None]) -> None:
    refuse("/a_dozen_let")
    reader = opened()
    page = reader.go("audit")
    expect(page.get_by_role("row", name="/a_dozen_let").first).to_be_visible()
    reader.settle()
    broken = page.eval_on_selector_all(
        "tbody .given-mono",
        """names => names.filter(name => name.innerText.length <= 12 && name.getClientRects().length > 1)
                         .map(name => name.innerText)""",
    )
    assert broken == []


def test_it_opens_on_what_matters(
    opened: Callable[..., Reader],
    attempt: Callable[..., Any],
    refuse: Callable[[str], None],
    appliance: Appliance,
) -> None:
    refuse("/matters")
    refuse("/matters_too")  # the time line has marks from the first to the last
    attempt("getParam", "/matters_not", "/nothing")
    appliance.recorded("--allow", caller_id="/matters_not")
    reader = opened()
    page = reader.go("audit")
    expect(page.get_by_role("row", name="/matters").first).to_be_visible()
    expect(page.get_by_role("row", name="/matters_not")).to_have_count(0)
    searches = page.get_by_role("group", name="Searches")
    searches.get_by_role("button", name="All", exact=True).click()
    expect(page.get_by_role("row", name="/matters_not").first).to_be_visible()
    searches.get_by_role("button", name="Denied").click()
    expect(page.get_by_role("table", name="Records").locator("tbody tr").first).to_contain_text("deny")
    page.get_by_label("Text").fill("matters")
    searches.get_by_role("button", name="Save this search").click()
    page = reader.go("audit")
    page.get_by_role("button", name="matters, deny", exact=True).click()
    expect(page.get_by_label("Text")).to_have_value("matters")
    expect(page.get_by_role("img", name="When:")).to_be_visible()


def test_changes_by_people(opened: Callable[..., Reader], appliance: Appliance) -> None:
    name = json.loads(appliance.rosrv("monitor", "list", "--json").stdout.splitlines()[0])["name"]
    appliance.rosrv("monitor", "disable", name)
    appliance.recorded("--who", "*", event="monitor disabled")
    page = opened().go("audit")
    page.get_by_role("button", name="Changes by people").click()
    expect(page.get_by_role("row", name="monitor disabled").first).to_contain_text("operator")


def test_grant_this_leads_to_the_editor(
    opened: Callable[..., Reader], attempt: Callable[..., Any], appliance: Appliance
) -> None:
    attempt("registerPublisher", "/eager", "/guarded", "std_msgs/String", "http://127.0.0.1:4002/")
    [record, *_] = appliance.recorded(
        "--event", "decision", "--deny", resource="/guarded", caller_id="/eager"
    )
    page = opened().go(f"audit/{record['id']}")
    expect(page.get_by_text("would be allowed by: /guarded = 10.9.9.9 robot")).to_be_visible()
    page.get_by_role("button", name="Grant this").click()
    expect(page.get_by_role("region", name="What would grant it")).to_contain_text(
        "added: /guarded = 10.9.9.9 robot"
    )
    page.get_by_role("button", name="Open in the editor").click()
    expect(page.locator(".cm-content")).to_contain_text("/guarded = 10.9.9.9 robot")
    assert appliance.status()["policy"]["revision"] == 1


def test_grant_this_does_not_take_the_place_of_a_text_that_is_written(
    opened: Callable[..., Reader], attempt: Callable[..., Any], appliance: Appliance
) -> None:
    attempt("registerPublisher", "/hasty", "/guarded", "std_msgs/String", "http://127.0.0.1:4002/")
    appliance.recorded("--event", "decision", "--deny", resource="/guarded", caller_id="/hasty")
    reader = opened()
    page = reader.go("policy")
    reader.write("# half a thought")
    page.get_by_role("navigation").get_by_role("link", name="Audit").first.click()
    page.get_by_role("row", name="/hasty").first.click()
    page.get_by_role("button", name="Grant this").click()
    page.get_by_role("button", name="Open in the editor").click()
    expect(page.get_by_text("unloaded changes")).to_be_visible()
    page.get_by_role("button", name="Replace that text").click()
    expect(reader.editor()).to_contain_text("/guarded = 10.9.9.9 robot")


def drop(number: int, reason: str = "", monitor: str = "limit", **detail: Any) -> LogEntry:
    said = reason or f"{monitor}.drive dropped it: speed 0.{number}"
    record = AuditRecord(
        id=f"{number:020x}", time=number * 10**9, event="message dropped", severity=Severity.WARNING, reason=said,
        host="10.0.0.1", caller_id="/teleop", category="monitor", resource="/cmd_vel",
        detail={"monitor": monitor, **detail},
    )  # fmt: skip
    return LogEntry(number, record)


def denial(number: int, resource: str, event: str = "decision", **detail: Any) -> LogEntry:
    record = AuditRecord(
        id=f"{number:020x}", time=number * 10**9, event=event, severity=Severity.NOTICE, decision="deny",
        host="10.0.0.9", caller_id="/x", category="publish", resource=resource, reason="no rule",
        rule=RuleReference("Publishers", "/arm", "robot.ini", 7), detail=detail,
    )  # fmt: skip
    return LogEntry(number, record)


def page_of(entries: list[LogEntry]) -> dict[str, Any]:
    return {
        "records": [as_object(entry) for entry in entries[::-1]],
        "equality": [equality_of(entry.record) for entry in entries[::-1]],
        "cursor": None,
    }


def test_rows_are_those_of_the_command(opened: Callable[..., Reader]) -> None:
    page = opened().go("audit")
    rows = """async (page) => {
      const { compared, grouped } = await import("/console/static/js/audit/rows.js");
      return grouped(compared(page)).map((row) =>
        [row.first.sequence, row.last.sequence, row.records.length, row.count, row.value]);
    }"""
    chance = random.Random(5)  # noqa: S311  the same records in every run
    for _round in range(20):
        entries = []
        for number in range(1, 60):
            monitor = chance.choice(["limit", "zone"])
            counted = drop(number, "3 more in the same second", monitor, count=3)
            valued = drop(number, f"3 more in the same second: {monitor} {number}", monitor, count=3)
            kinds = [
                drop(number, "", monitor),
                counted,
                valued,
                denial(number, chance.choice(["/arm", "/leg"])),
            ]
            entries.append(chance.choice(kinds))
        for some in (entries, entries[::-1]):
            expected = [
                [row.first.sequence, row.last.sequence, row.records, row.count, row.value]
                for row in group_equal(some)
            ]
            assert page.evaluate(rows, page_of(some[::-1])) == expected


def test_a_host_that_makes_several_calls_in_turn_is_a_few_rows(opened: Callable[..., Reader]) -> None:
    entries = [denial(number, f"/arm{number % 3}") for number in range(1, 40)] + [
        drop(40),
        denial(41, "/leg"),
        drop(42),
    ]
    reader = opened()
    reader.page.route(re.compile(r"/v1/audit\?"), lambda route: route.fulfill(json=page_of(entries)))
    page = reader.go("audit")
    rows = page.locator("tbody tr")
    expect(rows).to_have_count(2)
    expect(rows.nth(0)).to_contain_text("2 times")
    for text in ("40 times", "/leg", "and 3 more"):
        expect(rows.nth(1)).to_contain_text(text)
    page.get_by_label("Text", exact=True).fill("arm")
    expect(rows).to_have_count(42)


def test_a_row_of_repetitions_alone_names_the_request(opened: Callable[..., Reader]) -> None:
    entries = [
        denial(number, "/arm", "denials folded", of="decision", call="registerPublisher", count=10)
        for number in (1, 2)
    ]
    reader = opened()
    reader.page.route(re.compile(r"/v1/audit\?"), lambda route: route.fulfill(json=page_of(entries)))
    rows = reader.go("audit").locator("tbody tr")
    expect(rows).to_have_count(1)
    expect(rows).to_contain_text("publish")
    expect(rows).not_to_contain_text("folded")
    rows.get_by_role("button", name="20 times").press("Enter")
    expect(rows.last).to_contain_text("denials folded")


def test_equal_records_are_one_row_that_opens(opened: Callable[..., Reader]) -> None:
    drops = [drop(2), drop(3, "7 more in the same second", count=7), drop(4)]
    reader = opened()
    reader.page.route(
        re.compile(r"/v1/audit\?"), lambda route: route.fulfill(json=page_of([denial(1, "/arm"), *drops]))
    )
    page = reader.go("audit")
    rows = page.locator("tbody tr")
    expect(rows).to_have_count(2)
    expect(page.locator(".head-sub")).to_have_text("4 records shown in 2 rows")
    for text in ("limit", "9 times", "since", "/cmd_vel", "limit.drive dropped it: speed 0.4"):
        expect(rows.first).to_contain_text(text)
    expect(rows.first.get_by_role("link")).to_have_attribute("href", re.compile(f"{4:020x}$"))
    more = rows.first.get_by_role("button", name="9 times")
    more.press("Enter")
    expect(more).to_have_attribute("aria-expanded", "true")
    expect(rows).to_have_count(5)
    expect(page.locator("tr.part").last).to_contain_text("speed 0.2")
    assert reader.axe() == []
    page.keyboard.press("Escape")
    more.press("Enter")
    expect(rows).to_have_count(2)
    page.keyboard.press("j")
    page.keyboard.press("j")
    expect(page).to_have_url(re.compile(f"/{1:020x}"))
    page = reader.go("now")
    entry = page.get_by_role("region", name="Recent actions of monitors").get_by_role("listitem").first
    for text in ("limit", "9 times", "since", "/cmd_vel", "speed 0.4"):
        expect(entry).to_contain_text(text)
    entry.get_by_role("button", name="9 times").press("Enter")
    expect(entry.get_by_role("listitem")).to_have_count(3)
    assert reader.axe() == []


def test_rows_are_in_the_order_of_the_times_that_they_show(opened: Callable[..., Reader]) -> None:
    page = opened().go("audit")
    ordered = """async (times) => {
      const { inOrder } = await import("/console/static/js/audit/rows.js");
      return inOrder(times.map((ended) => ({ last: { equality: { ended } } }))).map((row) => row.last.equality.ended);
    }"""
    folded, newer, older = (f"2026-11-28T14:03:0{second}.000000000Z" for second in (4, 9, 1))
    assert page.evaluate(ordered, [folded, newer, older]) == [newer, folded, older]


@pytest.mark.parametrize("zone", ["America/New_York", "UTC", "Asia/Kolkata"])
def test_each_time_of_a_search_is_in_the_zone_of_the_browser(
    opened: Callable[..., Reader], zone: str
) -> None:
    reader = opened(zone=zone)
    page = reader.go("audit")
    page.get_by_role("button", name="Filters").click()
    sent = {}
    for label, name, written in (
        ("From", "since", "2026-11-30T08:00"),
        ("Until", "until", "2026-11-30T09:30"),
    ):
        page.get_by_label(label, exact=True).fill(written)
        at = datetime.fromisoformat(written).replace(tzinfo=ZoneInfo(zone)).astimezone(UTC)
        sent[name] = f"{at:%Y-%m-%dT%H:%M}:00.000Z"
    expect(page).to_have_url(re.compile(re.escape(urllib.parse.urlencode(sent)) + "$"))
    without_zone = {name: time.removesuffix(":00.000Z") for name, time in sent.items()}
    for query in (sent, without_zone):
        page.goto(f"{reader.url}/console/audit?{urllib.parse.urlencode(query)}")
        expect(page.get_by_label("From", exact=True)).to_have_value("2026-11-30T08:00")
        expect(page.get_by_label("Until", exact=True)).to_have_value("2026-11-30T09:30")
