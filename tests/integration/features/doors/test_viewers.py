"""A viewer that looked before its door's rights changed sees within three seconds what one of a new process sees.

A door keeps what it learned of topics with types of their own, and of services.
"""

import contextlib
import json
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from typing import NamedTuple

import pytest
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from examples.landshark.lab import Host, Lab
from tests.support.appliance import Appliance
from tests.support.nodes import RosSession
from tests.support.waiting import allowed, eventually

DOOR = "ws://10.77.0.2:9091"
THINGS = {"/drive", "/brake"}  # a topic and a service


def policy(agent: str, hours: str = "") -> str:
    return f"""
[Groups]
site = 10.77.0.0/24
agent = door:agent
[Hours]
{hours}
[Nodes]
default = site agent
[Publishers]
default = site
[Subscribers]
default = site {agent}
[Services]
default = site
[Clients]
default = site {agent}
[Commands]
default = site agent
"""


class Viewer:
    """A Foxglove viewer that has looked once."""

    def __init__(self, client: ClientConnection) -> None:
        self._client = client
        self._announced: dict[int, str] = {}
        self._looked = False
        eventually(lambda: self.sees() is not None and self._looked, "the door looks")

    def sees(self) -> set[str]:
        with contextlib.suppress(TimeoutError):
            while True:
                match json.loads(self._client.recv(0)):
                    case {"op": "advertise", "channels": channels}:
                        self._announced |= {channel["id"]: channel["topic"] for channel in channels}
                        self._looked = True
                    case {"op": "advertiseServices", "services": services}:
                        self._announced |= {service["id"]: service["name"] for service in services}
                    case {"op": "unadvertise", "channelIds": gone} | {
                        "op": "unadvertiseServices",
                        "serviceIds": gone,
                    }:
                        for number in gone:
                            del self._announced[number]
        return THINGS.intersection(self._announced.values())


class Site(NamedTuple):
    appliance: Appliance
    robot: Host

    @contextlib.contextmanager
    def new_viewer(self) -> Iterator[Viewer]:
        """Yield a viewer of a new process of the door, which knows nothing from before."""
        before = self.appliance.kill("door")
        eventually(lambda: self.appliance.pids("door") not in ([], [before]), self.appliance.story)
        eventually(lambda: not self.appliance.row("door", "list")["trouble"], "the door serves")
        with contextlib.ExitStack() as open_:
            with self.robot.entered():
                client = open_.enter_context(
                    connect(DOOR, subprotocols=[Subprotocol("foxglove.websocket.v1")])
                )
            yield Viewer(client)


@pytest.fixture(scope="module")
def site(common_lab: Lab, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    host, robot = common_lab.host("appliance", "10.77.0.2/24"), common_lab.host("robot", "10.77.0.10/24")
    with (
        Appliance(host, policy=policy(""), options=("--api", "off")) as appliance,
        RosSession(appliance.master_uri, tmp_path_factory.mktemp("ros"), robot) as ros,
    ):
        appliance.rosrv("door", "add", "agent", "--port", "9091", "--from", robot.address)
        ros.node("rospy", "drive", "/drive", "left")
        ros.service_server("roscpp", "/brake")
        yield Site(appliance, robot)


Way = Callable[[Site], Iterator[set[str]]]
"""Yields what the door may see at first; then the rights change, and it may see the other things."""


def load(site: Site) -> Iterator[set[str]]:
    site.appliance.reload(policy(""))
    yield set()
    site.appliance.reload(policy("agent"))


def revoke(site: Site) -> Iterator[set[str]]:
    site.appliance.reload(policy("agent"))
    yield THINGS
    site.appliance.reload(policy(""))


def rollback(site: Site) -> Iterator[set[str]]:
    site.appliance.reload(policy("agent"))
    site.appliance.reload(policy(""))
    yield set()
    site.appliance.rosrv("policy", "rollback")


def hours(site: Site) -> Iterator[set[str]]:
    begin = (datetime.now(UTC) + timedelta(seconds=80)).replace(second=0, microsecond=0)
    shift = f"shift = {begin:%H:%M}-{begin + timedelta(hours=2):%H:%M}"
    site.appliance.reload(policy("agent during shift", shift))
    yield set()
    eventually(lambda: datetime.now(UTC) >= begin, "the hours begin", seconds=90)


def block(site: Site) -> Iterator[set[str]]:
    site.appliance.reload(policy("agent"))
    yield THINGS
    site.appliance.rosrv("host", "block", "door:agent")


def unblock(site: Site) -> Iterator[set[str]]:
    site.appliance.reload(policy("agent"))
    site.appliance.rosrv("host", "block", "door:agent")
    yield set()
    site.appliance.rosrv("host", "unblock", "door:agent")


@pytest.mark.parametrize("way", [load, revoke, rollback, hours, block, unblock])
def test_a_viewer_that_looked_before_sees_what_a_new_one_sees(site: Site, way: Way) -> None:
    change = way(site)
    before = next(change)
    after = THINGS - before
    with site.new_viewer() as viewer:
        eventually(lambda: viewer.sees() == before, lambda: str(viewer.sees()))
        next(change, None)
        eventually(lambda: viewer.sees() == after, lambda: str(viewer.sees()), allowed(3))
    with site.new_viewer() as new:
        eventually(lambda: new.sees() == after, lambda: str(new.sees()))
