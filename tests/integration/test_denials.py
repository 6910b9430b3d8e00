"""Every denial is counted where an operator looks: metrics, the last minute, alarms, status."""

import re
import xmlrpc.client
from collections.abc import Iterator

import pytest

from appliance.channel.admin import MetricsWanted
from appliance.features.alarms.requests import AlarmsWanted
from appliance.features.blocks.requests import HostBlock
from examples.landshark.lab import Host, Lab
from tests.support.appliance import OPEN_POLICY, Appliance
from tests.support.waiting import eventually

STRANGER, GUEST = "10.84.0.66", "10.84.0.77"
POLICY = OPEN_POLICY.replace("default = *", f"default = 10.84.0.10 {GUEST}")


@pytest.fixture
def appliance(common_lab: Lab) -> Iterator[Appliance]:
    host = common_lab.host("denying", "10.84.0.2/24")
    with Appliance(host, policy=POLICY, options=("--api", "off")) as running:
        yield running


def denied(appliance: Appliance) -> int:
    decisions = appliance.ask(MetricsWanted()).decisions
    return sum(count for _category, outcome, count in decisions if outcome == "deny")


def recorded(appliance: Appliance) -> int:
    return sum(int(row["detail"].get("count", 1)) for row in appliance.audit("--deny"))


@pytest.mark.real
def test_denials_of_unknown_and_blocked_hosts_count(common_lab: Lab, appliance: Appliance) -> None:
    def calls(host: Host, number: int) -> None:
        def call() -> None:
            arguments = "/forged", "/cmd_vel", "geometry_msgs/Twist", "http://10.84.0.9:9/"
            for _ in range(number):
                with (
                    xmlrpc.client.ServerProxy(appliance.master_uri) as master,
                    pytest.raises(xmlrpc.client.Fault, match=r"10\.84\.0\.66|blocked"),
                ):
                    master.registerPublisher(*arguments)

        host.run(call)

    calls(common_lab.host("stranger", f"{STRANGER}/24"), 200)
    assert denied(appliance) == 200
    said = rf"\d+ denials in the last minute \({STRANGER} was denied publish /cmd_vel, \d+ times\)"
    assert re.search(said, " ".join(appliance.rosrv("status").stdout.split()))
    (alarm,) = (one for one in appliance.ask(AlarmsWanted()).alarms if one.kind == "denials")
    assert re.match(said, alarm.text)
    appliance.ask(HostBlock(GUEST))
    calls(common_lab.host("guest", f"{GUEST}/24"), 20)
    assert denied(appliance) == 220
    eventually(lambda: recorded(appliance) == 220, appliance.story)
