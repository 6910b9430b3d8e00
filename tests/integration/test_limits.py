import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from examples.landshark.lab import Lab
from tests.support.appliance import OPEN_POLICY, Appliance
from tests.support.nodes import Client, RosSession, need_ros, numbers, without_gap
from tests.support.processes import Host, Process
from tests.support.requirements import need_root
from tests.support.waiting import eventually

CLIENTS: list[Client] = ["rospy", "roscpp"]
MONITOR = "counter() { int heard; event said() /watched std_msgs/String '{}' { heard++; } }"
LIMITED = (
    OPEN_POLICY
    + """[Limits]
/watched = publisher 5 Hz
/flood = publisher 5 Hz
/camera = subscriber 10.77.0.20 5 Hz, subscriber 10.77.0.10 20 Hz
/map = publisher 1 Hz
"""
)


@pytest.fixture(scope="module")
def lab() -> Iterator[Lab]:
    need_root()
    need_ros()
    with Lab("rosrv-limits") as lab:
        yield lab


@pytest.fixture(scope="module")
def appliance(lab: Lab) -> Iterator[Appliance]:
    middle, monitors = lab.host("master", "10.77.0.2/24"), {"counter": MONITOR}
    with Appliance(middle, policy=LIMITED, monitors=monitors, options=("--api", "off")) as appliance:
        yield appliance


@pytest.fixture(scope="module")
def hosts(lab: Lab) -> tuple[Host, Host]:
    return lab.host("robot", "10.77.0.10/24"), lab.host("ocu", "10.77.0.20/24")


@pytest.fixture
def ros(appliance: Appliance, hosts: tuple[Host, Host], tmp_path: Path) -> Iterator[RosSession]:
    with RosSession(appliance.master_uri, tmp_path, hosts[0]) as session:
        yield session


def seconds_for(listener: Process, count: int, since: float) -> float:
    """Return the seconds since `since`, a time before the first message: a busy machine can only increase them."""
    listener.wait_for_count(count, event="received")
    return time.monotonic() - since


def judged(appliance: Appliance) -> int:
    [row] = [line for line in appliance.rosrv("monitor", "list").stdout.splitlines() if "counter" in line]
    return int(row.split()[3])


@pytest.mark.parametrize("topic", ["/flood", "/watched"])
@pytest.mark.parametrize("client", CLIENTS)
def test_only_the_publisher_beyond_its_limit_loses_messages(
    appliance: Appliance, ros: RosSession, client: Client, topic: str
) -> None:
    before = judged(appliance)
    listener, other = ros.listener(client, topic), ros.listener(client, "/quiet")
    ros.talker(client, "/quiet", "--rate", "50")
    name, began = f"flooder_{topic[1:]}_{client}", time.monotonic()
    talker = ros.talker(client, topic, "--rate", "100", name=name)
    assert seconds_for(listener, 20, began) > (20 - 6) / 5
    heard = numbers(listener.seen(event="received"))
    assert heard == sorted(heard)
    talker.wait_for_count(2 * len(heard), event="sent")
    assert heard[-1] > len(heard)
    assert without_gap(numbers(other.seen(event="received")))
    [first, *_] = reversed(appliance.recorded("--event", "rate limited", caller_id=f"/{name}"))
    assert (first["host"], first["resource"], first["rule"]["key"]) == ("10.77.0.10", topic, topic)
    assert first["detail"]["part"] == "publisher"
    if topic == "/watched":
        # The relay reports its counters once a second.
        eventually(lambda: judged(appliance) - before >= len(heard), "the messages are counted")
        assert judged(appliance) - before < talker.seen(event="sent")[-1]["number"]
