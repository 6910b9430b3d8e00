"""Make the console's pictures in docs/pictures, as root: `python -m tests.system.console.pictures [MINUTES]`.

Most show the demonstration, whose appliance has isolation on, after MINUTES (by default 10), with its attacker. The
graph of a hundred nodes is another robot's. `console.json` beside the pictures has the version that they show.
"""

import base64
import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from playwright.sync_api import Browser, Page, expect, sync_playwright

from tests.support.appliance import Appliance
from tests.support.processes import Process, ThisMachine
from tests.support.requirements import need_program
from tests.support.robot import Robot
from tests.system.console.conftest import CONFIG, REPOSITORY, launch
from tests.system.console.reader import Reader

_PICTURES = REPOSITORY / "docs" / "pictures"
_POLICY = """\
[Groups]
arm-pc   = 127.0.0.11
cameras  = 127.0.0.12
operator = 127.0.0.14

[Nodes]
default = *

[Publishers]
default = *
/arm/command = arm-pc                # the robot's own computer

[Subscribers]
default = *

[Commands]
default = *
"""
_UNKNOWN_NODES = ("/operator/bridge", "/camera/bridge")
# The pictures contain the paths of an installed appliance.
_DEMO = (
    "unshare", "--mount", "sh", "-ec",
    'mount -t tmpfs tmpfs /opt; mkdir /opt/rosrv; mount --bind "$1" /opt/rosrv; cd /opt/rosrv;'
    " exec env PYTHONPATH=/opt/rosrv .venv/bin/rosrv demo --keep", "sh", str(REPOSITORY),
)  # fmt: skip
_DEMO_SECONDS = 400.0
_ATTACK = """
import sys, xmlrpc.client
with xmlrpc.client.ServerProxy(sys.argv[1]) as master:
    print(master.registerPublisher("/tablet", "/landshark_control/trigger", "*", "http://10.77.0.66:40404/"))
"""


def main() -> None:
    minutes = float(sys.argv[1]) if len(sys.argv) > 1 else 10.0
    if REPOSITORY.is_relative_to("/opt"):
        raise SystemExit(f"{REPOSITORY}: the demonstration hides /opt; run this from a checkout elsewhere")
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        config = Path(folder) / "appliance.yaml"
        config.write_text(f"{CONFIG}name: arm-3\n")
        options = ("--config", str(config), "--monitors", str(REPOSITORY / "monitors"))
        browser = launch(driver, need_program("chromium", "chromium"))
        with Appliance(policy=_POLICY, options=options) as appliance, Robot(appliance.master_uri) as robot:
            for node in _UNKNOWN_NODES:
                robot.call(node, "registerPublisher", "/arm/command", "std_msgs/Float64", robot.api(node))
            place, token = str(appliance.ready["api"]), str(appliance.ready["token"])
            with Reader(browser, place, token, width=1280, height=800) as reader:
                _many_nodes(reader)
                _one_topic(reader)
        with Process(ThisMachine(), _DEMO, env=dict(os.environ), label="demo") as demo:
            version = _demonstration(browser, demo, minutes)
            demo.stop(with_signal=signal.SIGTERM, timeout=60)
        browser.close()
    hashes = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in _PICTURES.glob("*.png")}
    shown = {"version": version, "pictures": dict(sorted(hashes.items()))}
    (_PICTURES / "console.json").write_text(json.dumps(shown, indent=1) + "\n")


def _demonstration(browser: Browser, demo: Process, minutes: float) -> str:
    """Take the pictures of the demonstration, and return the version that its console shows."""
    demo.wait_for_text("Be the attacker:", timeout=_DEMO_SECONDS)
    said = "\n".join(str(event.get("text")) for event in demo.events)
    ((attacker, master),) = re.findall(
        r"Be the attacker: +(ip netns exec \S+) env ROS_MASTER_URI=(\S+)", said
    )
    there = ["nsenter", "--mount", f"--target={demo.pid}", *attacker.split()]
    ((place, token),) = re.findall(r"console: +(\S+?)/? .*?its token: +(\S+)", said, re.DOTALL)
    time.sleep(60 * minutes)  # noqa: TID251  # the curves of Now grow
    subprocess.run([*there, "python3", "-c", _ATTACK, master], check=True)
    with Reader(browser, place, token, width=1280, height=800) as reader:
        page = _now(reader)
        expect(page.get_by_text("isolation none")).to_have_count(0)
        version = page.locator(".brand-sub").inner_text().split()[-1]
        _who_drives(reader)
        _incident(reader)
        _others(reader)
    with Reader(browser, place, token, width=390, height=844) as narrow:
        _narrow(narrow)
    return version


def _incident(reader: Reader) -> None:
    page = reader.go("now")
    refused = page.get_by_role("region", name="Recently denied")
    expect(refused.get_by_role("listitem").first).to_contain_text("/landshark_control/trigger")
    _take(page, "incident-now")
    refused.get_by_role("link", name=re.compile("landshark_control")).first.click()
    expect(page.locator(".excerpt-line.here")).to_be_visible()
    page.get_by_text("Why", exact=True).scroll_into_view_if_needed()
    _take(page, "incident-record")
    page.get_by_role("link", name="Explain in the policy").click()
    expect(page.locator("[data-explained]").first).to_be_visible()
    _take(page, "incident-explain")
    policy = (REPOSITORY / "examples/landshark/landshark-demo.ini").read_text()
    reader.write(re.sub(r"^/?tablet.*\n| tablet\b(?! shows)", "", policy, flags=re.MULTILINE))
    page.get_by_role("button", name="Load", exact=True).click()
    page.get_by_label("Comment").fill("incident: the tablet tried to fire")
    page.get_by_label("Commit-confirm").select_option("300")
    _take(page, "incident-load")
    page.get_by_role("button", name="Not yet").click()
    reader.write(policy.replace("/rosout               = vehicle ocu", "/rosout               = vehicle oku"))
    page.get_by_role("tab", name="Check").click()
    expect(page.locator(".finding").first).to_be_visible()
    _take(page, "console-policy")


def _others(reader: Reader) -> None:
    page = reader.go("monitors/safeTrigger", heading="safeTrigger")
    expect(page.locator("[data-editor] .cm-content").first).to_contain_text("safeTrigger")
    _take(page, "console-monitor")
    page = reader.go("hosts")
    expect(page.get_by_role("row", name="10.77.0.10")).to_be_visible()
    _take(page, "console-hosts")


def _many_nodes(reader: Reader) -> None:
    page = reader.go("graph")
    expect(page.locator(".box.many")).to_have_count(10)
    expect(page.locator(".line.flowing").first).to_be_attached()
    expect(page.locator("g.attempt")).to_have_count(len(_UNKNOWN_NODES))
    _take(page, "console-nodes")


def _who_drives(reader: Reader) -> None:
    page = reader.go("robot")
    expect(page.get_by_role("region", name="Guards").get_by_text("deadman").first).to_be_visible()
    _take(page, "console-robot")


def _now(reader: Reader) -> Page:
    page = reader.go("now")
    expect(page.locator(".event").first).to_be_visible()
    expect(page.locator("path.curve.c3[d*=L]")).to_be_attached()  # a line begins with the second sample
    _take(page, "console-now")
    return page


def _one_topic(reader: Reader) -> None:
    page = reader.go("graph")
    page.get_by_label("Search the graph").fill("/arm/command")
    expect(page.locator('[data-key="t/arm/command"]')).to_be_visible()
    page.get_by_label("Search the graph").press("Enter")
    expect(page.get_by_role("button", name="Look", exact=True)).to_be_visible()
    page.get_by_role("list", name="Legend").scroll_into_view_if_needed()
    _take(page, "console-graph")


def _narrow(reader: Reader) -> None:
    shots = []
    for view in ("now", "graph", "audit"):
        page = reader.go(view)
        expect(
            page.locator({"now": ".event", "graph": ".box", "audit": "tbody tr"}[view]).first
        ).to_be_visible()
        if view == "graph":
            expect(page.locator("g.attempt").first).to_be_attached()
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
    page.mouse.move(0, 0)  # nothing is under the pointer
    page.screenshot(path=_PICTURES / f"{name}.png", animations="disabled")


if __name__ == "__main__":
    main()
