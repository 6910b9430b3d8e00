"""Makes the console's pictures in docs/pictures anew: `python -m tests.system.console.pictures`.

An appliance with a robot of a hundred nodes, in whose name an operator's machine tries to command the arm; a browser of
1280 by 800 pixels, in light colours.
"""

import base64
import tempfile
from pathlib import Path

from playwright.sync_api import Page, expect, sync_playwright

from tests.support.appliance import Appliance
from tests.support.requirements import need_program
from tests.support.robot import Robot
from tests.system.console.conftest import CONFIG, REPOSITORY, launch
from tests.system.console.reader import Reader

_PICTURES = REPOSITORY / "docs" / "pictures"
_POLICY = """\
[Nodes]
default = *

[Publishers]
default = *
/arm/command = 127.0.0.11            # the robot's own computer

[Subscribers]
default = *

[Commands]
default = *
"""
_STRANGERS = ("/operator/bridge", "/camera/bridge")


def main() -> None:
    """Start all of it, and take the pictures."""
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        config = Path(folder) / "appliance.yaml"
        config.write_text(CONFIG)
        options = ("--config", str(config), "--monitors", str(REPOSITORY / "monitors"))
        browser = launch(driver, need_program("chromium", "chromium"))
        with Appliance(policy=_POLICY, options=options) as appliance, Robot(appliance.master_uri) as robot:
            for node in _STRANGERS:
                robot.call(node, "registerPublisher", "/arm/command", "std_msgs/Float64", robot.api(node))
            place, token = str(appliance.ready["api"]), str(appliance.ready["token"])
            with Reader(browser, place, token, width=1280, height=800) as reader:
                _robot(reader)
                _now(reader)
                _audit(reader)
                _one_topic(reader)
            with Reader(browser, place, token, width=390, height=844) as narrow:
                _narrow(narrow)
        browser.close()


def _robot(reader: Reader) -> None:
    page = reader.go("graph")
    expect(page.locator(".box.many")).to_have_count(10)
    expect(page.locator(".line.flowing").first).to_be_attached()
    expect(page.locator("g.attempt")).to_have_count(len(_STRANGERS))
    _take(page, "console-robot")


def _now(reader: Reader) -> None:
    page = reader.go("now")
    expect(page.locator(".event")).to_have_count(len(_STRANGERS))
    expect(page.locator("path.curve.c3[d*=L]")).to_be_attached()  # a line begins with the second sample
    _take(page, "console-now")


def _audit(reader: Reader) -> None:
    page = reader.go("audit")
    page.get_by_role("row", name=_STRANGERS[0]).first.click()
    expect(page.locator(".excerpt-line.here")).to_be_visible()
    _take(page, "console-audit")


def _one_topic(reader: Reader) -> None:
    page = reader.go("graph")
    page.get_by_label("Search the graph").fill("/arm/command")
    expect(page.locator('[data-key="t/arm/command"]')).to_be_visible()
    page.get_by_label("Search the graph").press("Enter")
    expect(page.get_by_role("button", name="Look", exact=True)).to_be_visible()
    _take(page, "console-graph")


def _narrow(reader: Reader) -> None:
    """Three views beside each other."""
    shots = []
    for view in ("now", "graph", "audit"):
        page = reader.go(view)
        expect(
            page.locator({"now": ".event", "graph": ".box.many", "audit": "tbody tr"}[view]).first
        ).to_be_visible()
        shots.append(page.screenshot(animations="disabled"))
    images = "".join(
        f'<img src="data:image/png;base64,{base64.b64encode(shot).decode()}" style="border:1px solid #8894a3">'
        for shot in shots
    )
    context = reader.context.browser
    assert context is not None
    beside = context.new_page(viewport={"width": 3 * 392 + 64, "height": 880})
    beside.set_content(f'<body style="margin:16px;display:flex;gap:16px">{images}</body>')
    beside.screenshot(path=_PICTURES / "console-narrow.png")
    beside.close()


def _take(page: Page, name: str) -> None:
    page.screenshot(path=_PICTURES / f"{name}.png", animations="disabled")


if __name__ == "__main__":
    main()
