import copy
import json
import re
import zipfile
from collections.abc import Callable, Iterator

import pytest
from playwright.sync_api import Route, expect

from appliance.api.routes.contract import EXAMPLES
from tests.support.appliance import Appliance
from tests.system.console.reader import Reader, wait_until

CONFIG = """
api: 127.0.0.1:0
api_tls: off
audit: {reserve_bytes: 1MiB}
recorder: {enabled: true, memory: 16MiB, disk: 512MiB, triggers: []}
"""


@pytest.fixture(scope="module")
def appliance(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Appliance]:
    config = tmp_path_factory.mktemp("console") / "appliance.yaml"
    config.write_text(CONFIG)
    with Appliance(options=("--config", str(config))) as running:
        yield running


def test_an_investigator_takes_a_recording_from_its_record(
    appliance: Appliance, opened: Callable[..., Reader], token: Callable[..., str]
) -> None:
    order = appliance.rosrv("record", "now", "--before", "1s", "--after", "1s", "--json")
    recording = json.loads(order.stdout)["id"]
    [record] = appliance.recorded("--event", "recording closed")
    page = opened(token("investigator")).go(f"audit/{record['id']}")
    panel = page.get_by_role("region", name="Record")
    with page.expect_download() as bag:
        panel.get_by_role("button", name="Bag").click()
    assert bag.value.suggested_filename == f"rosrv-{recording}.bag"
    assert bag.value.path().read_bytes().startswith(b"#ROSBAG V2.0")
    with page.expect_download() as bundle:
        panel.get_by_role("button", name="Evidence").click()
    with zipfile.ZipFile(bundle.value.path()) as archive:
        assert archive.read("recording/recording.bag") == bag.value.path().read_bytes()
    page = opened().go(f"audit/{record['id']}")
    expect(page.get_by_role("button", name="Bag")).to_have_attribute(
        "title", "For the role investigator; yours is admin"
    )


def test_recordings_are_listed_by_their_trigger(opened: Callable[..., Reader]) -> None:
    shown = copy.deepcopy(EXAMPLES["Recordings"]) | {"in_progress": []}
    [recording] = shown["recordings"]
    trigger = recording["triggers"][0] | {"monitor": "censor", "resource": "/rude", "caller_id": "/lout"}
    trigger |= {"host": "10.0.0.9", "equal": "a b"}
    other = trigger | {"monitor": "", "resource": "", "host": "", "text": "ann: the door", "equal": ""}
    shown["recordings"] = [
        recording | {"id": f"{number:020x}", "triggers": [one]}
        for number, one in enumerate([other, other, trigger, trigger, trigger])
    ]
    reader = opened()
    reader.page.route(re.compile("/v1/recordings$"), lambda route: route.fulfill(json=shown))
    page = reader.go("recordings")
    rows = page.locator("tbody tr")
    expect(rows).to_have_count(3)
    expect(rows.first.locator("td").first).to_contain_text("censor on /rude")
    expect(rows.first.locator("td").first).to_contain_text("by /lout of 10.0.0.9")
    expect(rows.nth(1).locator("td").first).to_contain_text("ann: the door")
    more = rows.first.get_by_role("button", name="3 recordings")
    more.press("Enter")
    expect(more).to_have_attribute("aria-expanded", "true")
    expect(rows).to_have_count(5)
    assert reader.axe() == []


def test_the_messages_of_a_record_that_is_not_listed(
    opened: Callable[..., Reader], token: Callable[..., str]
) -> None:
    [row] = copy.deepcopy(EXAMPLES["Recordings"]["recordings"])
    line = copy.deepcopy(EXAMPLES["Timeline"]) | {"id": row["id"], "more_events": 700}
    [trigger] = row["triggers"]
    line["events"][0]["record"] = "0" * 20  # the list lacks the trigger
    asked: list[str] = []

    def answer(route: Route) -> None:
        asked.append(route.request.url)
        body = (
            line
            if "/timeline" in route.request.url
            else EXAMPLES["RecordedMessages"]
            if "/messages" in route.request.url
            else row
        )
        route.fulfill(json=body)

    reader = opened(token("investigator", "reads"))
    reader.page.route(re.compile(f"/v1/recordings/{row['id']}"), answer)
    page = reader.go(f"recordings/{row['id']}", heading="Recording")
    page.get_by_role("button", name="Read messages").click()
    expect(page.get_by_role("list", name="Messages").get_by_role("listitem").first).to_be_visible()
    assert f"record={trigger['record']}" in next(url for url in asked if "/timeline" in url)
    assert f"at={trigger['record']}" in next(url for url in asked if "/messages" in url)
    page.get_by_role("slider").press("ArrowRight")
    expect(page.get_by_role("list", name="Messages").get_by_role("listitem").first).to_be_visible()
    wait_until(
        page,
        "() => performance.getEntriesByType('resource').some((one) => /messages\\?at=\\d{4}-/.test(one.name))",
    )


def test_a_recording_that_is_being_made_is_listed(opened: Callable[..., Reader]) -> None:
    shown = copy.deepcopy(EXAMPLES["Recordings"]) | {"recordings": []}
    reader = opened()
    reader.page.route(re.compile("/v1/recordings$"), lambda route: route.fulfill(json=shown))
    rows = reader.go("recordings").locator("tbody tr")
    expect(rows).to_have_count(1)
    for text in ("being made", "or later if more happens"):
        expect(rows.first).to_contain_text(text)
    assert reader.axe() == []
