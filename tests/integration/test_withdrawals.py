"""A right is taken from a host that publishes, at a bad moment: once the order is answered, no message passes."""

import contextlib
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import NamedTuple

import pytest

from examples.landshark.lab import Lab
from tests.support.appliance import Appliance
from tests.support.nodes import RosSession, need_ros
from tests.support.processes import Process
from tests.support.rosmaster import call_on
from tests.support.small_disk import filled, small_disk
from tests.support.waiting import eventually

ROBOT, GUEST = "10.77.0.10", "10.77.0.66"
POLICY = f"""
[Groups]
site = 10.77.0.0/24
[Nodes]
default = site
[Publishers]
default = site
/held = {ROBOT}, ask {GUEST}
/open = site
[Subscribers]
default = site
[Commands]
default = site
[Authority]
base = /cmd
take base = {GUEST}
override base = {ROBOT}
lease base = 60s
"""
SOME = 15
KIND = "std_msgs/String"
IN_FLIGHT = 2
"""The messages of a talker that the relay may have passed just before the answer; ten come in a second."""


class Site(NamedTuple):
    appliance: Appliance
    guest: RosSession
    ticks: Process
    listeners: dict[str, Process]

    def hears(self, topic: str) -> None:
        ear = self.listeners[topic]
        ear.wait_for(event="received", since=ear.mark(), timeout=60)

    def heard(self, topic: str) -> int:
        """Return how many of the guest's messages came while some of the robot's own came."""
        ear = self.listeners[topic]
        mark = ear.mark()
        self.ticks.wait_for_count(SOME, event="received", since=self.ticks.mark(), timeout=60)
        return sum(event.get("event") == "received" for event in ear.events[mark:])


Orders = tuple[str, Callable[[Site], object], Callable[[Site], object]]
"""A topic of the guest, the order that takes the right to it, and the one that gives it."""


def drive(site: Site) -> None:
    site.appliance.rosrv("drive", "free", "base", check=False)
    site.appliance.rosrv("drive", "assign", "base", "--host", GUEST)


def approvals(site: Site) -> list[int]:
    return [int(row["number"]) for row in site.appliance.rows("approve")[0]["approvals"]]


def refuse(site: Site) -> None:
    [number] = approvals(site)
    site.appliance.rosrv("approval", "refuse", str(number), check=False)


def approve(site: Site) -> None:
    """Hold the call of a node, approve it, and start the node, in place of an earlier one of the name."""
    uri = f"http://{GUEST}:1/"
    held = call_on(
        site.guest.host, site.appliance.master_uri, "registerPublisher", "/guest_held", "/held", KIND, uri
    )
    if "held for approval" in held[1]:
        site.appliance.rosrv("approve", str(max(approvals(site))), "--for", "300s")
    site.guest.talker("rospy", "/held", name="guest_held")


RIGHTS: dict[str, Orders] = {
    "policy": (
        "/open",
        lambda site: site.appliance.reload(POLICY.replace("/open = site", f"/open = {ROBOT}")),
        lambda site: site.appliance.reload(POLICY),
    ),
    "host": (
        "/open",
        lambda site: site.appliance.rosrv("host", "block", GUEST, check=False),
        lambda site: site.appliance.rosrv("host", "unblock", GUEST, check=False),
    ),
    "group": (
        "/cmd",
        lambda site: site.appliance.rosrv("drive", "assign", "base", "--host", ROBOT, check=False),
        drive,
    ),
    "approval": ("/held", refuse, approve),
}


@pytest.fixture(scope="module")
def site(common_lab: Lab, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    need_ros()
    host, robot, guest = (
        common_lab.host(name, f"{address}/24")
        for name, address in (("appliance", "10.77.0.2"), ("robot", ROBOT), ("guest", GUEST))
    )
    appliance = Appliance(host, policy=POLICY, options=("--api", "off"))
    try:
        with small_disk(appliance.state, "160m", "mode=755"):
            appliance.start()
            with RosSession(appliance.master_uri, tmp_path_factory.mktemp("ros"), robot) as ros:
                ros.talker("rospy", "/tick", name="robot")
                listeners = {topic: ros.listener("rospy", topic) for topic in ("/open", "/cmd", "/held")}
                for topic in ("open", "cmd"):
                    ros.on(guest).talker("rospy", f"/{topic}", name=f"guest_{topic}")
                found = Site(appliance, ros.on(guest), ros.listener("rospy", "/tick"), listeners)
                yield found
            appliance.stop()
    finally:
        appliance.close()


@contextlib.contextmanager
def a_relay_that_hangs_for_good(site: Site) -> Iterator[None]:
    pid = site.appliance.pids("relay")[0]
    os.kill(pid, signal.SIGSTOP)
    yield
    eventually(lambda: not Path(f"/proc/{pid}").exists(), site.appliance.story)


@contextlib.contextmanager
def a_relay_that_goes_on(site: Site) -> Iterator[None]:
    pid = site.appliance.pids("relay")[0]
    os.kill(pid, signal.SIGSTOP)
    timer = threading.Timer(2.0, os.kill, (pid, signal.SIGCONT))
    timer.start()
    yield
    timer.join()


@contextlib.contextmanager
def a_full_disk(site: Site) -> Iterator[None]:
    with filled(site.appliance.state):
        yield


MOMENTS: tuple[Callable[[Site], AbstractContextManager[None]], ...] = (
    a_relay_that_hangs_for_good,
    a_relay_that_goes_on,
    a_full_disk,
)


@pytest.mark.parametrize(
    ("right", "moment"),
    [
        pytest.param(right, moment, id=f"{right}-{moment.__name__}")
        for right in RIGHTS
        for moment in MOMENTS
        if (right, moment) != ("policy", a_full_disk)  # it is refused: test_full_disk.py
    ],
)
def test_no_message_passes_once_the_right_is_taken(
    site: Site, right: str, moment: Callable[[Site], AbstractContextManager[None]]
) -> None:
    topic, take, give = RIGHTS[right]
    give(site)
    site.hears(topic)
    with moment(site):
        began = time.monotonic()
        take(site)
        print(f"{right}: answered after {time.monotonic() - began:.1f} s")  # noqa: T201  shown by pytest -s
        passed = site.heard(topic)
    left = site.heard(topic)
    give(site)
    site.hears(topic)
    assert (passed <= IN_FLIGHT, left) == (True, 0)


def test_a_block_ends_at_its_time_on_a_full_disk(site: Site) -> None:
    """Its host is heard again as soon as records can be written."""
    site.hears("/open")
    with filled(site.appliance.state):
        site.appliance.rosrv("host", "block", GUEST, "--for", "6s", check=False)
        assert site.heard("/open") <= IN_FLIGHT
        eventually(lambda: not site.appliance.rows("host", "blocks"), site.appliance.story)
    site.hears("/open")
