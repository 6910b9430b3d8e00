import re
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Locator, Page, expect

from tests.support.appliance import Appliance
from tests.support.nodes import RosSession, need_ros
from tests.support.waiting import eventually
from tests.system.console.reader import Reader

POLICY = """\
[Nodes]
default = *

[Publishers]
default = *
/rude = *
/guarded = 10.9.9.9

[Subscribers]
default = *

[Commands]
default = *
"""
CONFIG = """
api: 127.0.0.1:0
api_tls: off
api_limits: {requests_per_second: 500, burst: 2000}
audit: {reserve_bytes: 1MiB}
recorder: {enabled: true, memory: 16MiB, disk: 512MiB, before: 20, after: 1, triggers: [drop]}
"""
MAX_KEYS = 25  # from Now to a policy in force, without signing in and without text
MONITOR = """
NAME() {
    event said(std::string text) TOPIC std_msgs/String '{data:text}' { return; }
}
"""


@pytest.fixture(scope="module")
def appliance() -> Iterator[Appliance]:
    need_ros()
    with tempfile.TemporaryDirectory(prefix="rosrv-incident-") as name:
        folder = Path(name)
        folder.chmod(0o755)  # the appliance's processes run as other users
        (folder / "appliance.yaml").write_text(CONFIG)
        (folder / "monitors").mkdir()
        for monitor, topic in (("censor", "/rude"), ("hush", "/loud")):
            text = MONITOR.replace("NAME", monitor).replace("TOPIC", topic)
            (folder / "monitors" / f"{monitor}.rv").write_text(text)
        options = ("--config", str(folder / "appliance.yaml"), "--monitors", str(folder / "monitors"))
        with Appliance(policy=POLICY, options=options) as running:
            yield running


@pytest.fixture(scope="module")
def recording(appliance: Appliance, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    with RosSession(appliance.master_uri, tmp_path_factory.mktemp("ros")) as ros:
        ear = ros.listener("rospy", "/chatter", name="ear")
        ros.listener("rospy", "/rude", name="prude")
        ros.talker("rospy", "/chatter", name="voice")
        ear.wait_for_count(5, event="received")
        ros.talker(
            "rospy", "/rude", "--latch", "--text", "<b>bad</b>", name="lout"
        )  # one message: one record
        appliance.recorded(event="message dropped")

    def closed() -> dict[str, Any] | None:
        rows = appliance.rows("record", "list")
        return rows[-1] if rows else None

    return eventually(closed, appliance.story)


def press(locator: Locator, key: str = "Enter") -> None:
    locator.press(key)


class Keys:
    def __init__(self, page: Page) -> None:
        self.page = page
        self.count = 0

    def press(self, *keys: str) -> None:
        for key in keys:
            self.page.keyboard.press(key)
            self.count += 1

    def step_to(self, locator: Locator) -> None:
        expect(locator).to_be_visible()
        while not locator.evaluate("element => element === document.activeElement"):
            assert self.count < MAX_KEYS
            self.press("j")


def test_an_incident_by_keys(
    recording: dict[str, Any], appliance: Appliance, opened: Callable[..., Reader], token: Callable[..., str]
) -> None:
    """At most 25 keys lead from Now to the drop, its record, timeline, messages and evidence, and a new policy."""
    page = opened(token("investigator", "carol")).go("now")
    keys = Keys(page)
    actions = page.get_by_role("region", name="Recent actions of monitors").get_by_role("listitem")
    keys.step_to(actions.filter(has_text="/rude").get_by_role("link"))
    keys.press("Enter")
    record = page.get_by_role("region", name=re.compile(r"^Record \d"))
    expect(record).to_be_focused()
    expect(record).to_contain_text("/lout")
    expect(record.get_by_role("link", name="Time line")).to_be_visible()
    keys.press("r")

    expect(page.get_by_role("heading", level=1, name="Recording")).to_be_visible()
    chosen = page.locator(".incident-grid").get_by_role("region", name="message dropped")
    expect(chosen).to_contain_text("/rude")
    expect(chosen).to_contain_text("127.0.0.1")
    expect(page.get_by_role("img", name="/rude: ")).to_be_visible()
    keys.press("m")
    said = page.get_by_role("list", name="Messages")
    expect(said).to_contain_text("<b>bad</b>")
    expect(said).to_contain_text("/lout")
    records = appliance.recorded("--event", "recording read")
    assert {record["detail"]["who"] for record in records} == {"carol"}
    with page.expect_download() as bundle:
        keys.press("e")
    with zipfile.ZipFile(bundle.value.path()) as archive:
        assert "recording/recording.bag" in archive.namelist()

    admin = opened()
    keys.page = page = admin.go("now")
    keys.press("4")
    expect(admin.editor()).to_contain_text("/rude")
    keys.press("i", "Control+a")
    page.keyboard.insert_text(POLICY.replace("/rude = *", "/rude = 10.9.9.9"))  # pasted
    keys.press("Control+s")
    expect(page.get_by_text("It can be loaded")).to_be_visible()
    keys.press("Escape", "l")
    expect(page.get_by_role("dialog").get_by_label("Comment")).to_be_focused()
    keys.press("Enter")
    expect(admin.toast("is in force")).to_be_visible()
    assert appliance.rest().get("/v1/policy").json["text"].count("/rude = 10.9.9.9") == 1
    assert keys.count <= MAX_KEYS


def test_a_denial_is_granted_by_keys(
    appliance: Appliance, opened: Callable[..., Reader], attempt: Callable[..., Any]
) -> None:
    arguments = ("registerPublisher", "/asker", "/guarded", "std_msgs/String", "http://127.0.0.1:1/")
    assert attempt(*arguments)[0] != 1
    reader = opened()
    page = reader.go("now")
    keys = Keys(page)
    denied = page.get_by_role("region", name="Recently denied").get_by_role("listitem")
    keys.step_to(denied.filter(has_text="/asker").get_by_role("link"))
    keys.press("Enter")
    record = page.get_by_role("region", name=re.compile(r"^Record \d"))
    expect(record.get_by_role("button", name="Grant this")).to_be_visible()
    keys.press("g")
    expect(record.get_by_role("region", name="What would grant it")).to_be_focused()
    expect(record.get_by_role("button", name="Open in the editor")).to_be_in_viewport()
    keys.press("g")
    expect(page.get_by_text("changed here, not loaded")).to_be_visible()
    expect(page.locator(".cm-activeLine")).to_contain_text("/guarded")
    keys.press("l")
    dialog = page.get_by_role("dialog")
    expect(dialog.get_by_label("Comment")).to_be_focused()
    expect(dialog.get_by_label("Commit-confirm")).to_have_value("300")
    keys.press("Enter")
    expect(reader.toast("is in force")).to_be_visible()
    assert attempt(*arguments)[0] == 1
    assert keys.count <= MAX_KEYS
    page.get_by_role("button", name="Keep it").click()
    expect(reader.toast("The policy is kept")).to_be_visible()


def test_the_time_line_moves_by_keys(
    recording: dict[str, Any], opened: Callable[..., Reader], token: Callable[..., str]
) -> None:
    page = opened(token("investigator", "dora")).go(f"recordings/{recording['id']}", heading="Recording")
    slider = page.get_by_role("slider", name="Moment")
    before = slider.get_attribute("aria-valuenow")
    press(slider, "ArrowLeft")
    expect(slider).not_to_have_attribute("aria-valuenow", str(before))
    page.keyboard.press("+")
    expect(page.locator(".skeleton")).to_have_count(0)
    page.keyboard.press("0")
    press(page.get_by_role("button", name="/rude", exact=True))
    page.keyboard.press("m")
    expect(page.get_by_role("list", name="Messages")).to_contain_text("<b>bad</b>")


def test_a_viewer_sees_which_role_may_read_messages(
    recording: dict[str, Any], opened: Callable[..., Reader], token: Callable[..., str]
) -> None:
    reader = opened(token("viewer"), width=390, height=844)
    page = reader.go("recordings")
    press(page.locator(f'tbody a[href$="{recording["id"]}"]'))
    expect(page.get_by_role("slider", name="Moment")).to_be_visible()
    expect(page.get_by_role("button", name="Read messages")).to_have_attribute(
        "title", "For the role investigator; yours is viewer"
    )
    expect(page.get_by_role("button", name="Evidence")).to_have_attribute("aria-disabled", "true")
    reader.fits()
    assert reader.axe() == []
    assert recording["id"] in page.url


def test_a_monitor_in_shadow_mode_says_what_it_would_drop_and_is_promoted(
    appliance: Appliance, opened: Callable[..., Reader], tmp_path: Path
) -> None:
    appliance.rosrv("monitor", "disable", "hush")
    page = opened().go("monitors/hush", heading="hush")
    press(page.get_by_role("button", name="Try"))
    expect(page.get_by_text("shadow mode", exact=True).first).to_be_visible()
    with RosSession(appliance.master_uri, tmp_path) as ros:
        ear = ros.listener("rospy", "/loud", name="neighbour")
        ros.talker("rospy", "/loud", name="shouter")
        ear.wait_for_count(3, event="received")
        count = page.locator(".figures div").filter(has_text="Would have dropped").locator("dd")
        expect(count).to_have_text(re.compile("[1-9]"))
        expect(page.get_by_role("region", name="Latest actions")).to_contain_text("/loud")
        press(page.get_by_role("button", name="Enforce"))
        expect(page.get_by_role("switch", name="hush enabled")).to_have_attribute("aria-checked", "true")
        appliance.recorded(event="message dropped", resource="/loud")
