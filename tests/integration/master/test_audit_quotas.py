import time
import xmlrpc.client
from collections.abc import Iterator
from typing import Any

import pytest

from appliance.audit.log.folding import FoldSettings
from appliance.quotas.table import AUDIT_BYTES, AUDIT_KINDS
from examples.landshark.lab import Lab
from tests.support.nodes import need_ros
from tests.support.requirements import need_root
from tests.support.siege import Siege

SLOW = 1.0  # seconds for a call of the robot during a flood, on an idle machine
PARTS = 9000
LONG = "k" * 900


@pytest.fixture(scope="module")
def siege(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Siege]:
    need_root()
    need_ros()
    # With this size, the part of the disk of a guest's network is less than the bound of one host.
    settings = "relays: 2\naudit: {retention_bytes: 256MiB}\n"
    with Lab("rosrv-test") as lab, Siege(lab, tmp_path_factory.mktemp("siege"), settings) as there:
        yield there


def log_bytes(siege: Siege) -> int:
    return sum(one.stat().st_size for one in (siege.appliance.state / "control").glob("audit.db*"))


def reads(prefix: str) -> list[dict[str, Any]]:
    return [
        {"methodName": "hasParam", "params": ["/flooder", f"/{prefix}{number}/{LONG}"]}
        for number in range(PARTS)
    ]


def test_reads_with_long_keys_do_not_fill_the_disk(siege: Siege) -> None:
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


def test_unknown_hosts_do_not_displace_denials_of_named_hosts(siege: Siege) -> None:
    unknown_hosts, guest = siege.crowd.unknown_hosts, siege.crowd.guests[2]
    began = time.monotonic()
    for turn in range(4):
        for number, unknown in enumerate(unknown_hosts):
            fault = siege.crowd.call(unknown, f"call{turn}x{number}", "/n", turn)
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
    assert {record["resource"] for record in records if record["event"] == "decision"} >= set(topics)
    of_unknown_hosts = [
        one
        for one in siege.appliance.audit("--deny", "--limit", "10000")
        if one["detail"].get("unknown_host")
    ]
    # Kinds that were forgotten are recorded in full again.
    periods = (time.monotonic() - began) // FoldSettings().seconds
    assert 0 < len(of_unknown_hosts) <= (2 + periods) * (AUDIT_KINDS.bounds.unknown + 1)
