import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Page, Route, expect

from examples.landshark.doorway import Doorway
from examples.landshark.lab import Host, Lab
from tests.support.appliance import Appliance
from tests.support.nodes import RosSession
from tests.support.processes import Process
from tests.support.waiting import eventually
from tests.system.console.reader import Reader

POLICY = """
[Groups]
site = 10.77.0.0/24
mine = door:first
[Nodes]
default = site mine
[Publishers]
default = site
/cmd_vel = site mine
[Subscribers]
default = site mine
[Commands]
default = site mine
[Authority]
base = /cmd_vel
take base = site mine
lease base = 60s
"""
CONSOLE = "127.0.0.1", 8443
SECONDS_TO_A_PICTURE = 60
# 3 x 2 pixels, red.
PNG = bytes.fromhex(
    "89504e470d0a1a0a0000000d49484452000000030000000208020000001216f14d0000001049444154789c63f8cfc000410c"
    "70160041d205fb87f0b9480000000049454e44ae426082"
)
# The page's findings in the heads of pictures of 123 x 77 pixels, and its words about one of 30,000 x 30,000.
HEADS = """async () => {
    const { decoded, sizeOf } = await import("/console/static/features/doors/teleop/pixels.js");
    const canvas = Object.assign(document.createElement("canvas"), { width: 123, height: 77 });
    const found = [];
    for (const type of ["image/png", "image/jpeg", "image/webp"]) {
        const blob = await new Promise((done) => canvas.toBlob(done, type));
        found.push(sizeOf(new Uint8Array(await blob.arrayBuffer()), type));
    }
    const large = [0x89, 0x50, 0x4e, 0x47, ...Array(12).fill(0), 0, 0, 0x75, 0x30, 0, 0, 0x75, 0x30];
    try { await decoded({ data: btoa(String.fromCharCode(...large)) }) } catch (error) { found.push(error.message) }
    return found;
}"""


@pytest.fixture(scope="module")
def appliance(common_lab: Lab) -> Iterator[Appliance]:
    host = common_lab.host("appliance", "10.77.0.2/24")
    with Appliance(host, policy=POLICY, options=("--api", f"{CONSOLE[0]}:{CONSOLE[1]}")) as running:
        yield running


@pytest.fixture
def reader(browser: object, appliance: Appliance) -> Iterator[Callable[..., Reader]]:
    assert isinstance(appliance.host, Host)
    with Doorway(appliance.host, CONSOLE) as door:
        url = f"https://127.0.0.1:{door.port}"
        yield lambda **look: Reader(browser, url, str(appliance.ready["token"]), **look)  # type: ignore[arg-type]  # options of `Reader`


def test_a_person_sees_and_drives_the_robot_through_their_own_door(
    appliance: Appliance, common_robot: Host, reader: Callable[..., Reader], tmp_path: Path
) -> None:
    with RosSession(appliance.master_uri, tmp_path, common_robot) as ros, reader() as console:
        image = f"{{format: png, data: {[*PNG]}}}"
        ros.start(["rostopic", "pub", "-r", "5", "/camera/compressed", "sensor_msgs/CompressedImage", image])
        ros.start(["rostopic", "pub", "-r", "10", "/battery", "std_msgs/Float64", "data: 12.5"])
        base = ros.start(["rostopic", "echo", "-p", "/cmd_vel"])
        appliance.recorded("--category", "publish", resource="/camera/compressed")
        began = time.monotonic()
        page = console.go("robot")
        own = page.get_by_role("region", name="Your door")
        expect(own).to_contain_text("you have no door: rosrv door add first")
        own.get_by_role("button", name="Add door first").click()
        own.get_by_role("button", name="Open").click()
        expect(own.get_by_role("img", name="Picture of /camera/compressed")).to_have_attribute("width", "3")
        assert time.monotonic() - began < SECONDS_TO_A_PICTURE
        *sizes, said = page.evaluate(HEADS)
        assert sizes == [[123, 77]] * 3
        assert re.search("30000 . 30000 is not shown", said), "before it is decoded"
        own.get_by_label("Topic").select_option("/battery")
        expect(own.get_by_role("img", name="data of /battery: 12.5")).to_be_visible()
        assert console.axe() == []
        lock(page, base)
        drive(page, base)
        own.get_by_label("Commands").fill("/other")
        expect(own).to_contain_text("not listed by the door")
        own.get_by_role("application").focus()
        page.keyboard.down("ArrowUp")
        expect(own.get_by_role("alert")).to_contain_text(re.compile(r"\[Publishers\].*policy\.ini:8"))
        page.keyboard.up("ArrowUp")
        [client] = appliance.row("door", "list")["clients"]
        assert (client["address"], client["protocol"], client["who"]) == ("127.0.0.1", "rosbridge", "first")
        eventually(
            lambda: appliance.row("door", "list")["clients"][0]["refused"] > 0, "the refusal is counted"
        )
        appliance.rosrv("door", "remove", "first")
        expect(own).to_contain_text("you have no door: rosrv door add first")


FRESHNESS = """async () => {
    const { Freshness, OLD } = await import("/console/static/features/doors/teleop/freshness.js");
    const shown = new Freshness();
    const ages = [shown.age(1e6)];
    shown.begin(true);
    ages.push(shown.age(100) > OLD);
    shown.drawn("one", 1000);
    ages.push(shown.age(1200));
    shown.drawn("one", 1400);
    ages.push(shown.age(1600));
    shown.drawn("two", 1700);
    ages.push(shown.age(1700));
    shown.begin(false);
    return [...ages, shown.age(9000), OLD];
}"""


def lock(page: Page, base: Process) -> None:
    """The camera repeats one image: the pad is locked, and drives without a picture."""
    own = page.get_by_role("region", name="Your door")
    pad = own.get_by_role("application")
    assert page.evaluate(FRESHNESS) == [0, True, 200, 600, 0, 0, 500]
    own.get_by_label("Commands").fill("/cmd_vel")
    own.get_by_role("button", name="Take it").click()
    expect(own).to_contain_text("Locked: the picture is older than 0.5 s")
    pad.focus()
    page.keyboard.down("ArrowUp")
    own.get_by_label("Camera", exact=True).evaluate(
        "(field) => { field.value = ''; field.dispatchEvent(new Event('input', { bubbles: true })); }"
    )
    expect(own.get_by_role("img", name="Picture of /camera/compressed")).to_have_count(0)
    page.wait_for_timeout(500)
    expect(pad).to_have_attribute("aria-disabled", "true")
    assert not moving(base), "a key that is held since the lock does not drive"
    page.keyboard.up("ArrowUp")
    expect(pad).not_to_have_attribute("aria-disabled", "true")
    page.keyboard.down("ArrowUp")
    eventually(lambda: moving(base), "the robot drives")
    own.get_by_label("Camera", exact=True).evaluate(
        "(field) => { field.value = '/camera/compressed';"
        " field.dispatchEvent(new Event('input', { bubbles: true })); }"
    )
    expect(own.get_by_role("alert")).to_contain_text("the robot was stopped")
    eventually(lambda: stopped(base), "the lock stops the robot")
    page.keyboard.up("ArrowUp")
    own.get_by_role("button", name="Free it").click()
    own.get_by_label("Camera", exact=True).select_option("")


def drive(page: Page, base: Process) -> None:
    own = page.get_by_role("region", name="Your door")
    pad = own.get_by_role("application")
    own.get_by_label("Commands").fill("/cmd_vel")
    expect(own).to_contain_text("Take base first")
    own.get_by_role("button", name="Take it").click()
    expect(own).to_contain_text("You hold base")
    expect(own).to_contain_text("No deadman guards this topic")
    pad.focus()
    page.keyboard.down("ArrowUp")
    eventually(lambda: moving(base), "the robot drives")
    page.keyboard.up("ArrowUp")
    eventually(lambda: stopped(base), "the robot stops when the key is released")
    box = pad.bounding_box()
    assert box is not None
    for event in ("window.dispatchEvent(new Event('blur'))", "window.dispatchEvent(new Event('pagehide'))"):
        page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] * 0.1)
        page.mouse.down()
        eventually(lambda: moving(base), "the robot drives again")
        page.evaluate(event)
        eventually(lambda: stopped(base), f"the robot stops at {event}")
        page.mouse.up()
    hold_while_the_pad_looks(page, base)


def hold_while_the_pad_looks(page: Page, base: Process) -> None:
    """A hold counts from the answer on who drives, and not if it has ended before."""
    own = page.get_by_role("region", name="Your door")
    for still_held in (True, False):
        own.get_by_label("Commands").fill("")
        waiting = delayed(page)
        own.get_by_label("Commands").fill("/cmd_vel")
        expect(own).to_contain_text("Looking who drives")
        own.get_by_role("application").focus()
        page.keyboard.down("ArrowUp")
        if not still_held:
            page.keyboard.up("ArrowUp")
        assert stopped(base)
        while waiting:
            waiting.pop().continue_()
        page.unroute("**/v1/drive")
        expect(own).to_contain_text("You hold base")
        if still_held:
            eventually(lambda: moving(base), "the robot drives once it is known who does")
            page.keyboard.up("ArrowUp")
            eventually(lambda: stopped(base), "the robot stops when the key is released")
    expect(own).to_contain_text("Stopped.")


def delayed(page: Page) -> list[Route]:
    waiting: list[Route] = []
    page.route("**/v1/drive", lambda route: waiting.append(route))  # noqa: PLW0108  Playwright inspects it
    return waiting


def moving(base: Process) -> bool:
    return _last(base)[0] > 0


def stopped(base: Process) -> bool:
    return _last(base) == [0.0] * 6


def _last(base: Process) -> list[float]:
    texts = [str(event.get("text", "")) for event in base.events]
    lines = [text for text in texts if re.fullmatch(r"\d+(,-?[\d.e-]+){6}", text)]
    return [float(number) for number in lines[-1].split(",")[1:]] if lines else [0.0]
