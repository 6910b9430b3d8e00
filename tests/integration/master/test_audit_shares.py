"""Floods of records from guests and strangers, while the robot works: the log stays small and keeps what counts."""

import xmlrpc.client
from collections.abc import Iterator
from typing import Any

import pytest

from appliance.quotas.table import AUDIT_BYTES, AUDIT_KINDS
from examples.landshark.lab import Lab
from tests.support.nodes import has_ros
from tests.support.requirements import need_root, needs
from tests.support.siege import Siege

SLOW = 1.0  # seconds for a call of the robot in a flood, on a machine that does nothing else
PARTS = 9000
LONG = "k" * 900


@pytest.fixture(scope="module")
def siege(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Siege]:
    """A robot at work, and a crowd that has not begun."""
    need_root()
    needs(has_ros(), "ROS 1 and g++ (run `make setup`)")
    with Lab("rosrv-test") as lab, Siege(lab, tmp_path_factory.mktemp("siege"), "relays: 2\n") as there:
        yield there


def log_bytes(siege: Siege) -> int:
    """What the log takes on the disk."""
    return sum(one.stat().st_size for one in (siege.appliance.state / "control").glob("audit.db*"))


def reads(prefix: str) -> list[dict[str, Any]]:
    """The parts of a multicall that reads many parameters with long names, each another one."""
    return [
        {"methodName": "hasParam", "params": ["/flooder", f"/{prefix}{number}/{LONG}"]}
        for number in range(PARTS)
    ]


def test_reads_with_long_keys_fill_no_disk(siege: Siege) -> None:
    """A guest that reads without end is served its share of the log and then refused in words; the robot is not."""
    guest, before = siege.crowd.guests[0], log_bytes(siege)
    denied = siege.crowd.call(guest, "setParam", "/flooder", "/limits/speed", 1)
    assert denied[0] == 0

    def attack() -> None:
        answer = siege.crowd.call(guest, "system.multicall", reads("a"))
        faults = [part for part in answer if isinstance(part, dict)]
        assert 0 < len(faults) < PARTS
        assert "bytes of audit records to pay off" in faults[-1]["faultString"]
        again = siege.crowd.call(guest, "system.multicall", reads("b"))
        assert sum(isinstance(part, dict) for part in again) > PARTS * 0.9

    siege.throughout(attack, slowest=SLOW)
    assert siege.trail.wait_for(event="limit exceeded", host=guest)["decision"] == "deny"
    assert log_bytes(siege) - before < 6 * AUDIT_BYTES.bounds.host
    assert siege.appliance.recorded("--deny", host=guest)[-1]["detail"]["key"] == "/limits/speed"


def test_the_same_read_again_is_counted(siege: Siege) -> None:
    """A node that polls a parameter leaves its first read, and a count every ten seconds."""
    guest = siege.crowd.guests[1]
    part = {"methodName": "hasParam", "params": ["/poller", "/rosdistro"]}
    answer = siege.crowd.call(guest, "system.multicall", [part] * 2000)
    assert all(isinstance(one, list) and one[0][0] == 1 for one in answer)
    summed = siege.trail.wait_for(event="repetitions folded", host=guest)
    assert (summed["detail"]["key"], summed["detail"]["count"]) == ("/rosdistro", 1999)
    assert summed["decision"] == "allow"


def test_strangers_push_no_denial_of_a_named_host_out(siege: Siege) -> None:
    """A hundred strangers who vary all they can make few records; each denial of a named host is there in full."""
    strangers, guest = siege.crowd.strangers, siege.crowd.guests[2]
    for turn in range(4):
        for number, stranger in enumerate(strangers):
            fault = siege.crowd.call(stranger, f"call{turn}x{number}", "/n", turn)
            assert isinstance(fault, xmlrpc.client.Fault | Exception)
    topics = [f"/cmd{number}" for number in range(50)]
    for topic in topics:
        assert (
            siege.crowd.call(
                guest, "registerPublisher", "/guest/x", topic, "std_msgs/String", "http://10.77.1.3:1/"
            )[0]
            == 0
        )
    records = siege.appliance.recorded("--deny", "--host", guest, count=len(topics))
    assert {one["resource"] for one in records if one["event"] == "decision"} >= set(topics)
    of_strangers = [
        one for one in siege.appliance.audit("--deny", "--limit", "10000") if one["detail"].get("stranger")
    ]
    assert (
        0 < len(of_strangers) <= 2 * AUDIT_KINDS.bounds.strangers
    )  # on a slow machine a second period begins
