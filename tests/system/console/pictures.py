"""Make the console's pictures in docs/pictures: `python -m tests.system.console.pictures [MINUTES]`, as root.

The README's picture shows a robot of a hundred nodes after MINUTES (by default an hour), whose arm an operator's
machine tries to command. Others show the demonstration and its attacker.
"""

import base64
import itertools
import math
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
    " exec env PYTHONPATH=/opt/rosrv .venv/bin/rosrv demo --hold", "sh", str(REPOSITORY),
)  # fmt: skip
_DEMO_SECONDS = 400.0
_ATTACK = """
import sys, xmlrpc.client
with xmlrpc.client.ServerProxy(sys.argv[1]) as master:
    print(master.registerPublisher("/tablet", "/landshark_control/trigger", "*", "http://10.77.0.66:40404/"))
"""


def main() -> None:
    minutes = float(sys.argv[1]) if len(sys.argv) > 1 else 60.0
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
                _robot(reader)
                _audit(reader)
                _one_topic(reader)
            with Reader(browser, place, token, width=390, height=844) as narrow:
                _narrow(narrow)
            _work(robot, minutes)
            with Reader(browser, place, token, width=1280, height=800) as reader:
                _now(reader)
        with Process(ThisMachine(), _DEMO, env=dict(os.environ), label="demo") as demo:
            _demonstration(browser, demo)
            demo.stop(with_signal=signal.SIGTERM, timeout=60)
        browser.close()


def _demonstration(browser: Browser, demo: Process) -> None:
    demo.wait_for_text("Be the attacker:", timeout=_DEMO_SECONDS)
    said = "\n".join(str(event.get("text")) for event in demo.events)
    ((attacker, master),) = re.findall(
        r"Be the attacker: +(ip netns exec \S+) env ROS_MASTER_URI=(\S+)", said
    )
    there = ["nsenter", "--mount", f"--target={demo.pid}", *attacker.split()]
    subprocess.run([*there, "python3", "-c", _ATTACK, master], check=True)
    ((place, token),) = re.findall(r"console: +(\S+?)/? .*?its token: +(\S+)", said, re.DOTALL)
    with Reader(browser, place, token, width=1280, height=800) as reader:
        _incident(reader)
        _others(reader)


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


def _robot(reader: Reader) -> None:
    page = reader.go("graph")
    expect(page.locator(".box.many")).to_have_count(10)
    expect(page.locator(".line.flowing").first).to_be_attached()
    expect(page.locator("g.attempt")).to_have_count(len(_UNKNOWN_NODES))
    _take(page, "console-robot")


def _work(robot: Robot, minutes: float) -> None:
    end = time.monotonic() + 60 * minutes
    intruders = itertools.cycle(_UNKNOWN_NODES)
    for second in itertools.count():
        for _ in range(6 + round(4 * math.sin(second / 40))):
            robot.call("/arm/driver", "hasParam", f"/arm/limit_{second % 7}")
        if second % 30 == 0:
            node = next(intruders)
            robot.call(node, "registerPublisher", "/arm/command", "std_msgs/Float64", robot.api(node))
        if time.monotonic() > end:
            return
        time.sleep(1)  # noqa: TID251  # the pace of the traffic


def _now(reader: Reader) -> None:
    page = reader.go("now")
    expect(page.locator(".event").first).to_be_visible()
    expect(page.locator("path.curve.c3[d*=L]")).to_be_attached()  # a line begins with the second sample
    _take(page, "console-now")


def _audit(reader: Reader) -> None:
    page = reader.go("audit")
    page.get_by_role("row", name=_UNKNOWN_NODES[0]).first.click()
    expect(page.locator(".excerpt-line.here")).to_be_visible()
    _take(page, "console-audit")


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
            page.locator({"now": ".event", "graph": ".box.many", "audit": "tbody tr"}[view]).first
        ).to_be_visible()
        if view == "graph":
            expect(page.locator("g.attempt")).to_have_count(len(_UNKNOWN_NODES))
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
